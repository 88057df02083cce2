"""The common look of the report and the live page: styles, plots and uPlot."""

from pathlib import Path

HERE = Path(__file__).parent
STYLES = ("vendor/uPlot.min.css", "look.css")


def text(name: str) -> str:
    """Return the content of a file of this folder."""
    return (HERE / name).read_text(encoding="utf-8")
