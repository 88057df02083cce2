"""All CANopen nodes of a gateway on one bus: routing by COB-ID, one stream of frames out, no node disturbing another."""

from collections import deque
from collections.abc import Mapping, Sequence

from kontronik_can_gw.canopen.cob_ids import (
    HEARTBEAT,
    LSS_REQUEST,
    NMT,
    OF_NODE_ID,
    FrameTaker,
    default_ids,
    routes,
    uses,
)
from kontronik_can_gw.canopen.emergency_codes import GatewayError
from kontronik_can_gw.canopen.nmt import ALL_NODES, RESETS, command
from kontronik_can_gw.canopen.node import Node
from kontronik_can_gw.canopen.node_settings import NodeSetup
from kontronik_can_gw.core.output import LogLine, NodeOutput, NodeState, OutputHost, Owner
from kontronik_can_gw.core.python_core import PythonCore
from kontronik_can_gw.esc.telemetry import EscSettings, Event
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.signals.plan import Layout, classic_bits
from kontronik_can_gw.status import UNCONFIGURED, CanState, name_in_words
from kontronik_can_gw.times import NEVER, SECOND


class Nodes(NodeOutput):
    """One node for each ESC. No PDO may have an id in ``host.own_ids``."""

    node_title = "CANopen node"
    events = Event.LINK | Event.STATE

    def __init__(self, setups: Sequence[NodeSetup], host: OutputHost) -> None:
        super().__init__()
        self.due = NEVER
        self.slot = host.slot
        self.settings_changed = host.apply
        self._foreign_ids = host.own_ids
        self._routes: dict[int, list[FrameTaker]] = {}
        self.rerouted = True
        """A node uses other COB-IDs now."""
        self._rejected: list[tuple[int, int]] = []
        self._watched: frozenset[int] = frozenset()
        self._to_watchers: deque[CanFrame] = deque()
        self._started = False
        self._reported: list[NodeState] = []
        self.nodes = [
            Node(number, setup, esc, host.status, self)
            for number, (setup, esc) in enumerate(zip(setups, host.escs, strict=True))
        ]
        self._can_faults = _CanFaults(self.nodes)

    # --- what happens

    def start(self, now: int, can_open: bool) -> None:
        """Power on; without a bus that can hear it the nodes boot when there is one."""
        if not can_open:
            return
        self._started = True
        self._can_faults.power_on()
        for node in self.nodes:
            node.reset_node(now)
        self._after(now)

    def receive(self, frame: CanFrame, now: int, at: int) -> None:
        """A frame from the bus, which came ``at``. 29-bit and RTR frames are not CANopen frames of ours."""
        if frame.extended or frame.remote or frame.fd:
            return
        begin = len(self.frames)
        if frame.can_id == NMT and command(frame.data, ALL_NODES) in RESETS:
            for node in self.nodes:
                node.tpdos.release_ids()
        self._route(frame, now, at)
        if frame.can_id == LSS_REQUEST:
            # what several slaves send at the same time is one frame on a bus
            self.frames[begin:] = dict.fromkeys(self.frames[begin:])
        self._after(now)

    def next_deadline(self) -> int:
        return self.due

    def on_event(self, esc: int, events: int, now: int) -> None:
        node = self.nodes[esc]
        node.on_event(events, now)
        if self.rerouted or self._to_watchers:
            self._after(now)
        self.due = min(self.due, node.due)

    def on_can_state(self, before: CanState, state: CanState, now: int) -> None:
        """The CAN controller's state changed, or it is down again before a frame was sent."""
        if state is before and state is not CanState.DOWN:
            return
        self._can_faults.on_state(state, now)
        self._after(now)

    def can_returned(self, now: int) -> None:
        """Frames can be sent again after some were lost, or for the first time."""
        if not self._started:
            self.start(now, can_open=True)
            return
        self._can_faults.frames_pass(now)
        self._after(now)

    def held_up(self, now: int) -> None:
        for node in self.nodes:
            node.tpdos.held_up(now)
            node.consumer.held_up(now)
        self._after(now)

    def repeat_measurements(self, now: int) -> None:
        """PDOs that waited to be sent were dropped: send once more what is sent on change only."""
        for node in self.nodes:
            node.tpdos.repeat(now)
        self._after(now)

    def collision(self, esc: int, present: bool, now: int) -> None:
        self.nodes[esc].emergencies.set(GatewayError.ID_COLLISION, present, now)
        self._after(now)

    def node_states(self) -> list[NodeState]:
        return [
            NodeState(node.claimed_node_id, node.state, sum(tpdo.sent for tpdo in node.tpdos))
            for node in self.nodes
        ]

    def take_news(self) -> list[LogLine]:
        """Return a line for each node whose state or node-ID is not the reported one."""
        if not self._started:
            return []
        reported = self._reported
        self._reported = states = self.node_states()
        lines = []
        for index, (node_id, state, _) in enumerate(states):
            if reported and reported[index][:2] == (node_id, state):
                continue
            subject = f"{self.nodes[index].esc.settings.name}: CANopen node"
            words = f"{node_id} {name_in_words(state.name)}"
            if node_id == UNCONFIGURED:
                words = "waits for LSS"
            lines.append(LogLine(subject, f"{subject} {words}"))
        return lines

    def take_rejected_parameters(self) -> list[tuple[int, int]]:
        rejected, self._rejected = self._rejected, []
        return rejected

    def traffic(self, is_worst: bool = False) -> tuple[float, float]:
        """Frames a second of PDOs and heartbeats, and the bits that they need with the most stuffing.

        ``is_worst``: with all that is sent on change changing all the time.
        """
        rates: list[tuple[int, float]] = []
        for node in (node for node in self.nodes if node.node_id != UNCONFIGURED):
            if period := node.dictionary.number(0x1017):
                rates.append((1, 1000 / period))
            rates += [(8, t.worst_rate_hz if is_worst else t.rate_hz) for t in node.tpdos]
        return sum(rate for _, rate in rates), sum(classic_bits(n) * rate for n, rate in rates)

    def own_ids(self) -> dict[int, Owner]:
        """COB-IDs that only our nodes send with."""
        return {
            use.cob_id: Owner(index, use.what)
            for index, node in enumerate(self.nodes)
            for use in uses(node)
            if use.own
        }

    def overrun(self, now: int) -> None:
        self._can_faults.overrun(now)
        self._after(now)

    def parameters_damaged(self, esc: int, now: int) -> None:
        """A node's parameter file could not be read: it runs on defaults."""
        self.nodes[esc].emergencies.set(GatewayError.PARAMETER_FILE, True, now)
        self._after(now)

    def saved(self, esc: int, error: str | None, now: int) -> None:
        """The oldest request of an ESC's node to store is on disk, or failed for a reason."""
        self.nodes[esc].saved(error, now)
        self._after(now)

    def advance(self, now: int) -> None:
        if now < self.due:
            return
        for node in self.nodes:
            if now >= node.due:
                node.advance(now)
        self._after(now)

    # --- what nodes ask

    def reject(self, esc: int, keys: Sequence[int]) -> None:
        """Report stored values that a reset rejected."""
        self._rejected += [(esc, key) for key in keys]

    def send(self, frame: CanFrame) -> None:
        """Put a frame out."""
        self.frames.append(frame)
        if frame.can_id in self._watched:
            self._to_watchers.append(frame)

    def cob_id_taken(self, cob_id: int, user: object) -> bool:
        """Whether something else of the gateway uses this id; ``user`` as in ``Use``."""
        used = (use for node in self.nodes for use in uses(node))
        return cob_id in self._foreign_ids or any(
            use.cob_id == cob_id and use.user is not user for use in used
        )

    def node_id_taken(self, node_id: int, node: Node) -> bool:
        """Whether another node has this node-ID, now or from its next reset on, or another message a COB-ID of it."""
        if node_id == UNCONFIGURED:
            return False
        others = [other for other in self.nodes if other is not node]
        if any(node_id in (other.node_id, other.identity.pending_node_id) for other in others):
            return True
        wanted = {first + node_id for first in OF_NODE_ID}
        wanted |= {cob_id for _, _, cob_id in default_ids(node.dictionary, node_id)}
        used = {use.cob_id for other in others for use in uses(other)}
        return not wanted.isdisjoint(used | self._foreign_ids.keys())

    def _route(self, frame: CanFrame, now: int, at: int) -> None:
        for taker in self._routes.get(frame.can_id, ()):
            taker(frame.data, now, at)

    def _after(self, now: int) -> None:
        while self._to_watchers:
            # what we send does not come back from the bus: one of our nodes may watch another
            frame = self._to_watchers.popleft()
            self._route(frame, now, now)
        if self.rerouted and self._started:
            self.rerouted = False
            self._watched = frozenset(
                HEARTBEAT + node_id for node in self.nodes for node_id in node.consumer.node_ids
            )
            self._routes = {}
            for node in self.nodes:
                for cob_id, taker in routes(node):
                    self._routes.setdefault(cob_id, []).append(taker)
            self.receive_ids = frozenset(self._routes)
        for node in self.nodes:
            node.set_due()
        self.due = min([node.due for node in self.nodes])


class _CanFaults:
    """Trouble of the CAN controller: emergencies 8110h, 8120h, 8140h and error behaviour 1029h:1 of all nodes (CiA 301, 7.5.2.27)."""

    def __init__(self, nodes: Sequence[Node]) -> None:
        self._nodes = nodes
        self._next_overrun = 0
        self._off_bus = False
        self._outage = False

    def power_on(self) -> None:
        """What was before the start counts no more."""
        self._off_bus = self._outage = False

    def on_state(self, state: CanState, now: int) -> None:
        """The CAN controller's state changed."""
        # bus-off is worse than passive, not its end
        if state in (CanState.ERROR_PASSIVE, CanState.ERROR_ACTIVE, CanState.ERROR_WARNING):
            for node in self._nodes:
                is_passive = state is CanState.ERROR_PASSIVE
                node.emergencies.set(GatewayError.CAN_PASSIVE, is_passive, now)
        if state in (CanState.BUS_OFF, CanState.DOWN):
            self._off_bus = self._off_bus or state is CanState.BUS_OFF
            self._outage = True
            for node in self._nodes:
                node.nmt.behave(1, now)
        elif self._outage and state is not CanState.UNKNOWN:
            self.frames_pass(now)

    def frames_pass(self, now: int) -> None:
        """Frames can be sent again after some were lost."""
        for node in self._nodes:
            if self._outage:
                node.returned(now)
            else:
                node.repeat(now)
            if self._off_bus:
                node.emergencies.pulse(GatewayError.BUS_OFF_LEFT, now)
        self._off_bus = self._outage = False

    def overrun(self, now: int) -> None:
        """Received frames were lost in the controller: reported once a second at most."""
        if now >= self._next_overrun:
            self._next_overrun = now + SECOND
            for node in self._nodes:
                node.emergencies.pulse(GatewayError.RECEIVE_OVERRUN, now)


def nodes_alone(
    setups: Sequence[NodeSetup], escs: Sequence[EscSettings], message_ids: Mapping[int, str]
) -> Nodes:
    """Return nodes without a gateway, to read their COB-IDs and objects.

    ``message_ids`` are the 11-bit ids that messages use, with their names.
    """
    core = PythonCore(escs, Layout("", "", ()), 0, silent=False)
    core.own_ids = {can_id: Owner(None, name) for can_id, name in message_ids.items()}
    return Nodes(setups, core)
