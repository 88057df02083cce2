"""The table of faults in docs/fault-programme.md, made from what the programme found.

    python tests/faults/table.py RESULTS.json... docs/fault-programme.md  puts it between the markers
    python tests/faults/table.py RESULTS.json...                prints it

RESULTS.json are the files that programme.py and qemu_programme.py write. A row that is not good is not hidden: it shows its figures.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import programme  # noqa: F401  registers the faults of User Mode Linux
import qemu_faults  # noqa: F401  and those of the emulated machine
from fault_report import WITH_PYTHON, Report, Row, in_order

BEGIN, END = "<!-- faults begin -->", "<!-- faults end -->"
COLUMNS = (
    "machine",
    "fault",
    "injected",
    "recovered",
    "worst recovery",
    "wrong values",
    "values lost",
    "state",
)
HEAD = f"| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|\n"


def table(rows: Sequence[Row]) -> str:
    """The table in Markdown, in the order of the programme."""
    order = [(fault.machine, fault.name) for fault in in_order()]
    # also of a run of faults that there are no longer
    order += [(row.machine, row.name) for row in rows]
    text = HEAD
    for row in sorted(rows, key=lambda row: order.index((row.machine, row.name))):
        worst = (
            "undisturbed"
            if row.limit_s is None
            else f"{row.worst_s:.2f} s (limit {row.limit_s:g} s)"
        )
        if WITH_PYTHON in row.figures:
            worst += f", {row.figures[WITH_PYTHON]:.2f} {WITH_PYTHON}"
        text += f"| {row.machine} | {row} | {row.injected} | {row.recovered} | {worst} "
        text += f"| {row.wrong} | {row.lost} | {row.state} |\n"
    return text


def parse(text: str) -> list[dict[str, str]]:
    """The rows of the table that stands between the markers of a text."""
    inside = text.partition(BEGIN)[2].partition(END)[0]
    lines = [text for text in inside.splitlines() if text.startswith("|")]
    cells = [[cell.strip() for cell in text.strip("|").split("|")] for text in lines]
    return [dict(zip(cells[0], row, strict=True)) for row in cells[2:]] if cells else []


def put(text: str, made: str) -> str:
    """A text with the table between its markers replaced."""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"there are no markers {BEGIN} and {END}")
    return f"{before}{BEGIN}\n{made}{END}{after}"


def main() -> int:
    files = [Path(word) for word in sys.argv[1:]]
    results = [file for file in files if file.suffix == ".json"]
    if not results or any(file.suffix not in (".json", ".md") for file in files):
        print(__doc__, file=sys.stderr)
        return 2
    made = table(Report.read(results).rows)
    for file in files:
        if file.suffix == ".md":
            file.write_text(put(file.read_text(), made))
            print(f"{file}: {len(parse(put(BEGIN + END, made)))} faults")
    if len(results) == len(files):
        print(made, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
