"""The node-ID and identity of one node (1018h, 2101h), and its LSS slave (CiA 305).

Pass every data frame of 7E5h to ``receive``. Answers for 7E4h are passed to ``send``. No input
raises, and no clock is needed, because the slave has no timeouts.

If independent stacks (CANopenNode, Lely) disagree, this slave follows the stricter reading:

- Only frames of 8 bytes count (Lely accepts shorter ones).
- Selection and identification are sequences without a gap. Any other LSS frame within them ends the
  sequence (Lely continues it after some services, CANopenNode accepts selection frames in any
  order).
- Only a node whose active **and** pending node-ID are FFh counts as unconfigured for fastscan and
  "identify non-configured" (Lely lets every node take part in a fastscan).
- A fastscan begins with BitChecked = 80h (both stacks would also begin without), with LSSSub and
  LSSNext in 0..3.
- An unfinished fastscan is forgotten when the slave leaves the waiting state.
- "Inquire node-ID" answers with the active node-ID (Lely: the pending one while initialising).

Both stacks and the table of services by state in CiA 305 agree on the following. A slave in
configuration state ignores "switch state selective", also if it selects another slave. Only
"switch state global" returns it to the waiting state.
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
"""Selection: one command specifier each for vendor, product, revision and serial number."""
_INQUIRE = range(0x5A, 0x5E)
"""Inquiry of the same four parts."""
_IDENTIFY = range(0x46, 0x4C)
"""Identification: vendor, product, lowest and highest revision, lowest and highest serial."""
_IDENTIFIED_PARTS = (0, 1, 2, 2, 3, 3)
"""The part of the identity for each of them."""

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
    """The node-ID and identity of one node, as LSS and 2101h read and change them.

    ``taken`` returns True if another node of the gateway has a node-ID. ``boot`` is called with the
    time when an unconfigured node received a node-ID.
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
        bind(
            at.NODE_ID,
            2,
            read=lambda _now: self.pending_node_id,
            check=self._check_node_id,
            written=self._written,
        )
        bind(at.NODE_ID, 3, read=lambda _now: settings.bitrate)
        bind(at.NODE_ID, 4, read=lambda _now: settings.bitrate)

    @property
    def pending_node_id(self) -> int:
        """The node-ID after the next reset communication.

        It is the one set over the bus, or else the configured one.
        """
        set_over_bus = self._parameters.set_node_id
        return self._settings.node_id if set_over_bus is None else set_over_bus

    @property
    def identity(self) -> tuple[int, int, int, int]:
        """Vendor, product, revision and serial number (1018h:1..4)."""
        number = self._dictionary.number
        vendor = number(0x1018, 1)
        product = number(0x1018, 2)
        revision = number(0x1018, 3)
        serial = number(0x1018, 4, otherwise=self._settings.serial)
        return vendor, product, revision, serial

    def activate(self) -> int:
        """Make the pending node-ID the active one at a reset communication, and return it."""
        self.active_node_id = self.pending_node_id
        return self.active_node_id

    def configure_node_id(self, node_id: int) -> bool:
        """Set the node-ID for the next reset communication.

        False if writing is switched off or another node of the gateway has the node-ID.
        """
        if self._settings.read_only:
            return False
        if node_id != UNCONFIGURED and self._taken(node_id):
            return False
        self._parameters.set_node_id = node_id
        return True

    def store_configuration(self) -> bool:
        """Begin to save the pending node-ID for LSS. False if this is refused.

        After True, exactly one call of ``LssSlave.stored`` follows, in the order of the requests,
        even if the node was reset in the meantime.
        """
        return not self._settings.read_only and self._parameters.store_node_id()

    def lss_left_configuration(self, now: int) -> None:
        """Boot the node if it received its first node-ID in the configuration state."""
        if self.active_node_id == UNCONFIGURED and self.pending_node_id != UNCONFIGURED:
            self._boot(now)

    def _check_node_id(self, value: int) -> None:
        """Check a new 2101h:2.

        SdoAbort 06090031h or 06090032h unless it is 1..127, 06040043h for the node-ID of another
        node of the gateway. The EDS permits 255, because tools add its $NODEID for a node that has
        no node-ID yet.
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
    """The LSS slave of one node, which is selected by its identity (1018h).

    All slaves of the gateway receive the same frames. Each answers for its own node only.
    """

    def __init__(self, host: Identity, send: Callable[[bytes], None]) -> None:
        self._host = host
        self._send = send
        self.is_configuring = False
        """True in the LSS configuration state, False in the waiting state."""
        self._expected = 0
        """Command specifier that continues the present selection or identification, else 0."""
        self._scanned: int | None = None
        """LSSPos, the part of the identity (0..3) that is scanned. None without a fastscan."""
        self._stores: deque[bool] = deque()
        """For each pending save, oldest first: True if the master still waits for the answer."""

    def reset(self) -> None:
        """Return to the waiting state at an NMT reset.

        Unfinished selections and scans are forgotten. Results of pending saves are not sent.
        """
        self._enter(is_configuring=False)

    def receive(self, data: bytes, now: int) -> None:
        """Serve a data frame of 7E5h.

        Ignored are other lengths than 8 bytes, unknown services and services of the other state.
        """
        if len(data) != 8:
            return
        service = data[0]
        number = int.from_bytes(data[1:5], "little")
        expected = self._expected
        self._expected = 0
        if service == Service.SWITCH_GLOBAL:
            self._switch_global(data[1], now)
        elif service in _IDENTIFY:
            is_match = self._is_in_range(service, number)
            if self._completes(_IDENTIFY, service, expected, is_match):
                self._answer(Service.IDENTIFIED)
        elif service == Service.IDENTIFY_NON_CONFIGURED:
            if self._is_unconfigured:
                self._answer(Service.NON_CONFIGURED)
        elif self.is_configuring:
            self._configure(service, data)
        elif service in _SELECT:
            own = self._host.identity[service - _SELECT[0]]
            if self._completes(_SELECT, service, expected, own == number):
                self._enter(is_configuring=True)
                self._answer(Service.SELECTED)
        elif service == Service.FASTSCAN and self._is_unconfigured:
            self._fastscan(number, *data[5:])

    def stored(self, is_stored: bool) -> None:
        """Answer with the result of the oldest pending save.

        Nothing is sent if the slave left the configuration state in the meantime, because another
        slave may be selected now.
        """
        if self._stores and self._stores.popleft():
            self._answer(Service.STORE, OK if is_stored else STORE_FAILED)

    @property
    def _is_unconfigured(self) -> bool:
        host = self._host
        return host.active_node_id == UNCONFIGURED and host.pending_node_id == UNCONFIGURED

    def _enter(self, is_configuring: bool) -> None:
        self.is_configuring = is_configuring
        self._expected = 0
        self._scanned = None
        if not is_configuring:
            self._stores = deque(False for _ in self._stores)

    def _switch_global(self, mode: int, now: int) -> None:
        if mode == 1:
            self._enter(is_configuring=True)
        elif mode == 0:
            was_configuring = self.is_configuring
            self._enter(is_configuring=False)
            if was_configuring:
                self._host.lss_left_configuration(now)

    def _completes(
        self,
        services: range,
        service: int,
        expected: int,
        is_match: bool,
    ) -> bool:
        """Return True if this frame completes a selection or identification of this node.

        ``is_match`` is True if this frame's part matches the node.
        """
        if not is_match or service not in (services[0], expected):
            return False
        self._expected = service + 1 if service != services[-1] else 0
        return not self._expected

    def _is_in_range(self, service: int, number: int) -> bool:
        """Return True if this part of an identification matches the node."""
        part = _IDENTIFIED_PARTS[service - _IDENTIFY[0]]
        own = self._host.identity[part]
        if part < 2:
            return own == number
        is_lowest = service in (_IDENTIFY[2], _IDENTIFY[4])
        return own >= number if is_lowest else own <= number

    def _fastscan(
        self,
        number: int,
        bit_checked: int,
        sub: int,
        following: int,
    ) -> None:
        """Serve 51h, IDNumber (4), BitChecked 0..31 or 80h, LSSSub 0..3, LSSNext 0..3."""
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
        # LSSNext < LSSSub with every bit checked: the master has finished the last part
        if bit_checked == 0 and following < sub:
            self._enter(is_configuring=True)
        self._answer(Service.IDENTIFIED)

    def _configure(self, service: int, data: bytes) -> None:
        """Serve the services of the configuration state.

        Activate bit timing (15h) has no answer, and no effect here.
        """
        if service == Service.CONFIGURE_NODE_ID:
            self._configure_node_id(data[1])
        elif service == Service.CONFIGURE_BIT_TIMING:
            self._answer(service, BIT_TIMING_NOT_SUPPORTED)  # the system sets the bit rate
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
