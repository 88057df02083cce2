"""The CANopen output: all nodes of a gateway on one bus.

Received frames are routed to the nodes by COB-ID, and all nodes share one list of frames to send.
"""

from collections import deque
from collections.abc import Mapping, Sequence

from kontronik_can_gw.canopen.cob_ids import (
    HEARTBEAT,
    LSS_REQUEST,
    NMT,
    OF_NODE_ID,
    FrameTaker,
    default_ids,
)
from kontronik_can_gw.canopen.emergency_codes import GatewayError
from kontronik_can_gw.canopen.nmt import ALL_NODES, RESETS, command
from kontronik_can_gw.canopen.node import Node
from kontronik_can_gw.canopen.node_settings import NodeSetup
from kontronik_can_gw.core.output import LogLine, NodeOutput, NodeState, OutputHost, Owner
from kontronik_can_gw.core.python_core import PythonCore
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.esc.telemetry import EscSettings, Event
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.signals.plan import MessageLayout, classic_bits
from kontronik_can_gw.status import UNCONFIGURED, CanState, name_in_words
from kontronik_can_gw.times import NEVER, SECOND

_HEARTBEAT_BYTES = 1
_PDO_BYTES = 8


class Nodes(NodeOutput):
    """One node for each ESC of ``host``. No PDO may have an id of ``host.own_ids``."""

    node_title = "CANopen node"
    events = Event.LINK | Event.STATE

    def __init__(self, setups: Sequence[NodeSetup], host: OutputHost) -> None:
        super().__init__()
        self.due = NEVER
        self._message_ids = host.own_ids
        self._routes: dict[int, list[FrameTaker]] = {}
        self._has_changed = True
        """True if a node's state or COB-IDs may have changed since the routes were made."""
        self._watched: frozenset[int] = frozenset()
        """COB-IDs of the heartbeats that nodes watch."""
        self._to_watchers: deque[CanFrame] = deque()
        """Heartbeats of our nodes, for those of our nodes that watch them."""
        self._is_on = False
        self._reported: list[NodeState] = []
        """The states in the log."""
        numbers = range(len(host.escs))
        self.nodes = [
            Node(number, setup, host, self) for number, setup in zip(numbers, setups, strict=True)
        ]
        self._can_faults = _CanFaults(self.nodes)

    # --- calls of the gateway

    def start(self, now: int, can_open: bool) -> None:
        """Power on. Without an open interface, the nodes boot later, in ``can_returned``."""
        if not can_open:
            return
        self._is_on = True
        self._can_faults.power_on()
        for node in self.nodes:
            node.reset_node(now)
        self._finish(now)

    def receive(self, frame: CanFrame, now: int, at: int) -> None:
        """Take a frame from the bus that arrived ``at``. Only 11-bit data frames are CANopen."""
        if frame.extended or frame.remote or frame.fd:
            return
        begin = len(self.frames)
        if frame.can_id == NMT and command(frame.data, ALL_NODES) in RESETS:
            for node in self.nodes:
                node.tpdos.release_ids()
        _route(self._routes, frame, now, at)
        if frame.can_id == LSS_REQUEST:
            # Equal answers that several slaves send at once are one frame on a bus.
            self.frames[begin:] = dict.fromkeys(self.frames[begin:])
        self._finish(now)

    def next_deadline(self) -> int:
        return self.due

    def on_event(self, esc: int, events: int, now: int) -> None:
        node = self.nodes[esc]
        node.on_event(events, now)
        if self._has_changed or self._to_watchers:
            self._finish(now)
        self.due = min(self.due, node.due)

    def on_can_state(self, before: CanState, state: CanState, now: int) -> None:
        """Follow the CAN controller: another state, or DOWN again before a frame was sent."""
        if state is before and state is not CanState.DOWN:
            return
        self._can_faults.on_state(state, now)
        self._finish(now)

    def can_returned(self, now: int, has_lost_frames: bool = False) -> None:
        faults = self._can_faults
        if faults.is_quiet:
            return
        if faults.is_held:
            faults.set_silence(faults.is_quiet, False, now)
            self._is_on = True
            faults.return_held(now)
        elif not self._is_on:
            self.start(now, can_open=True)
            return
        else:
            faults.returned(now, has_lost_frames)
        self._finish(now)

    def hold(self, now: int) -> None:
        faults = self._can_faults
        if not faults.is_held:
            faults.set_silence(faults.is_quiet, True, now)
            self._finish(now)

    def first_frame(self, now: int) -> CanFrame | None:
        """Return a boot-up if a node boots now, or a heartbeat if a node sends heartbeats."""
        begin = len(self.frames)
        is_held = self._can_faults.is_held
        if is_held and self._can_faults.boot_first(now):
            self._is_on = True
            boot_up = self.frames.pop(begin)
            self._finish(now)
            return boot_up
        for node in self.nodes:
            # In captures of earlier versions, a heartbeat was sent even if 1017h is 0.
            is_wanted = node.producer.is_on or not is_held
            if self._is_on and is_wanted and node.node_id != UNCONFIGURED:
                return node.heartbeat()
        return None

    def set_quiet(self, is_quiet: bool, now: int) -> None:
        self._can_faults.begin_outage()
        for node in self.nodes:
            node.consumer.set_quiet(is_quiet)
        self._can_faults.set_silence(is_quiet, self._can_faults.is_held, now)
        self._finish(now)

    def held_up(self, now: int) -> None:
        for node in self.nodes:
            node.tpdos.held_up(now)
            node.consumer.held_up(now)
        self._finish(now)

    def repeat_measurements(self, now: int) -> None:
        """Send PDOs again that are sent on change only, because waiting ones were discarded."""
        for node in self.nodes:
            node.tpdos.repeat(now)
        self._finish(now)

    def collision(self, esc: int, present: bool, now: int) -> None:
        self.nodes[esc].emergencies.set(GatewayError.ID_COLLISION, present, now)
        self._finish(now)

    def overrun(self, now: int) -> None:
        self._can_faults.overrun(now)
        self._finish(now)

    def advance(self, now: int) -> None:
        if now < self.due:
            return
        for node in self.nodes:
            if now >= node.due:
                node.advance(now)
        self._finish(now)

    # --- states and parameters of nodes

    def node_states(self) -> list[NodeState]:
        states = []
        for node in self.nodes:
            sent = sum(tpdo.sent for tpdo in node.tpdos)
            states.append(NodeState(node.claimed_node_id, node.state, sent))
        return states

    def take_news(self) -> list[LogLine]:
        """Return a line for each node whose state or node-ID is not the reported one."""
        if not self._is_on:
            return []
        reported = self._reported
        states = self.node_states()
        self._reported = states
        lines = []
        for index, (node_id, state, _) in enumerate(states):
            if reported and reported[index][:2] == (node_id, state):
                continue
            subject = f"{self.nodes[index].esc.settings.name}: {self.node_title}"
            words = f"{node_id} {name_in_words(state.name)}"
            if node_id == UNCONFIGURED:
                words = "waits for LSS"
            lines.append(LogLine(subject, f"{subject} {words}"))
        return lines

    def take_rejected_parameters(self) -> list[tuple[int, int]]:
        rejected = []
        for esc, node in enumerate(self.nodes):
            rejected += [(esc, key) for key in node.rejected]
            node.rejected = []
        return rejected

    def parameters_damaged(self, esc: int, now: int) -> None:
        """Report an unreadable parameter file, because of which a node runs on defaults."""
        self.nodes[esc].emergencies.set(GatewayError.PARAMETER_FILE, True, now)
        self._finish(now)

    def saved(self, esc: int, error: str | None, now: int) -> None:
        self.nodes[esc].saved(error, now)
        self._finish(now)

    # --- ids

    def own_ids(self) -> dict[int, Owner]:
        owners = {}
        for index, node in enumerate(self.nodes):
            for use in node.uses():
                if use.is_own:
                    owners[use.cob_id] = Owner(index, use.what)
        return owners

    # --- calls of the nodes (NodeHost)

    def send(self, frame: CanFrame) -> None:
        self.frames.append(frame)
        if frame.can_id in self._watched:
            self._to_watchers.append(frame)

    def note_change(self) -> None:
        self._has_changed = True
        self.revision += 1

    def is_cob_id_used(self, cob_id: int, user: object) -> bool:
        if cob_id in self._message_ids:
            return True
        for node in self.nodes:
            for use in node.uses():
                if use.cob_id == cob_id and use.user is not user:
                    return True
        return False

    def is_node_id_used(self, node_id: int, node: Node) -> bool:
        """Return True if a node cannot have this node-ID.

        Another node has it, now or from its next reset on, or one of the COB-IDs that follow from
        it has another user.
        """
        if node_id == UNCONFIGURED:
            return False
        used = set(self._message_ids)
        for other in self.nodes:
            if other is node:
                continue
            if node_id in (other.node_id, other.identity.pending_node_id):
                return True
            used.update(use.cob_id for use in other.uses())
        wanted = {first + node_id for first in OF_NODE_ID}
        for _, _, cob_id in default_ids(node.dictionary, node_id):
            wanted.add(cob_id)
        return not wanted.isdisjoint(used)

    # --- after each call

    def _finish(self, now: int) -> None:
        """Pass on watched heartbeats, make the routes if they have changed, compute ``due``."""
        while self._to_watchers:
            # Own frames do not come back from the bus, but one of our nodes may watch another.
            frame = self._to_watchers.popleft()
            _route(self._routes, frame, now, now)
        if self._has_changed and self._is_on:
            self._has_changed = False
            self._routes = _routes(self.nodes)
            self._watched = frozenset(
                HEARTBEAT + node_id for node in self.nodes for node_id in node.consumer.node_ids
            )
            self.receive_ids = frozenset(self._routes)
        for node in self.nodes:
            node.set_due()
        self.due = min([node.due for node in self.nodes])


def _route(routes: Mapping[int, Sequence[FrameTaker]], frame: CanFrame, now: int, at: int) -> None:
    """Give a frame that arrived ``at`` to the functions of its COB-ID."""
    for take in routes.get(frame.can_id, ()):
        take(frame.data, now, at)


def _routes(nodes: Sequence[Node]) -> dict[int, list[FrameTaker]]:
    """Return the functions that take received frames, by COB-ID."""
    routes: dict[int, list[FrameTaker]] = {}
    for node in nodes:
        for cob_id, take in node.routes():
            routes.setdefault(cob_id, []).append(take)
    return routes


class _CanFaults:
    """Faults of the CAN controller.

    They cause the emergencies 8110h, 8120h and 8140h and the error behaviour 1029h:1 of all nodes
    (CiA 301, 7.5.2.27). After an outage with held frames, each node that boots does so once: one as
    the first frame, the others when the frames are released. Without ``hold``, as in captures of
    earlier versions, they boot when the controller's state changes.
    """

    def __init__(self, nodes: Sequence[Node]) -> None:
        self._nodes = nodes
        self._next_overrun_ns = 0
        self.is_quiet = False
        self.is_held = False
        """True if no frame may leave. Frames of the return are made by it, not earlier."""
        self._is_on = False
        self._was_off = False
        self._has_outage = False
        self._booted: list[Node] = []
        """Nodes that have booted since the outage began."""
        self._is_unsent = False
        """True if frames about the end of an outage were made, and are not known to be sent.

        Only captures of earlier versions can have such frames.
        """
        self._unsent_was_off = False

    def power_on(self) -> None:
        """Forget faults from before the start."""
        self._is_on = True
        self._was_off = False
        self._has_outage = False

    def on_state(self, state: CanState, now: int) -> None:
        """Follow a new state of the CAN controller."""
        # Bus-off is worse than error-passive, so it does not end the emergency.
        if state in (CanState.ERROR_PASSIVE, CanState.ERROR_ACTIVE, CanState.ERROR_WARNING):
            for node in self._nodes:
                is_passive = state is CanState.ERROR_PASSIVE
                node.emergencies.set(GatewayError.CAN_PASSIVE, is_passive, now)
        if state in (CanState.BUS_OFF, CanState.DOWN):
            self._was_off = self._was_off or state is CanState.BUS_OFF
            self.begin_outage()  # a boot-up that was under way is lost
            for node in self._nodes:
                node.nmt.behave(1, now)
        elif self._has_outage and state is not CanState.UNKNOWN and not self.is_held:
            self.frames_pass(now)

    def begin_outage(self) -> None:
        """Note that frames cannot leave, or that quiet mode begins or ends, as after an outage."""
        self._has_outage = True
        self._booted = []

    def set_silence(self, is_quiet: bool, is_held: bool, now: int) -> None:
        """Let the nodes make no heartbeats and emergencies, or make them again."""
        self.is_quiet = is_quiet
        self.is_held = is_held
        is_silent = is_quiet or is_held
        for node in self._nodes:
            node.emergencies.is_quiet = is_silent
            if node.producer.is_quiet is not is_silent:
                node.producer.set_quiet(is_silent, now)

    def boot_first(self, now: int) -> bool:
        """Boot one more node. Returns False if no further node with a node-ID boots."""
        for node in self._nodes:
            has_id = node.identity.pending_node_id != UNCONFIGURED
            if has_id and node not in self._booted and self._boots(node):
                self._booted.append(node)
                self._boot(node, now)
                return True
        return False

    def return_held(self, now: int) -> None:
        """Follow the release of frames that were held."""
        ended = GatewayError.BUS_OFF_LEFT if self._was_off else None
        for node in self._nodes:
            if node in self._booted:
                node.repeat(now, ended)
            elif self._boots(node):
                self._boot(node, now)
                if ended is not None:
                    node.emergencies.pulse(ended, now)
            else:
                node.producer.beat(now)
                node.producer.advance(now)  # before the emergencies
                node.repeat(now, ended)
        self._is_on = True
        self._was_off = False
        self._has_outage = False
        self._is_unsent = False
        self._booted = []

    def _boots(self, node: Node) -> bool:
        """Return True if a node boots before its next frames."""
        if not self._is_on:
            return True
        has_id = node.node_id != UNCONFIGURED
        return self._has_outage and has_id and node.nmt.boots_after_outage

    def _boot(self, node: Node, now: int) -> None:
        if self._is_on:
            node.reset_communication(now)
        else:
            node.reset_node(now)

    def frames_pass(self, now: int) -> None:
        """Follow an interface that takes frames again after some were lost."""
        if self.is_quiet:
            return
        for node in self._nodes:
            if self._has_outage:
                node.returned(now)
            else:
                node.repeat(now)
            if self._was_off:
                node.emergencies.pulse(GatewayError.BUS_OFF_LEFT, now)
        self._is_unsent = self._has_outage
        self._unsent_was_off = self._was_off
        self._was_off = False
        self._has_outage = False

    def returned(self, now: int, has_lost_frames: bool) -> None:
        """Follow an interface that sends frames again. Discarded boot-ups are repeated."""
        if self._is_unsent and has_lost_frames:
            self._has_outage = True
            self._was_off = self._was_off or self._unsent_was_off
        if self._has_outage or not self._is_unsent:
            self.frames_pass(now)
        self._is_unsent = False

    def overrun(self, now: int) -> None:
        """Report a loss of received frames in the controller, at most once a second."""
        if now >= self._next_overrun_ns:
            self._next_overrun_ns = now + SECOND
            for node in self._nodes:
                node.emergencies.pulse(GatewayError.RECEIVE_OVERRUN, now)


def nodes_alone(
    setups: Sequence[NodeSetup],
    escs: Sequence[EscSettings],
    message_ids: Mapping[int, str],
) -> Nodes:
    """Return nodes without a gateway, to read their COB-IDs and objects.

    ``message_ids`` are the 11-bit ids that messages use, with their names.
    """
    no_messages = MessageLayout("", "", ())
    core = PythonCore(CoreSettings(escs, no_messages), 0)
    for can_id, name in message_ids.items():
        core.own_ids[can_id] = Owner(None, name)
    return Nodes(setups, core)


def traffic(nodes: Sequence[Node], is_worst: bool) -> tuple[float, float]:
    """Return PDOs and heartbeats per second, and the bits per second with the most stuffing.

    ``is_worst`` means that everything sent on change changes all the time.
    """
    rates: list[tuple[int, float]] = []
    for node in nodes:
        if node.node_id == UNCONFIGURED:
            continue
        period_ms = node.dictionary.number(0x1017)
        if period_ms:
            rates.append((_HEARTBEAT_BYTES, 1000 / period_ms))
        for tpdo in node.tpdos:
            rates.append((_PDO_BYTES, tpdo.rate_hz(is_worst)))
    frames = sum(rate for _, rate in rates)
    return frames, sum(classic_bits(size) * rate for size, rate in rates)
