"""Node-ID and identity of one node (1018h, 2101h), and its LSS slave (CiA 305): requests on 7E5h in, answers for 7E4h out.

Feed every data frame of 7E5h to ``receive``; answers leave through ``send``. Nothing raises, whatever comes. No clock is needed: the slave
has no time-outs.

Where independent stacks (CANopenNode, Lely) disagree, the stricter reading holds:

- Only frames of 8 bytes count (Lely takes shorter ones).
- Selection and identification are sequences without a gap: any other LSS frame between breaks them (Lely keeps the place over some
  services, CANopenNode takes selection frames in any order).
- Unconfigured, to fastscan and to "identify non-configured", is a node whose active **and** pending node-ID are FFh (Lely lets every node
  take part in a fastscan).
- A fastscan begins with BitChecked = 80h (both stacks would also begin without), with LSSSub and LSSNext in 0..3.
- A fastscan that has not come to its end is forgotten when the slave leaves the waiting state.
- "Inquire node-ID" answers with the active node-ID (Lely: the pending one while initialising).

All agree, and so does the table of services by state in CiA 305: in configuration state a slave ignores "switch state selective", also that
of another slave; only "switch state global" brings it back to waiting.
"""

from collections import deque
from collections.abc import Callable
from enum import IntEnum

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.dictionary import Abort, Dictionary, SdoAbort
from kontronik_can_gw.canopen.node_settings import NodeSettings
from kontronik_can_gw.canopen.storage import Parameters
from kontronik_can_gw.status import UNCONFIGURED


class Service(IntEnum):
    """Command specifiers: byte 0 of a frame."""

    SWITCH_GLOBAL = 0x04
    CONFIGURE_NODE_ID = 0x11
    CONFIGURE_BIT_TIMING = 0x13
    STORE = 0x17
    SELECTED = 0x44
    IDENTIFY_NON_CONFIGURED = 0x4C
    IDENTIFIED = 0x4F
    NON_CONFIGURED = 0x50
    FASTSCAN = 0x51
    INQUIRE_NODE_ID = 0x5E


_SELECT = range(0x40, 0x44)
"""Command specifiers with one part each of the identity 1018h: vendor, product, revision, serial number."""
_INQUIRE = range(0x5A, 0x5E)
_IDENTIFY = range(0x46, 0x4C)
"""Vendor, product, lowest and highest revision, lowest and highest serial number."""

OK = 0
NODE_ID_OUT_OF_RANGE = 1
BIT_TIMING_NOT_SUPPORTED = 1
STORE_NOT_SUPPORTED = 1
STORE_FAILED = 2
SPECIFIC_ERROR = 0xFF
BUS_WRITES_OFF = 1
"""The specific error after FFh: writing over the bus is switched off in the configuration."""

SCAN_RESET = 0x80
"""BitChecked of the frame that begins a fastscan."""


class Identity:
    """The node as LSS sees it.

    ``taken``: whether another node of the gateway has a node-ID. ``boot``: called where an unconfigured node has got a node-ID.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        settings: NodeSettings,
        parameters: Parameters,
        taken: Callable[[int], bool],
        boot: Callable[[int], None],
    ) -> None:
        self.active_node_id = UNCONFIGURED
        self._dictionary = dictionary
        self._settings = settings
        self._parameters = parameters
        self._taken = taken
        self._boot = boot
        bind = dictionary.bind
        bind(at.NODE_ID, 1, read=lambda _now: self.active_node_id)
        check, read = self._check_node_id, lambda _now: self.pending_node_id
        bind(at.NODE_ID, 2, read=read, check=check, written=self._written)
        bind(at.NODE_ID, 3, read=lambda _now: settings.bitrate)
        bind(at.NODE_ID, 4, read=lambda _now: settings.bitrate)

    @property
    def pending_node_id(self) -> int:
        """The node-ID from the next reset communication on: as set over the bus, else as configured."""
        given = self._parameters.set_node_id
        return self._settings.node_id if given is None else given

    @property
    def identity(self) -> tuple[int, int, int, int]:
        """1018h:1..4."""
        number = self._dictionary.number
        serial = number(0x1018, 4, otherwise=self._settings.serial)
        return number(0x1018, 1), number(0x1018, 2), number(0x1018, 3), serial

    def activate(self) -> int:
        """Reset communication: the pending node-ID holds from now on."""
        self.active_node_id = self.pending_node_id
        return self.active_node_id

    def configure_node_id(self, node_id: int) -> bool:
        """A new node-ID for the next reset communication. False where writing is switched off or another node of ours has it."""
        if self._settings.read_only or (node_id != UNCONFIGURED and self._taken(node_id)):
            return False
        self._parameters.set_node_id = node_id
        return True

    def store_configuration(self) -> bool:
        """LSS: begin to save the pending node-ID. False: refused.

        After True exactly one call of ``LssSlave.stored`` follows, in the order of the requests, also when the node was reset between.
        """
        return not self._settings.read_only and self._parameters.store_node_id()

    def lss_left_configuration(self, now: int) -> None:
        """The slave was switched from configuration to waiting state."""
        if self.active_node_id == UNCONFIGURED and self.pending_node_id != UNCONFIGURED:
            self._boot(now)

    def _check_node_id(self, value: int) -> None:
        """Checks a new 2101h:2.

        The EDS permits 255, because tools add its $NODEID for a node that has no node-ID yet.
        """
        if value > 127:
            raise SdoAbort(Abort.TOO_HIGH)
        if value < 1:
            raise SdoAbort(Abort.TOO_LOW)
        if self._taken(value):
            raise SdoAbort(Abort.INCOMPATIBLE)

    def _written(self, _now: int) -> None:
        self._parameters.set_node_id = self._dictionary.number(at.NODE_ID, 2)


class LssSlave:
    """Configures one node, selected by its identity (1018h). Several slaves hear the same frames, each answers for itself only."""

    def __init__(self, host: Identity, send: Callable[[bytes], None]) -> None:
        self._host = host
        self._send = send
        self._configuring = False
        self._expected = 0
        """What continues the selection or identification under way; 0: none is."""
        self._scanned: int | None = None
        """LSSPos, the part of the identity (0..3) that a fastscan looks at; None: no fastscan under way."""
        self._stores: deque[bool] = deque()
        """Savings under way, oldest first: whether the master still waits for the answer."""

    @property
    def configuring(self) -> bool:
        """Whether this is the LSS configuration state (else: waiting)."""
        return self._configuring

    def reset(self) -> None:
        """Back to waiting state, at an NMT reset: partial selections and scans are forgotten, a late result of a saving is not sent."""
        self._enter(configuring=False)

    def receive(self, data: bytes, now: int) -> None:
        """Take a data frame of 7E5h. Other lengths than 8 bytes, unknown services and services of the other state are ignored."""
        if len(data) != 8:
            return
        service, number = data[0], int.from_bytes(data[1:5], "little")
        expected, self._expected = self._expected, 0
        if service == Service.SWITCH_GLOBAL:
            self._switch_global(data[1], now)
        elif service in _IDENTIFY:
            if self._sequence_ends(
                _IDENTIFY, service, expected, self._is_in_range(service, number)
            ):
                self._answer(Service.IDENTIFIED)
        elif service == Service.IDENTIFY_NON_CONFIGURED:
            if self._unconfigured:
                self._answer(Service.NON_CONFIGURED)
        elif self._configuring:
            self._configure(service, data)
        elif service in _SELECT:
            fits = self._host.identity[service - _SELECT[0]] == number
            if self._sequence_ends(_SELECT, service, expected, fits):
                self._enter(configuring=True)
                self._answer(Service.SELECTED)
        elif service == Service.FASTSCAN and self._unconfigured:
            self._fastscan(number, *data[5:])

    def stored(self, ok: bool) -> None:
        """Report the result of the oldest saving under way.

        Not answered if the slave has left the configuration state since: another slave may be the selected one by now.
        """
        if self._stores and self._stores.popleft():
            self._answer(Service.STORE, OK if ok else STORE_FAILED)

    @property
    def _unconfigured(self) -> bool:
        return (
            self._host.active_node_id == UNCONFIGURED and self._host.pending_node_id == UNCONFIGURED
        )

    def _enter(self, configuring: bool) -> None:
        self._configuring = configuring
        self._expected = 0
        self._scanned = None
        if not configuring:
            self._stores = deque(False for _ in self._stores)

    def _switch_global(self, mode: int, now: int) -> None:
        if mode == 1:
            self._enter(configuring=True)
        elif mode == 0:
            left = self._configuring
            self._enter(configuring=False)
            if left:
                self._host.lss_left_configuration(now)

    def _sequence_ends(self, services: range, service: int, expected: int, fits: bool) -> bool:
        """Whether this frame completes a selection or identification that fits in all its parts."""
        if not fits or service not in (services[0], expected):
            return False
        self._expected = service + 1 if service != services[-1] else 0
        return not self._expected

    def _is_in_range(self, service: int, number: int) -> bool:
        """Whether one part of an identification fits."""
        vendor, product, revision, serial = self._host.identity
        if service < _IDENTIFY[2]:
            return number == (vendor, product)[service - _IDENTIFY[0]]
        own = revision if service < _IDENTIFY[4] else serial
        return own >= number if service in _IDENTIFY[2::2] else own <= number

    def _fastscan(self, number: int, bit_checked: int, sub: int, following: int) -> None:
        """51h | IDNumber u32 | BitChecked 0..31 or 80h | LSSSub 0..3 | LSSNext 0..3."""
        if sub > 3 or following > 3:
            return
        if bit_checked == SCAN_RESET:
            self._scanned = 0
            self._answer(Service.IDENTIFIED)
            return
        if bit_checked > 31 or sub != self._scanned:
            return
        if (number ^ self._host.identity[sub]) >> bit_checked:
            return
        self._scanned = following
        # LSSNext < LSSSub with every bit checked: the master has come to the last part it looks at.
        if bit_checked == 0 and following < sub:
            self._enter(configuring=True)
        self._answer(Service.IDENTIFIED)

    def _configure(self, service: int, data: bytes) -> None:
        """Serve what only a slave in configuration state does. Activate bit timing (15h) has no answer, and here no effect."""
        if service == Service.CONFIGURE_NODE_ID:
            self._configure_node_id(data[1])
        elif service == Service.CONFIGURE_BIT_TIMING:
            self._answer(service, BIT_TIMING_NOT_SUPPORTED)  # the bit rate belongs to the system
        elif service == Service.STORE:
            if self._host.store_configuration():
                self._stores.append(True)
            else:
                self._answer(service, STORE_NOT_SUPPORTED)
        elif service in _INQUIRE:
            part = self._host.identity[service - _INQUIRE[0]]
            self._answer(service, *part.to_bytes(4, "little"))
        elif service == Service.INQUIRE_NODE_ID:
            self._answer(service, self._host.active_node_id)

    def _configure_node_id(self, node_id: int) -> None:
        if not (1 <= node_id <= 127 or node_id == UNCONFIGURED):
            self._answer(Service.CONFIGURE_NODE_ID, NODE_ID_OUT_OF_RANGE)
        elif not self._host.configure_node_id(node_id):
            self._answer(Service.CONFIGURE_NODE_ID, SPECIFIC_ERROR, BUS_WRITES_OFF)
        else:
            self._answer(Service.CONFIGURE_NODE_ID, OK)

    def _answer(self, *content: int) -> None:
        self._send(bytes(content).ljust(8, b"\0"))
