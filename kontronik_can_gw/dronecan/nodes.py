"""The DroneCAN output: one node for the gateway, or one for each ESC, on one bus.

A node sends its status and log messages, and answers requests.
"""

import struct
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

from kontronik_can_gw.core.output import LogLine, Output, OutputHost, Owner
from kontronik_can_gw.dronecan import wire
from kontronik_can_gw.dronecan.allocation import Allocation
from kontronik_can_gw.dronecan.esc_report import EscReport
from kontronik_can_gw.dronecan.wire import NODE, REQUEST, SERVICE, Assembler, DataType
from kontronik_can_gw.esc.telemetry import Event
from kontronik_can_gw.frames import CanFrame, id_block
from kontronik_can_gw.signals.transfer import TRANSFER_ID, transfer
from kontronik_can_gw.status import CanState, GatewayStatus
from kontronik_can_gw.times import NEVER, SECOND

_ANSWERED = (wire.GET_NODE_INFO, wire.RESTART_NODE, wire.GET_SET)
SERVICES = {kind.number: kind for kind in _ANSWERED}
"""The services that a node offers, by number."""
_HARDWARE = (1, 0)
_VALUE_SIZES = (0, 8, 4, 1)
"""Length of a parameter's value by the tag of its union: none, integer, real, boolean."""
_STRING = 4
"""Tag of a string."""
Parameter = int | float | str
MAX_ANSWERS = 50
"""Maximum number of answers in a second, so that requests cannot keep the bus busy."""
_ALLOCATIONS = frozenset((id_block(0x100, 0xFFFF80), id_block(0x100, 0x3FF)))
"""Ids of Allocation messages: those of an allocation server, and the requests of other clients."""


class DronecanNodeSetup(NamedTuple):
    """The settings of one node."""

    node_id: int
    """0 if an allocation server chooses it."""
    name: str
    unique_id: bytes
    escs: tuple[int, ...]
    """The numbers of its ESCs."""


class Given(NamedTuple):
    """The data from which all nodes are made. A capture holds them."""

    table: Any
    """The DronecanConfig."""
    identity: bytes
    """A digest of the numbers that identify this machine. It is empty if there are none."""
    version: tuple[int, int]
    """Major and minor version of the program."""
    seed: int
    """A random number of 64 bits, chosen at each start."""


class DronecanNode:
    """One DroneCAN node of the gateway."""

    def __init__(
        self,
        setup: DronecanNodeSetup,
        given: Given,
        gateway: GatewayStatus,
        reports: Sequence[EscReport],
    ) -> None:
        self.setup = setup
        self.node_id = setup.node_id
        """0 while the node waits for a node-ID. It sends no messages then."""
        self.reports = [reports[number] for number in setup.escs]
        self.is_duplicate = False
        """True if another device sends with this node-ID."""
        self._gateway = gateway
        self._table = given.table
        self._version = given.version
        self._transfer_ids: dict[int, int] = {}

    def start(self, now: int) -> None:
        """Let the core send the measurements of the node's ESCs. The node must have a node-ID."""
        for place, report in enumerate(self.reports):
            report.start(self.node_id, place, now)

    def message(
        self,
        kind: DataType,
        payload: bytes,
        queued: bool = False,
        priority: int = wire.LOW,
    ) -> list[CanFrame]:
        """Return the frames of a broadcast message. ``queued`` as in CanFrame."""
        count = self._transfer_ids.get(kind.number, 0)
        self._transfer_ids[kind.number] = count + 1 & TRANSFER_ID
        can_id = wire.message_id(kind.number, self.node_id, priority)
        return transfer(can_id, kind.seed, payload, count, queued)

    def status(self, now: int, mode: int = wire.OPERATIONAL) -> bytes:
        """Return the payload of NodeStatus.

        The health of the ESCs is included only if the user has chosen it, because an autopilot does
        not arm while the health of a node is not OK.
        """
        gateway = self._gateway
        health = wire.OK
        if self.is_duplicate or gateway.can_state in (CanState.ERROR_PASSIVE, CanState.BUS_OFF):
            health = wire.WARNING
        code = 0
        for report in self.reports:
            code |= report.word
            if self._table.health == "esc":
                health = max(health, report.health)
        uptime_s = (now - gateway.started_ns) // SECOND
        state = health << 6 | mode << 3
        return wire.NODE_STATUS.pack(uptime_s & 0xFFFFFFFF, state, code & 0xFFFF)

    def answer(
        self,
        request_id: int,
        kind: DataType,
        request: bytes,
        transfer_id: int,
        now: int,
    ) -> list[CanFrame]:
        """Return the frames of the response to a request. Empty if the request is malformed.

        ``request_id`` is the CAN id of the request.
        """
        if kind is wire.GET_NODE_INFO:
            setup = self.setup
            status = self.status(now)
            software = (*self._version, 0, 0, 0)
            answer = wire.GET_NODE_INFO.pack(status, *software, *_HARDWARE, setup.unique_id, 0)
            answer += setup.name.encode("ascii")
        elif kind is wire.GET_SET:
            answer = _get_set(request, self._parameters())
        else:
            answer = wire.RESTART_NODE.pack(False)
        if not answer:
            return []
        return transfer(
            wire.response_id(request_id),
            kind.seed,
            answer,
            transfer_id,
            queued=True,
        )

    def _parameters(self) -> dict[str, Parameter]:
        table = self._table
        found: dict[str, Parameter] = {
            "rate_hz": table.rate_hz,
            "extended_hz": table.extended_hz,
            "rpm": table.rpm,
        }
        for report in self.reports:
            esc = report.esc
            name = esc.settings.name
            found[f"{name}.esc_index"] = report.index
            found[f"{name}.pole_pairs"] = esc.pole_pairs
            gear = esc.shaft_divisor / (esc.pole_pairs * esc.gear_denominator)
            found[f"{name}.gear"] = gear
        return found


def _get_set(request: bytes, parameters: dict[str, Parameter]) -> bytes:
    """Return the response of param.GetSet. Empty if the request is malformed.

    The parameter is selected by the name in the request, or by the index if the name is empty. A
    value in the request is ignored, because parameters can only be read.
    """
    if len(request) < 2:
        return b""
    index = request[0] | request[1] >> 3 << 8
    tag = request[1] & 7
    if tag > _STRING:
        return b""
    if tag == _STRING:
        start = 3 + int.from_bytes(request[2:3])
    else:
        start = 2 + _VALUE_SIZES[tag]
    if len(request) < start:
        return b""
    name = request[start:].decode("latin-1")
    if not name and index < len(parameters):
        name = list(parameters)[index]
    value = parameters.get(name)
    if value is None:
        return bytes(4)
    if isinstance(value, str):
        packed = bytes((_STRING, len(value))) + value.encode("ascii")
    elif isinstance(value, int):
        packed = struct.pack("<Bq", 1, value)
    else:
        packed = struct.pack("<Bf", 2, value)
    # The default and the limits are empty, because the parameter cannot be set.
    return packed + bytes(3) + name.encode("ascii")


class Dronecan(Output):
    """All nodes, and the ESCs of ``host`` that they report."""

    name = "dronecan"
    events = Event.STATE

    def __init__(
        self,
        setups: Sequence[DronecanNodeSetup],
        given: Given,
        host: OutputHost,
    ) -> None:
        super().__init__()
        table = given.table
        self._table = table
        self._reports = []
        for number, esc in enumerate(host.escs):
            report = EscReport(esc, table.first_index + number, table)
            report.take_slots(partial(host.slot, number))
            self._reports.append(report)
        self._nodes = [DronecanNode(setup, given, host.status, self._reports) for setup in setups]
        self._by_id: dict[int, DronecanNode] = {}
        """The nodes that have a node-ID."""
        self._allocation = Allocation(given.seed)
        self._assembler = Assembler()
        self._answered = 0
        """Number of answered requests since the start."""
        self._unanswered = 0
        """Number of requests that exceeded MAX_ANSWERS."""
        self._answers = 0
        """Number of answers since ``_answers_since``."""
        self._answers_since = 0
        """Start of the present second of answers."""
        self._second_due = NEVER
        self._is_quiet = False
        self._news: list[LogLine] = []
        self._update_ids()

    # --- calls of the gateway, see Output

    def start(self, now: int, can_open: bool) -> None:
        self.repeat_measurements(now)
        for node in self._by_id.values():
            node.start(now)
        self._ask(now)

    def stop(self, now: int) -> None:
        for report in self._reports:
            report.stop()
        if not self._is_quiet:
            self._send_offline(now)

    def can_returned(self, now: int, has_lost_frames: bool = False) -> None:
        self._log_again()
        self.repeat_measurements(now)

    def set_quiet(self, is_quiet: bool, now: int) -> None:
        self._is_quiet = is_quiet
        if is_quiet:
            self._send_offline(now)
        else:
            self._ask(now)
            self._second_due = now + SECOND

    def on_can_state(self, before: CanState, state: CanState, now: int) -> None:
        if before is CanState.BUS_OFF and state not in (CanState.BUS_OFF, CanState.DOWN):
            self._log_again()

    def first_frame(self, now: int) -> CanFrame | None:
        for node in self._by_id.values():
            return node.message(wire.NODE_STATUS, node.status(now), priority=wire.LOWEST)[0]
        return None

    def repeat_measurements(self, now: int) -> None:
        self._second_due = now

    def next_deadline(self) -> int:
        if self._is_quiet:
            return NEVER
        return min(self._second_due, self._allocation.due)

    def on_event(self, esc: int, events: int, now: int) -> None:
        self._reports[esc].update(events, now)

    def collision(self, esc: int, present: bool, now: int) -> None:
        self._nodes[esc].is_duplicate = present

    def advance(self, now: int) -> None:
        if self._is_quiet:
            return
        if now >= self._allocation.due:
            self.frames += self._allocation.advance(now)
        due = self._second_due
        if now >= due:
            # Missed seconds are skipped.
            has_missed = now - due >= SECOND
            self._second_due = SECOND + (now if has_missed else due)
            self._send_second(now)

    def receive(self, frame: CanFrame, now: int, at: int) -> None:
        if (frame.extended, frame.remote, frame.fd) != (True, False, False):
            return
        can_id = frame.can_id
        source = can_id & NODE
        if not can_id & SERVICE:
            number_bits = 0xFFFF if source else 3  # a sender without a node-ID has two bits only
            number = can_id >> 8 & number_bits
            if number == wire.ALLOCATION.number and self._allocation.due != NEVER:
                self._receive_allocation(frame, source, now)
        elif can_id & REQUEST and source:
            node = self._by_id.get(can_id >> 8 & NODE)
            kind = SERVICES.get(can_id >> 16 & 0xFF)
            if node is not None and kind is not None:
                self._receive_request(frame, node, kind, now)

    def own_ids(self) -> dict[int, Owner]:
        """Return the ids that have one of our nodes as their source."""
        owners = {}
        for number, node in enumerate(self._nodes):
            if node.node_id:
                owner = Owner(number, f"DroneCAN node-ID {node.node_id}")
                owners[id_block(node.node_id, NODE)] = owner
        return owners

    def take_news(self) -> list[LogLine]:
        news = self._news
        self._news = []
        return news

    def facts(self) -> dict[str, Any]:
        nodes = []
        lines = []
        for node in self._nodes:
            state = "operational"
            if node.is_duplicate:
                state = "another device has this node-ID"
            if not node.node_id:
                state = f"waits for a node-ID, {self._allocation.requests} requests"
            name = node.setup.name
            fact = {
                "node_id": node.node_id or None,
                "name": name,
                "state": state,
            }
            nodes.append(fact)
            number = f"{node.node_id} " if node.node_id else ""
            lines.append(f"DroneCAN {number}{name}: {state}")
        return {
            "lines": lines,
            "nodes": nodes,
            "status_sent": sum(report.status_sent for report in self._reports),
            "requests_answered": self._answered,
            "requests_unanswered": self._unanswered,
            "transfer_errors": self._assembler.errors,
            "node_ids_refused": self._allocation.refused,
        }

    # --- requests

    def _receive_request(
        self, frame: CanFrame, node: DronecanNode, kind: DataType, now: int
    ) -> None:
        """Answer a request when its last frame has arrived, at most MAX_ANSWERS a second."""
        request = self._assembler.receive(frame.can_id, frame.data, kind.seed, now)
        if request is None:
            return
        if now - self._answers_since >= SECOND:
            self._answers_since = now
            self._answers = 0
        if self._answers >= MAX_ANSWERS:
            self._unanswered += 1
            return
        transfer_id = frame.data[-1] & TRANSFER_ID
        answer = node.answer(frame.can_id, kind, request, transfer_id, now)
        if answer:
            self._answers += 1
            self._answered += 1
            self.frames += answer

    # --- messages

    def _send_second(self, now: int) -> None:
        """Send the messages of each second."""
        for report in self._reports:
            report.update(0, now)
        for node in self._by_id.values():
            self._send_node_status(node, now, wire.OPERATIONAL)
            if not self._table.log_messages:
                continue
            for report in node.reports:
                for message in report.log(now):
                    self.frames += node.message(wire.LOG_MESSAGE, message, queued=True)

    def _log_again(self) -> None:
        for report in self._reports:
            report.log_again()

    def _send_offline(self, now: int) -> None:
        for node in self._by_id.values():
            self._send_node_status(node, now, wire.OFFLINE)

    def _send_node_status(self, node: DronecanNode, now: int, mode: int) -> None:
        status = node.status(now, mode)
        self.frames += node.message(wire.NODE_STATUS, status, priority=wire.LOWEST)

    # --- node-IDs

    def _ask(self, now: int) -> None:
        """Ask for the node-ID of the first node that has none."""
        node = self._first_waiting()
        unique_id = b"" if node is None else node.setup.unique_id
        self._allocation.ask(unique_id, now)
        self._update_ids()

    def _first_waiting(self) -> DronecanNode | None:
        """Return the first node without a node-ID."""
        return next((node for node in self._nodes if not node.node_id), None)

    def _receive_allocation(self, frame: CanFrame, source: int, now: int) -> None:
        seed = wire.ALLOCATION.seed
        payload = self._assembler.receive(frame.can_id, frame.data, seed, now)
        if payload is None:
            return
        taken = set(self._by_id)
        node_id = self._allocation.receive(source, payload, taken, now)
        node = self._first_waiting()
        if node_id is None or node is None:
            return
        node.node_id = node_id
        text = f"DroneCAN node {node.setup.name}: has node-ID {node_id}"
        self._news.append(LogLine(text, text))
        self.revision += 1
        self._second_due = now  # the node reports itself at once
        node.start(now)
        self._ask(now)

    def _update_ids(self) -> None:
        """Update the ids to receive after a change of node-IDs."""
        self._by_id = {node.node_id: node for node in self._nodes if node.node_id}
        requests = SERVICE | REQUEST
        mask = requests | NODE << 8
        blocks = set()
        for node_id in self._by_id:
            blocks.add(id_block(requests | node_id << 8, mask))
        if self._first_waiting() is not None:
            blocks |= _ALLOCATIONS
        self.receive_ids = frozenset(blocks)
