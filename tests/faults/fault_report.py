"""The list of faults, and the result of injecting each, as a row of docs/fault-programme.md."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET


@dataclass(frozen=True)
class Fault:
    """A fault of the programme.

    ``limit_s`` is the longest allowed recovery in s. None if no value may be disturbed.
    """

    area: str
    name: str
    limit_s: float | None
    inject: Callable[[Any, Any, Any], None]
    """Injects the fault once on a bench. The last argument is one of ``rounds``."""
    bed: Callable[[Path], Any]
    """Creates the bench of the fault. Faults with the same bed share the bench."""
    escs: Sequence[int] | None = None
    """ESCs that the fault disturbs, or None for all ESCs of the bench."""
    settle_s: float = 0.5
    rounds: Sequence[Any] = range(2)
    machine: str = "UML"

    def __str__(self) -> str:
        return f"{self.machine} {self.area}: {self.name}"


FAULTS: list[Fault] = []
"""Every fault. Importing the modules that define faults fills the list."""
AREAS = ("Start", "Serial", "CAN", "Outage", "Time", "Process", "Disk", "Traffic", "Many")
GOOD = "good"
FAILED = "failed"
PAGE = Path(__file__).resolve().parents[2] / "docs" / "fault-programme.md"
BEGIN = "<!-- faults begin -->\n"
END = "<!-- faults end -->\n"
_COLUMNS = (
    "machine, fault",
    "injected",
    "recovered",
    "worst recovery",
    "wrong values",
    "values lost",
    "state",
)
HEAD = f"| {' | '.join(_COLUMNS)} |\n{'|---' * len(_COLUMNS)}|\n"


def in_order() -> list[Fault]:
    """Return the faults in the order of the table."""
    return sorted(FAULTS, key=lambda fault: (fault.machine != "UML", AREAS.index(fault.area)))


@dataclass
class Row:
    """The result of one fault."""

    fault: str
    limit_s: float | None
    injected: int = 0
    recovered: int = 0
    worst_s: float = 0.0
    wrong: int = 0
    lost: int = 0
    late: int = 0
    """Most values that arrived late after one outage, because they were in kernel or controller."""
    transmitted: int = 0
    """Bytes that the gateway sent to an ESC."""
    notes: list[str] = field(default_factory=list)
    """Descriptions of the problems, for people."""

    @property
    def state(self) -> str:
        has_recovered = self.injected > 0 and self.recovered == self.injected
        is_bad = not has_recovered or self.wrong or self.lost or self.transmitted
        return FAILED if is_bad else GOOD

    def __str__(self) -> str:
        """Return the line of the page."""
        limit = self.limit_s
        recovery = "undisturbed" if limit is None else f"{self.worst_s:.2f} s (limit {limit:g} s)"
        counts = (self.injected, self.recovered, recovery, self.wrong, self.lost, self.state)
        return f"| {self.fault} | {' | '.join(map(str, counts))} |"

    @property
    def text(self) -> str:
        """Return the line for the terminal, and below it the problems."""
        notes = list(self.notes[:8])
        if self.late:
            notes.append(f"up to {self.late} values that kernel or controller held arrived late")
        if self.transmitted:
            notes.append(f"{self.transmitted} bytes sent to an ESC")
        return "\n       ".join((str(self), *notes))


class Report(dict[str, Row]):
    """The rows of a run by name of the fault."""

    def of(self, fault: Fault) -> Row:
        """Return the row of a fault, which is created at the first call."""
        return self.setdefault(str(fault), Row(str(fault), fault.limit_s))

    def write(self, path: Path) -> None:
        path.write_text(json.dumps([asdict(row) for row in self.values()], indent=1) + "\n")

    def read(self, path: Path) -> None:
        """Read the rows that another run has written."""
        self.update((found["fault"], Row(**found)) for found in json.loads(path.read_text()))

    def write_junit(self, path: Path) -> None:
        """Write a JUnit report with each row as a test."""
        suite = ET.Element("testsuite")
        for row in self.values():
            case = ET.SubElement(suite, "testcase", classname="faults", name=row.fault)
            if row.state == FAILED:
                ET.SubElement(case, "failure", message=row.text)
        ET.ElementTree(suite).write(path)


def shown(text: str) -> dict[str, str]:
    """Return the lines of a page by name of the fault."""
    lines = text.partition(BEGIN)[2].partition(END)[0].splitlines()[2:]
    return {line.split(" | ")[0].removeprefix("| "): line for line in lines}


def put(text: str, report: Report) -> str:
    """Return a page on which a report's rows replace older ones, in the programme's order."""
    rows = shown(text) | {row.fault: str(row) for row in report.values()}
    listed = [f"{rows[str(each)]}\n" for each in in_order() if str(each) in rows]
    before = text.partition(BEGIN)[0]
    after = text.partition(END)[2]
    return "".join((before, BEGIN, HEAD, *listed, END, after))
