"""Each call that changes what a gateway sends is in the table of recorded calls."""

import inspect
from typing import Any

import pytest

from kontronik_can_gw.capture.calls import CALL_OF, CALLS, RecordedCall, calls_by_method
from kontronik_can_gw.capture.format import Entry, EntryKind
from kontronik_can_gw.capture.recorded_gateway import RecordedGateway
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.native.header import KCG
from kontronik_can_gw.status import CanState

pytestmark = pytest.mark.promise("recorded-calls")

NOT_CALLS = {
    "not_sent": "a note about the frames of the last call",
    "take_frames": "follows from the calls that take frames",
}
"""Methods with a time that no replay has to repeat, and why."""
NOTES = {
    EntryKind.COUNTERS,
    EntryKind.LINE_ERRORS,
    EntryKind.CLOCK,
    EntryKind.LOST,
    EntryKind.NOT_SENT,
    EntryKind.STATE,
}
"""Kinds of entries that are not calls."""
EXAMPLES: dict[str, list[tuple[Any, ...]]] = {
    "receive_bytes": [(1, b"KODL", 20, 10)],
    "receive_frame": [(CanFrame(0x601, b"12", False), 20, 10)],
    "start": [(20, True), (20, False)],
    "port": [(1, True, 20), (1, False, 20)],
    "set_can_state": [(CanState.BUS_OFF, 20)],
    "saved": [(1, None, 20), (1, "", 20), (1, "full", 20)],
    "parameters_damaged": [(1, 20)],
    "held_up": [(20, True), (20, False)],
    "hold": [(20, True), (20, False)],
    "limit": [(True, True, 20), (False, False, 20), (True, False, 20)],
    "take_some": [(1, 20)],
}
"""Arguments of each method. The others only have a time."""


def unrecorded(gateway: type[Gateway]) -> list[str]:
    """Return the names of the methods that get a time, but are not in the table."""
    known = NOT_CALLS.keys() | {call.method for call in CALLS}
    found = []
    for name, method in inspect.getmembers(gateway, inspect.isfunction):
        has_time = "now" in inspect.signature(method).parameters
        if has_time and not name.startswith("_") and name not in known:
            found.append(name)
    return found


def test_every_call_of_the_gateway_is_in_the_table() -> None:
    assert not unrecorded(Gateway), "Add a row to CALLS in capture/calls.py"


def test_new_call_that_is_missing_in_the_table_is_named() -> None:
    class Extended(Gateway):
        def forget_nodes(self, now: int) -> None:
            raise NotImplementedError

    assert unrecorded(Extended) == ["forget_nodes"]


def test_every_kind_of_entry_is_a_call_or_a_note() -> None:
    assert len(CALL_OF) == len(CALLS)
    assert {*CALL_OF} | NOTES == {*EntryKind}, "Add a row to CALLS in capture/calls.py"
    assert not {*CALL_OF} & NOTES


@pytest.mark.parametrize(("method", "calls"), [*calls_by_method()])
def test_arguments_of_a_call_are_the_same_after_recording(
    method: str, calls: list[RecordedCall]
) -> None:
    parameters = [*inspect.signature(getattr(Gateway, method)).parameters.values()][1:]
    needed = [each.name for each in parameters if each.default is each.empty]
    for given in EXAMPLES.get(method, [(20,)]):
        assert len(given) >= len(needed), f"Add {method}({', '.join(needed)}) to EXAMPLES"
        (entry,) = [
            Entry(recorded.now, call.kind, *recorded[1:])
            for call in calls
            if (recorded := call.encoding.write(*given)) is not None
        ]
        assert CALL_OF[EntryKind(entry.kind)].encoding.read(entry) == given


def test_recorded_gateway_overrides_every_method_of_the_table() -> None:
    for method, _ in calls_by_method():
        assert getattr(RecordedGateway, method) is not getattr(Gateway, method), method


def test_numbers_in_c_are_those_of_the_table() -> None:
    for kind in EntryKind:
        assert getattr(KCG, f"ENTRY_{kind.name}") == kind
