"""The DroneCAN output: the gateway's node, or one for each ESC, on one bus."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.dronecan import types
from kontronik_can_gw.dronecan.allocation import Allocation
from kontronik_can_gw.dronecan.esc_report import EscReport
from kontronik_can_gw.dronecan.node import SERVICES, Node
from kontronik_can_gw.dronecan.transport import Assembler, header
from kontronik_can_gw.esc.telemetry import SECOND, EscTelemetry, Event
from kontronik_can_gw.frames import CanFrame, id_block
from kontronik_can_gw.gateway_status import CanState, GatewayStatus
from kontronik_can_gw.output import NEVER, Output, Owner

if TYPE_CHECKING:
    from kontronik_can_gw.dronecan.setup import DronecanSetup

MAX_ANSWERS = 50
"""Requests that are answered in a second: nobody keeps the bus busy by asking."""
_LOG_NS = SECOND // 2
_SOURCE = 0x7F
_REQUEST_TO, _TO_MASK = 0x8080, 0xFF80
_ALLOCATION_OF_NODE, _ALLOCATION_OF_NONE = (0x100, 0xFFFF80), (0x100, 0x3FF)
"""Id and mask of Allocation messages: of an allocator, of others that ask."""


class _Task:
    """What is done at an interval."""

    def __init__(self, period_ns: int, do: Callable[[int], None]) -> None:
        self.due = NEVER
        self.do = do
        self._period = period_ns

    def go_on(self, now: int) -> None:
        self.due += self._period
        if self.due <= now:  # late: none is made up for
            self.due = now + self._period


class Dronecan(Output):
    """All nodes, and the ESCs that they report."""

    name = "dronecan"
    events = Event.STATE

    def __init__(
        self,
        setup: "DronecanSetup",
        escs: Sequence[EscTelemetry],
        gateway: GatewayStatus,
    ) -> None:
        super().__init__()
        self._gateway = gateway
        table = setup.given.table
        self._reports = [
            EscReport(esc, table.first_index + number, table.rpm) for number, esc in enumerate(escs)
        ]
        self._nodes = [Node(each, setup, self._reports, self._put) for each in setup.nodes]
        self._by_id: dict[int, Node] = {}
        self._allocation = Allocation(setup.given.seed)
        self._assembler = Assembler()
        self._status_sent = self._answered = self._unanswered = self._answers = 0
        self._each_second = _Task(SECOND, self._say_second)
        self._tasks = [self._each_second, _Task(SECOND // table.rate_hz, self._say_status)]
        if table.extended_hz:
            self._tasks.append(_Task(SECOND // table.extended_hz, self._say_extended))
        if table.log_messages:
            self._tasks.append(_Task(_LOG_NS, self._say_log))
        self._due = NEVER
        self._follow_ids()

    # --- what happens

    def start(self, now: int, can_open: bool) -> None:
        self._all_due(now)
        self._ask(now)

    def stop(self, now: int) -> None:
        for node in self._by_id.values():
            node.say_status(self._status_of(node, now, types.OFFLINE))

    def can_returned(self, now: int) -> None:
        self._log_anew()
        self._all_due(now)

    def on_can_state(self, before: CanState, state: CanState, now: int) -> None:
        if before is CanState.BUS_OFF and state not in (CanState.BUS_OFF, CanState.DOWN):
            self._log_anew()

    def make_anew(self, now: int) -> None:
        self._all_due(now)

    def next_deadline(self) -> int:
        return self._due

    def on_event(self, esc: int, events: int, now: int) -> None:
        self._reports[esc].follow(events)

    def collision(self, esc: int, present: bool, now: int) -> None:
        self._nodes[esc].is_duplicate = present

    def advance(self, now: int) -> None:
        if now < self._due:
            return
        for task in self._tasks:
            if now >= task.due:
                task.go_on(now)
                task.do(now)
        self.frames += self._allocation.advance(now)
        self._set_due()

    def receive(self, frame: CanFrame, now: int, at: int) -> None:
        if not frame.extended or frame.remote or frame.fd:
            return
        head = header(frame.can_id)
        if head.to is None:
            if head.kind == types.ALLOCATION.number and self._allocation.due != NEVER:
                self._take_allocation(frame, head.source, now)
            return
        node, service = self._by_id.get(head.to), SERVICES.get(head.kind)
        if node is None or service is None or not head.is_request or not head.source:
            return
        whole = self._assembler.receive(frame.can_id, frame.data, service.seed, now)
        if whole is None:
            return
        if self._answers >= MAX_ANSWERS:
            self._unanswered += 1
            return
        status = self._status_of(node, now)
        answer = node.answer(service, whole.payload, status)
        if answer is not None:
            self._answers += 1
            self._answered += 1
            node.respond(frame.can_id, service, answer, whole.transfer_id)

    def own_ids(self) -> dict[int, Owner]:
        """Whatever has one of our nodes as its source."""
        return {
            id_block(node.node_id, _SOURCE): Owner(number, f"DroneCAN node-ID {node.node_id}")
            for number, node in enumerate(self._nodes)
            if node.node_id
        }

    def facts(self) -> dict[str, Any]:
        waits = f"waits for a node-ID, {self._allocation.requests} requests"
        nodes = [
            {
                "node_id": node.node_id or None,
                "name": node.setup.name,
                "state": waits
                if not node.node_id
                else "another device has this node-ID"
                if node.is_duplicate
                else "operational",
            }
            for node in self._nodes
        ]
        return {
            "lines": [
                f"DroneCAN {each['node_id'] or ''}".rstrip() + f" {each['name']}: {each['state']}"
                for each in nodes
            ],
            "nodes": nodes,
            "status_sent": self._status_sent,
            "requests_answered": self._answered,
            "requests_unanswered": self._unanswered,
            "transfer_errors": self._assembler.errors,
            "node_ids_refused": self._allocation.refused,
        }

    # --- what is said

    def _say_status(self, now: int) -> None:
        for node in self._by_id.values():
            for place, report in enumerate(node.reports):
                if (payload := report.status()) is not None:
                    self._status_sent += 1
                    node.send(types.STATUS, payload, page=3 * place)

    def _say_extended(self, now: int) -> None:
        for node in self._by_id.values():
            for place, report in enumerate(node.reports):
                if (payload := report.status_extended()) is not None:
                    node.send(types.STATUS_EXTENDED, payload, page=place)

    def _say_second(self, now: int) -> None:
        self._answers = 0
        for node in self._by_id.values():
            node.say_status(self._status_of(node, now))
            for place, report in enumerate(node.reports):
                if (found := report.bec()) is not None:
                    node.send(types.CIRCUIT_STATUS, found[0], page=place)
                    node.send(types.TEMPERATURE, found[1], page=place)

    def _say_log(self, now: int) -> None:
        for node in self._by_id.values():
            for report in node.reports:
                for message in report.log(now):
                    node.send(types.LOG_MESSAGE, message, queued=True)

    def _log_anew(self) -> None:
        """What was logged may never have reached the bus."""
        for report in self._reports:
            report.log_anew()

    def _status_of(self, node: Node, now: int, mode: int = types.OPERATIONAL) -> bytes:
        bus_is_well = self._gateway.can_state not in (CanState.ERROR_PASSIVE, CanState.BUS_OFF)
        return node.status((now - self._gateway.started_ns) // SECOND, mode, bus_is_well)

    # --- node-IDs

    def _ask(self, now: int) -> None:
        """Ask for the node-ID of the first node without one."""
        for node in self._nodes:
            if not node.node_id:
                self._allocation.begin(node.setup.unique_id, now)
                break
        else:
            self._allocation.stop()
        self._follow_ids()
        self._set_due()

    def _take_allocation(self, frame: CanFrame, source: int, now: int) -> None:
        whole = self._assembler.receive(frame.can_id, frame.data, types.ALLOCATION.seed, now)
        if whole is None:
            return
        node_id = self._allocation.receive(source, whole.payload, set(self._by_id), now)
        if node_id is not None:
            node = next(node for node in self._nodes if not node.node_id)
            node.node_id = node_id
            self.news.append(f"DroneCAN node {node.setup.name}: has node-ID {node_id}")
            self.state_changes += 1
            self._each_second.due = now
            self._ask(now)
        self._set_due()

    def _follow_ids(self) -> None:
        """Receive what is for the nodes as they are now; make the ids of the bus anew."""
        self._by_id = {node.node_id: node for node in self._nodes if node.node_id}
        blocks = [id_block(_REQUEST_TO | node_id << 8, _TO_MASK) for node_id in self._by_id]
        if len(self._by_id) < len(self._nodes):
            blocks += [id_block(*_ALLOCATION_OF_NODE), id_block(*_ALLOCATION_OF_NONE)]
        self.receive_ids = frozenset(blocks)

    def _put(self, frames: list[CanFrame]) -> None:
        self.frames += frames

    def _all_due(self, now: int) -> None:
        for task in self._tasks:
            task.due = now
        self._set_due()

    def _set_due(self) -> None:
        self._due = min(self._allocation.due, *[task.due for task in self._tasks])
