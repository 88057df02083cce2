"""The faults there are, and what came of injecting them: one row for each, kept as JSON, from which the README's table is made."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Fault:
    """A fault of the programme. ``limit_s``: the longest recovery that is allowed; None: nothing may be disturbed at all."""

    machine: str
    area: str
    name: str
    limit_s: float | None
    run: Callable[..., None]
    bench: str
    """Which bench it needs; those that need the same one share it."""


FAULTS: list[Fault] = []
"""Every fault; filled by importing the modules that define them."""
AREAS = ("Start", "Serial", "CAN", "Time", "Process", "Disk", "Traffic", "Many")
WITH_PYTHON = "s with the start of Python"
"""The figure of a fault that ends the process: what its users wait for here."""
MACHINES = ("UML", "QEMU")


def in_order(machine: str | None = None) -> list[Fault]:
    """The faults of a machine, or all, in the order of the table."""
    chosen = [fault for fault in FAULTS if machine in (None, fault.machine)]
    areas = [*AREAS, *(fault.area for fault in FAULTS)]
    return sorted(chosen, key=lambda fault: (MACHINES.index(fault.machine), areas.index(fault.area)))


def fault(
    area: str, name: str, limit_s: float | None, *, machine: str = "UML", bench: str = "two"
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Register a function as a fault of the programme."""

    def register(function: Callable[..., None]) -> Callable[..., None]:
        assert all((known.machine, known.name) != (machine, name) for known in FAULTS), name
        FAULTS.append(Fault(machine, area, name, limit_s, function, bench))
        return function

    return register


@dataclass
class Row:
    """What came of one fault."""

    machine: str
    area: str
    name: str
    limit_s: float | None
    injected: int = 0
    recovered: int = 0
    worst_s: float = 0.0
    wrong: int = 0
    lost: int = 0
    excused: int = 0
    """Values not sent because the machine as a whole stood still; no loss of the gateway's."""
    notes: list[str] = field(default_factory=list)
    """What went wrong, for people."""
    figures: dict[str, float] = field(default_factory=dict)

    @property
    def good(self) -> bool:
        return self.injected > 0 and self.recovered == self.injected and not self.wrong and not self.lost


class Report:
    """All rows of a run."""

    def __init__(self, **about: Any) -> None:
        self.about: dict[str, Any] = dict(about)
        self.rows: list[Row] = []

    def row(self, fault: Fault) -> Row:
        """The row of a fault, made when it is first asked for."""
        for row in self.rows:
            if (row.machine, row.name) == (fault.machine, fault.name):
                return row
        self.rows.append(Row(fault.machine, fault.area, fault.name, fault.limit_s))
        return self.rows[-1]

    @property
    def good(self) -> bool:
        return bool(self.rows) and all(row.good for row in self.rows)

    def write(self, path: Path) -> None:
        path.write_text(json.dumps({**self.about, "rows": [asdict(row) for row in self.rows]}, indent=1) + "\n")

    @staticmethod
    def read(paths: Sequence[Path]) -> "Report":
        """Several runs' rows as one report."""
        merged = Report()
        for path in paths:
            found = json.loads(path.read_text())
            merged.rows += [Row(**row) for row in found.pop("rows")]
            merged.about |= found
        return merged


def line(row: Row) -> str:
    """One row for the terminal."""
    recovery = "undisturbed" if row.limit_s is None else f"worst {row.worst_s:.2f} s of {row.limit_s:g} s"
    text = f"{'ok  ' if row.good else 'FAIL'} {row.machine} {row.area}: {row.name}: {row.recovered} of {row.injected}, "
    text += f"{recovery}, wrong {row.wrong}, lost {row.lost}"
    if row.excused:
        text += f", {row.excused} not sent while the machine stood still"
    figures = ", ".join(f"{name} {value:g}" for name, value in row.figures.items())
    return text + (f"; {figures}" if figures else "") + "".join(f"\n       {note}" for note in row.notes)
