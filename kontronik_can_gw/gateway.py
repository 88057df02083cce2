"""The assembly of the pure core, and the only surface the runtime sees: bytes, CAN frames and time in, CAN frames and deadlines out.

``now`` is integer nanoseconds of one monotonic clock: the loop's when live, the capture's in replay.
"""

from collections.abc import Mapping, Sequence

from kontronik_can_gw.canopen.nmt import NmtState
from kontronik_can_gw.canopen.nodes import CanopenSetup, Nodes
from kontronik_can_gw.canopen.storage import Stored
from kontronik_can_gw.dbc.output import DbcOutput
from kontronik_can_gw.esc.telemetry import SECOND, EscSettings, EscTelemetry, Event
from kontronik_can_gw.esc.values import CanState, GatewayState, GatewayStatus
from kontronik_can_gw.frames import EXTENDED, CanFrame
from kontronik_can_gw.signals.plan import Layout

_CONFLICT_NS = 10 * SECOND
"""So long without a further one, and a conflict of ids is over."""
_ECHO_NS = SECOND // 5
_NOTHING: frozenset[int] = frozenset()


class Conflict:
    """Somebody else sends with an id of ours. ``whose``: what it is here; ``over``: that has ceased."""

    def __init__(self, key: int, whose: str, node: int | None, now: int) -> None:
        self.key = key
        self.whose = whose
        self.node = node
        self.begun = self.last = now
        self.count = 0
        self.over = False

    @property
    def can_id(self) -> int:
        return self.key & ~EXTENDED

    @property
    def is_extended(self) -> bool:
        return bool(self.key & EXTENDED)


class Gateway:
    """One gateway: several ESCs in, one CAN bus out. ``canopen`` None: no CANopen nodes; a layout without messages: no DBC output."""

    def __init__(
        self,
        escs: Sequence[EscSettings],
        layout: Layout,
        now: int,
        silent_on_loss: bool = False,
        canopen: CanopenSetup | None = None,
    ) -> None:
        self.escs = [EscTelemetry(settings, now) for settings in escs]
        self.status = GatewayStatus(esc_count=len(escs), started_ns=now)
        self._output = DbcOutput(layout, self.escs, self.status, now, silent_on_loss)
        self.nodes: Nodes | None = None
        if canopen is not None:
            ids = {m.can_id: f"message {m.name}" for m in layout.messages if not m.extended}
            self.nodes = Nodes(canopen, self.escs, self.status, self._apply, ids)
        self._message_ids = {
            m.can_id | (EXTENDED if m.extended else 0): (None, f"message {m.name}")
            for m in layout.messages
        }
        self._own_ids: Mapping[int, tuple[int | None, str]] = {}
        self._receive_ids: frozenset[int] = frozenset()
        self._routed: frozenset[int] | None = None
        self._conflicts: dict[int, Conflict] = {}
        self._echoes_until = 0
        self._conflict_news: list[Conflict] = []
        self._follow_ids()
        self._link_changes: list[int] = []
        self._dropped = False
        self._told_ns = now
        self.shortest_timeout_ns = self._shortest_timeout()
        """Of all ESCs: live data of one is not available after this."""
        self._next_expiry = 0
        """No ESC has a deadline before this: they only move on, but for a link that comes up, which sets this back."""

    def start(self, now: int, can_open: bool = True) -> None:
        """The runtime has opened what it could: run. Nodes boot when there is a bus that can hear it."""
        self.status.state = GatewayState.RUNNING
        self._output.start(now)
        if self.nodes is not None and can_open:
            self.nodes.start(now)

    def stop(self, now: int) -> None:
        """The last word: a status that says the gateway is going."""
        self.status.state = GatewayState.STOPPING
        self._output.on_gateway_change(now, at_once=True)

    def receive_bytes(self, esc: int, data: bytes, now: int, since: int) -> None:
        """Bytes of one ESC's UART, read at ``now``. ``since``: none of them had come by then (telemetry.py, Arrival)."""
        if now >= self._next_expiry:
            self._expire(now, but=esc)  # a message may hold values of several ESCs
        for events in self.escs[esc].receive_each(data, now, since):
            self._follow(esc, events, now)

    @property
    def receive_ids(self) -> frozenset[int]:
        """The ids (29-bit ones with EXTENDED) of the frames that ``receive_frame`` is to be given; the same object until they change.

        Those that the nodes listen to, and those that only this gateway sends with: who else does is to be noticed.
        """
        if self.nodes is not None and self.nodes.receive_ids is not self._routed:
            self._follow_ids()
        return self._receive_ids

    def receive_frame(self, frame: CanFrame, now: int, at: int) -> None:
        """A data frame of somebody else with one of ``receive_ids``, read at ``now``; it came ``at``."""
        self._follow_ids()
        if (own := self._own_ids.get(frame.key)) is not None and not frame.remote:
            self._collide(frame.key, own, now)
        if self.nodes is not None:
            self._expire(now)
            self.nodes.receive(frame, now, at)

    def can_opened(self, now: int) -> None:
        """The interface was opened (again): what we sent before may still come back, and is no conflict."""
        self._echoes_until = now + _ECHO_NS

    @property
    def first_message_id(self) -> int | None:
        """The lowest id of the DBC output's messages; None without any."""
        return min(self._message_ids, default=None)

    def take_conflicts(self) -> list[Conflict]:
        """Conflicts of ids that have begun, or are over, since the last call."""
        news, self._conflict_news = self._conflict_news, []
        return news

    def receive_overrun(self, now: int) -> None:
        """The CAN controller lost received frames."""
        if self.nodes is not None:
            self.nodes.overrun(now)

    def take_saves(self) -> list[tuple[int, Stored]]:
        """Parameters to store, (ESC, what), oldest first; each is answered by one call of ``saved`` for that ESC, in this order."""
        if self.nodes is None or not self.nodes.saves:
            return []
        saves, self.nodes.saves = self.nodes.saves, []
        return saves

    def take_misfits(self) -> list[tuple[int, int]]:
        """Stored values that did not hold at a node's reset: (ESC, index << 8 | sub-index)."""
        if self.nodes is None or not self.nodes.misfits:
            return []
        misfits, self.nodes.misfits = self.nodes.misfits, []
        return misfits

    def saved(self, esc: int, error: str | None, now: int) -> None:
        """An ESC's parameters are on disk; or could not be stored, and why."""
        if self.nodes is not None:
            self.nodes.saved(esc, error, now)

    def parameters_damaged(self, esc: int, now: int) -> None:
        """What was stored for an ESC could not be read: its node runs on defaults and says so."""
        if self.nodes is not None:
            self.nodes.parameters_damaged(esc, now)

    def port_opened(self, esc: int, now: int) -> None:
        """An ESC's port is open (again)."""
        self._follow(esc, self.escs[esc].port_opened(), now)

    def port_lost(self, esc: int, now: int) -> None:
        """An ESC's port cannot be used: its values are not available from now on."""
        self._follow(esc, self.escs[esc].port_lost(), now)

    def can_returned(self, now: int) -> None:
        """Frames can be sent again after some were lost: say everything that has no cycle once more."""
        self._expire(now)
        self._output.start(now)
        if self.nodes is not None:
            self.nodes.can_returned(now)

    def held_up(self, now: int, dropped: bool) -> None:
        """The process was held up. Commands that waited are obeyed, SYNCs that waited are not answered any more.

        ``dropped``: measurements that waited to be sent were dropped: they are made anew with the next ``advance``, of what came by then.
        """
        self._expire(now)
        self._dropped = dropped
        if self.nodes is not None:
            self.nodes.held_up(now)

    def set_can_state(self, state: CanState, now: int) -> None:
        """What the runtime knows of the CAN controller."""
        self._expire(now)
        if state is not self.status.can_state:
            was_off = self.status.can_state is CanState.BUS_OFF
            self.status.can_state = state
            self._output.on_gateway_change(now)
            if self.nodes is not None:
                self.nodes.on_can_state(state, now)
            if was_off and state is not CanState.DOWN:
                # what was handed over meanwhile never reached the bus
                self._output.start(now)
        elif state is CanState.DOWN and self.nodes is not None:
            # down again before a frame was sent
            self.nodes.on_can_state(state, now)

    def advance(self, now: int) -> None:
        """Let time pass: time-outs, cyclic messages."""
        if now >= self._next_expiry:
            self._expire(now)
        if self._dropped:
            self._dropped = False
            self._output.start(now)
            if self.nodes is not None:
                self.nodes.make_anew(now)
        self._output.advance(now)
        if self.nodes is not None:
            self.nodes.advance(now)

    def message_bits(self, message: int, now: int, page: int | None = None) -> int:
        """What the layout's message of this index would hold if it were sent now, alive counter and CRC 0; bit 0 is bit 0 of byte 0."""
        return self._output.bits(message, now, page)

    def next_deadline(self) -> int:
        """When ``advance`` is to be called at the latest."""
        expiry = self._next_expiry or min(esc.next_deadline() for esc in self.escs)
        if self.nodes is not None:
            expiry = min(expiry, self.nodes.due)
        output = self._output.next_deadline()
        return expiry if output is None or expiry < output else output

    @property
    def frames_wait(self) -> bool:
        """True while ``take_frames`` has something to hand over."""
        return bool(self._output.frames) or (self.nodes is not None and bool(self.nodes.frames))

    def take_frames(self) -> list[CanFrame]:
        """The frames to send, oldest first; the list is handed over."""
        frames = self._output.take()
        if self.nodes is not None and self.nodes.frames:
            frames = self.nodes.take() + frames
        return frames

    def not_sent(self, now: int) -> None:
        """The frames that were taken last were thrown away. The gateway itself need not know; who records it does."""

    def take_link_changes(self) -> list[int]:
        """ESCs whose link state, layout or device changed since the last call."""
        if not self._link_changes:
            return []
        changes, self._link_changes = self._link_changes, []
        return changes

    @property
    def node_changes(self) -> int:
        """Grows with each change of a node's NMT state or node-ID."""
        return 0 if self.nodes is None else self.nodes.state_changes

    @property
    def node_ids(self) -> list[int]:
        """Node-IDs of the CANopen nodes; before the start those that they will have."""
        return [] if self.nodes is None else [node.claimed_node_id for node in self.nodes.nodes]

    def node_states(self) -> list[tuple[int, NmtState, int]]:
        """Of each ESC's CANopen node: node-ID, NMT state, PDOs sent so far. Empty without nodes."""
        if self.nodes is None:
            return []
        return [
            (node.claimed_node_id, node.state, sum(tpdo.sent for tpdo in node.tpdos))
            for node in self.nodes.nodes
        ]

    def _expire(self, now: int, but: int | None = None) -> None:
        """What is too old by now goes before anything is sent."""
        if now < self._next_expiry:
            return
        for index, esc in enumerate(self.escs):
            if index != but and now >= esc.next_deadline():
                self._follow(index, esc.advance(now), now)
        self._next_expiry = min(esc.next_deadline() for esc in self.escs)
        if now - self._told_ns >= SECOND:
            self._told_ns = now
            self._end_conflicts(now)
            self._output.on_gateway_change(now, each_second=True)

    def _follow(self, esc: int, events: int, now: int) -> None:
        if events:
            self._output.on_event(esc, events, now)
            if self.nodes is not None:
                self.nodes.on_event(esc, events, now)
        if events & Event.LINK:
            self._next_expiry = min(self._next_expiry, self.escs[esc].next_deadline())
            self._link_changes.append(esc)
            escs_ok = sum([e.live is not None for e in self.escs])
            if escs_ok != self.status.escs_ok:
                self.status.escs_ok = escs_ok
                self._output.on_gateway_change(now)

    def _follow_ids(self) -> None:
        routed = _NOTHING if self.nodes is None else self.nodes.receive_ids
        if routed is self._routed:
            return
        self._routed = routed
        own: dict[int, tuple[int | None, str]] = dict(self._message_ids)
        if self.nodes is not None:
            own |= self.nodes.own_ids()
        self._own_ids = own
        self._receive_ids = routed | frozenset(own)

    def _collide(self, key: int, own: tuple[int | None, str], now: int) -> None:
        if now < self._echoes_until:
            return
        self.status.id_conflicts += 1
        conflict = self._conflicts.get(key)
        if conflict is None:
            conflict = self._conflicts[key] = Conflict(key, own[1], own[0], now)
            self._conflict_news.append(conflict)
            if self.nodes is not None and conflict.node is not None:
                self.nodes.collision(conflict.node, True, now)
        conflict.count += 1
        conflict.last = now

    def _end_conflicts(self, now: int) -> None:
        for conflict in [c for c in self._conflicts.values() if now - c.last > _CONFLICT_NS]:
            conflict.over = True
            del self._conflicts[conflict.key]
            self._conflict_news.append(conflict)
            others = {other.node for other in self._conflicts.values()}
            if self.nodes is not None and conflict.node is not None and conflict.node not in others:
                self.nodes.collision(conflict.node, False, now)

    def _apply(self, esc: int, settings: EscSettings) -> None:
        """Settings that came over the bus: they hold for everything that is sent, the DBC's messages too."""
        self.escs[esc].apply(settings)
        self.shortest_timeout_ns = self._shortest_timeout()
        self._next_expiry = 0

    def _shortest_timeout(self) -> int:
        return min(esc.settings.timeout_ns for esc in self.escs)
