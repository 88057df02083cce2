"""The faults there are, and what came of injecting them: a row for each, kept as JSON; docs/fault-programme.md shows them."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET


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

    def __str__(self) -> str:
        return f"{self.area}: {self.name}"


FAULTS: list[Fault] = []
"""Every fault; filled by importing the modules that define them."""
AREAS = ("Start", "Serial", "CAN", "Time", "Process", "Disk", "Traffic", "Many")
WITH_PYTHON = "s with the start of Python"
"""The figure of a fault that ends the process: what its users wait for here."""
MACHINES = ("UML", "QEMU")
MAX_TAKEN = 0.1
"""Of the processor time that the virtual machine would have had. Where more was taken, what came late or not at all shows nothing."""
GOOD, FAILED, NOT_JUDGED = "good", "failed", "not judged"


def in_order(machine: str | None = None) -> list[Fault]:
    """The faults of a machine, or all, in the order of the table."""
    chosen = [fault for fault in FAULTS if machine in (None, fault.machine)]
    areas = [*AREAS, *(fault.area for fault in FAULTS)]
    return sorted(
        chosen, key=lambda fault: (MACHINES.index(fault.machine), areas.index(fault.area))
    )


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
    old: int = 0
    """Those of the wrong values that were right, but too late on the bus, or an age that was told too young."""
    lost: int = 0
    excused: int = 0
    """Values not sent because the machine as a whole stood still; no loss of the gateway's."""
    transmitted: int = 0
    """Bytes that the gateway sent to an ESC."""
    taken: float = 0.0
    """The largest share of processor time that was taken from the virtual machine, over one second, while the fault ran."""
    notes: list[str] = field(default_factory=list)
    """What went wrong, for people."""
    figures: dict[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.area}: {self.name}"

    def peak(self, name: str, value: float) -> None:
        """The largest of a figure."""
        self.figures[name] = max(value, self.figures.get(name, 0))

    def count(self, name: str, value: float) -> None:
        """The sum of a figure."""
        self.figures[name] = value + self.figures.get(name, 0)

    @property
    def good(self) -> bool:
        healed = self.injected > 0 and self.recovered == self.injected
        return healed and not self.wrong and not self.lost and not self.transmitted

    @property
    def state(self) -> str:
        """Lateness and loss are not judged on a machine that could not run; a wrong value or a byte to an ESC fails anywhere."""
        if self.good:
            return GOOD
        only_late = self.wrong == self.old and not self.transmitted
        return NOT_JUDGED if self.taken > MAX_TAKEN and only_late else FAILED


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

    def write(self, path: Path) -> None:
        rows = [{**asdict(row), "state": row.state} for row in self.rows]
        path.write_text(json.dumps({**self.about, "rows": rows}, indent=1) + "\n")

    def write_junit(self, path: Path) -> None:
        """Each row as a test; one that was not judged as skipped."""
        suite = ET.Element("testsuite")
        for row in self.rows:
            case = ET.SubElement(
                suite, "testcase", classname=f"faults.{row.machine}", name=str(row)
            )
            if row.state == FAILED:
                ET.SubElement(case, "failure", message=line(row))
            elif row.state == NOT_JUDGED:
                ET.SubElement(
                    case,
                    "skipped",
                    message=f"{NOT_JUDGED}: {row.taken:.0%} of the processor time was taken",
                )
        ET.ElementTree(suite).write(path)

    @staticmethod
    def read(paths: Sequence[Path]) -> "Report":
        """Several runs' rows as one report."""
        merged = Report()
        for path in paths:
            found = json.loads(path.read_text())
            merged.rows += [
                Row(**{key: row[key] for key in row if key != "state"}) for row in found.pop("rows")
            ]
            merged.about |= found
        return merged


def line(row: Row) -> str:
    """One row for the terminal."""
    recovery = (
        "undisturbed" if row.limit_s is None else f"worst {row.worst_s:.2f} s of {row.limit_s:g} s"
    )
    text = f"{row.state:10} {row.machine} {row}: {row.recovered} of {row.injected}, "
    text += f"{recovery}, wrong {row.wrong}, lost {row.lost}"
    if row.excused:
        text += f", {row.excused} not sent while the machine stood still"
    if row.transmitted:
        text += f", {row.transmitted} bytes sent to an ESC"
    if row.taken > MAX_TAKEN:
        text += f", {row.taken:.0%} of the processor time was taken"
    figures = ", ".join(f"{name} {value:g}" for name, value in row.figures.items())
    return (
        text
        + (f"; {figures}" if figures else "")
        + "".join(f"\n       {note}" for note in row.notes[:8])
    )
