"""An example of an output: one frame a second for each ESC, with its battery voltage.

The value is in 10 mV, or FFFFh if not available. A CAN command changes the period. It follows the
recipe "Add an output" of docs/recipes.md. Larger outputs have a module for the class.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from kontronik_can_gw.core.header_parts import reading, whole_number
from kontronik_can_gw.core.output import Output, OutputHost, Owner
from kontronik_can_gw.core.output_setup import HostMachine, OutputSetup
from kontronik_can_gw.esc.telemetry import EscSettings, Event
from kontronik_can_gw.esc.values import VALUES, steps
from kontronik_can_gw.frames import EXTENDED, MAX_EXTENDED_ID, CanFrame
from kontronik_can_gw.signals.plan import classic_bits
from kontronik_can_gw.times import NEVER, SECOND

COMMAND_ID = 0x12
LONGEST_S = 9
"""Greatest period that a command sets."""
NOT_AVAILABLE = 0xFFFF


class Voltages(Output):
    """Sends the frames. The first frame after an outage says that nothing is available."""

    name = "voltages"
    events = Event.LINK

    def __init__(self, host: OutputHost, first_id: int, now: int) -> None:
        super().__init__()
        self.receive_ids = frozenset({COMMAND_ID})
        self._escs = host.escs
        self._gateway = host.status
        self._first_id = first_id
        self._due = now + SECOND
        self._period = SECOND
        self._is_held = False
        self._is_quiet = False

    def own_ids(self) -> dict[int, Owner]:
        return {
            self._first_id + esc | EXTENDED: Owner(esc, "voltage") for esc in range(len(self._escs))
        }

    def next_deadline(self) -> int:
        return NEVER if self._is_quiet else self._due

    def on_event(self, esc: int, events: int, now: int) -> None:
        if not self._escs[esc].up:
            self._send(esc, now)

    def receive(self, frame: CanFrame, now: int, at: int) -> None:
        period_s = int.from_bytes(frame.data, "little")
        if frame.key == COMMAND_ID and 1 <= period_s <= LONGEST_S:
            self._period = period_s * SECOND

    def advance(self, now: int) -> None:
        if now >= self._due:
            self._due = max(self._due + self._period, now)
            for esc in range(len(self._escs)):
                self._send(esc, now)

    def hold(self, now: int) -> None:
        self._is_held = True

    def first_frame(self, now: int) -> CanFrame | None:
        return self._frame(0, NOT_AVAILABLE)

    def can_returned(self, now: int, has_lost_frames: bool = False) -> None:
        self._is_held = False

    def set_quiet(self, is_quiet: bool, now: int) -> None:
        self._is_quiet = is_quiet
        self._due = now

    def _send(self, esc: int, now: int) -> None:
        if not self._is_held and not self._is_quiet:
            value = steps(VALUES["battery_voltage"], self._escs[esc], self._gateway, now)
            self.frames.append(self._frame(esc, NOT_AVAILABLE if value is None else value))

    def _frame(self, esc: int, value: int) -> CanFrame:
        return CanFrame(self._first_id + esc, value.to_bytes(2, "little"), extended=True)


@dataclass(frozen=True)
class VoltagesSetup(OutputSetup):
    """The output before it is made."""

    first_id: int
    escs: int

    name = "voltages"
    title = "the voltages"
    slots = 0

    def make(self, host: OutputHost, now: int) -> Voltages:
        return Voltages(host, self.first_id, now)

    def header(self) -> dict[str, Any]:
        return {"first_id": self.first_id}

    def taken_ids(self) -> Mapping[int, str]:
        return {self.first_id + esc | EXTENDED: "the voltages" for esc in range(self.escs)}

    def traffic(self, is_worst: bool = False) -> tuple[float, float]:
        return self.escs, self.escs * classic_bits(2, True)

    def summary(self, escs: Sequence[EscSettings]) -> list[str]:
        return [f"voltages  29-bit ids from {self.first_id:X}h"]


def configured(config: Any, machine: HostMachine) -> VoltagesSetup:
    return VoltagesSetup(config.voltages.first_id, len(config.esc))


def recorded(found: Mapping[str, Any], escs: Sequence[EscSettings]) -> VoltagesSetup:
    with reading("outputs.voltages"):
        return VoltagesSetup(whole_number(found["first_id"], 0, MAX_EXTENDED_ID), len(escs))
