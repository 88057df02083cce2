"""The report's plots as PNG files, by matplotlib: the same lines, colours and marks as on the page."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.offline.report.decimate import Number
from kontronik_can_gw.offline.report.flight import Event, Flight, PlotData
from kontronik_can_gw.offline.report.labels import Label, place
from kontronik_can_gw.offline.report.page import clock
from kontronik_can_gw.offline.report.quantities import PLOTS, STATE_CLASSES, STYLES, class_of
from kontronik_can_gw.telemetry import SECOND

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDTH, HEIGHT, DPI = 12.0, 4.0, 110
MOST_MARKS = 60
"""Marks beyond them have a line, and neither text nor number."""
MOST_TOLD = 12
"""Lines below a plot, of marks whose text has no room."""
ROWS = 4
ROW = 0.14
"""Rows of text above a plot, and the height of one in inches."""
_MARK = {"error": "#c4261d", "warning": "#9a5b00"}
_SOFT = "#5b6470"


def check_matplotlib() -> None:
    """UserError where matplotlib is missing."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        raise UserError("--png: needs matplotlib: pip install 'kontronik-can-gw[plot]'") from None


def names_of_pngs() -> list[str]:
    """Of all files that there may be."""
    return [f"{name}.png" for name in ("states", *(plot.key for plot in PLOTS))]


def write_pngs(flight: Flight, folder: Path, title: str) -> list[Path]:
    """A file for each plot, as speed.png; the folder is made. RunError where one cannot be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        written = [_write(flight, plot, folder, title) for plot in flight.plots]
        if any(flight.segments):
            written.insert(0, _write(flight, None, folder, title))
    except OSError as error:
        raise RunError(f"{folder}: cannot be written: {error.strerror}. Give another --png.") from None
    return written


def _write(flight: Flight, plot: PlotData | None, folder: Path, title: str) -> Path:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter

    rows = sum(1 for segments in flight.segments if segments)
    errors = [event for event in flight.events if event.kind == "error"]
    text_rows = min(ROWS, len(errors)) if plot is not None else 0
    height = HEIGHT + text_rows * ROW if plot is not None else 1.4 + 0.35 * rows
    figure = Figure(figsize=(WIDTH, height), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    if plot is None:
        name, what = "states", "Operating state"
        _draw_states(axes, flight)
    else:
        spec = PLOTS[plot.plot]
        name, what = spec.key, f"{spec.title} [{spec.unit}]"
        _draw_lines(axes, flight, plot)
        axes.grid(visible=True, color="#e8ebef")
    pad = 6 + 72 * ROW * text_rows
    axes.set_title(_plain(title), loc="right", fontsize=9, color=_SOFT, pad=pad)
    axes.set_title(what, loc="left", fontsize=11, fontweight="bold", pad=pad)
    begin, end = _seconds(flight, flight.start_ns), _seconds(flight, flight.end_ns)
    axes.set_xlim(begin, max(end, begin + 0.1))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda t, _: clock(round(t * SECOND), 0 if end - begin > 10 else 1)))
    _draw_marks(axes, flight, errors)
    if text_rows:
        _draw_labels(axes, flight, errors, text_rows)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    file = folder / f"{name}.png"
    figure.savefig(file, metadata={"Software": None})
    return file


def _seconds(flight: Flight, time_ns: int) -> float:
    return (time_ns - flight.origin_ns) / SECOND


def _plain(text: str) -> str:
    """Text that matplotlib does not take for a formula."""
    return text.replace("$", r"\$")


def _draw_lines(axes: "Axes", flight: Flight, plot: PlotData) -> None:
    several = len(flight.names) > 1
    times = [_seconds(flight, time_ns) for time_ns in flight.times]
    nan = float("nan")
    for line in plot.lines:
        style = STYLES[(line.esc if several else line.quantity) % len(STYLES)]
        label = plot.labels[line.quantity]
        if several:
            label = flight.names[line.esc] + (f" {label.lower()}" if len(plot.labels) > 1 else "")
        width = (2.0, 1.2, 0.8)[line.quantity] if several else 1.4
        dashes: Any = (0, tuple(part / 1.6 for part in style.dash)) if style.dash else "-"
        if alone := _alone(line.values):
            values: Any = [line.values[at] for at in alone]
            axes.plot([times[at] for at in alone], values, ".", color=style.light, markersize=2.5)
        axes.plot(
            times,
            [nan if value is None else value for value in line.values],
            color=style.light,
            linestyle=dashes,
            linewidth=width,
            label=_plain(label),
        )
    axes.margins(y=0.12)
    if len(plot.lines) > 1:
        axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)


def _alone(values: Sequence[Number]) -> list[int]:
    """Places of values with a gap on both sides, which no line shows."""
    padded = [None, *values, None]
    return [
        at for at, value in enumerate(values) if value is not None and padded[at] is None and padded[at + 2] is None
    ]


def _draw_states(axes: "Axes", flight: Flight) -> None:
    from matplotlib.patches import Patch

    shown = [esc for esc, segments in enumerate(flight.segments) if segments]
    met: set[int] = set()
    for row, esc in enumerate(shown):
        spans: dict[int, list[tuple[float, float]]] = {}
        for begin, end, state in flight.segments[esc]:
            span = (_seconds(flight, begin), (end - begin) / SECOND)
            spans.setdefault(class_of(state), []).append(span)
        for group, parts in spans.items():
            axes.broken_barh(
                parts, (row - 0.42, 0.84), facecolors=STATE_CLASSES[group].light, edgecolor="white", linewidth=0.4
            )
            met.add(group)
    axes.set_yticks(range(len(shown)), [_plain(flight.names[esc]) for esc in shown])
    axes.set_ylim(len(shown) - 0.5, -0.5)
    handles = [Patch(color=STATE_CLASSES[group].light, label=STATE_CLASSES[group].label) for group in sorted(met)]
    axes.legend(handles=handles, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)


def _draw_marks(axes: "Axes", flight: Flight, errors: Sequence[Event]) -> None:
    for event in errors:
        tone = _MARK.get(event.severity, _SOFT)
        begin = _seconds(flight, event.begin_ns)
        axes.axvline(begin, color=tone, linewidth=0.9, linestyle="-" if event.severity == "error" else "--")
        if event.end_ns is not None:
            axes.axvline(_seconds(flight, event.end_ns), color=tone, linewidth=0.7, linestyle=":")


def _draw_labels(axes: "Axes", flight: Flight, errors: Sequence[Event], rows: int) -> None:
    """Text of errors above the plot; where it has no room there, numbers, and the text below."""
    numbers = {id(event): str(number) for number, event in enumerate(errors, 1)}
    order = ("error", "warning", "status")
    chosen = sorted(errors, key=lambda event: order.index(event.severity))[:MOST_MARKS]
    chosen.sort(key=lambda event: event.begin_ns)
    figure = axes.figure
    figure.draw_without_rendering()  # type: ignore[union-attr]  # so that the axes have their width
    box = axes.get_window_extent()
    labels = []
    for event in chosen:
        x = float(axes.transData.transform((_seconds(flight, event.begin_ns), 0))[0])
        width = _width(_plain(_words(flight, event)))
        labels.append(Label(x, width, _width(numbers[id(event)]) + 6, order.index(event.severity)))
    place(labels, box.x0, box.x1, rows)
    style: dict[str, Any] = {
        "xycoords": axes.get_xaxis_transform(),
        "textcoords": "offset points",
        "fontsize": 7,
        "annotation_clip": False,
        "va": "bottom",
    }
    points = 72 / DPI
    for event, label in zip(chosen, labels, strict=True):
        tone = _MARK.get(event.severity, _SOFT)
        at = _seconds(flight, event.begin_ns)
        if label.badge_left is not None:
            offset = ((label.badge_left - label.x + 3) * points, 2.5)
            frame = {"facecolor": tone, "edgecolor": "none", "pad": 1.4}
            axes.annotate(numbers[id(event)], (at, 1), offset, color="white", bbox=frame, in_layout=False, **style)
        if label.row is not None:
            up = 72 * ROW * label.row
            offset = ((label.left - label.x) * points, up + 2)
            axes.annotate(_plain(_words(flight, event)), (at, 1), offset, color=tone, in_layout=False, **style)
            lead = {"arrowstyle": "-", "color": tone, "linewidth": 0.9, "shrinkA": 0, "shrinkB": 0}
            axes.annotate("", (at, 1), (0, up + 72 * ROW), arrowprops=lead, in_layout=False, **style)
    untold = [event for event, label in zip(chosen, labels, strict=True) if label.row is None]
    if below := _told_below(flight, untold, numbers, len(errors) - len(chosen)):
        axes.set_xlabel(_plain("\n".join(below)), fontsize=7, color=_SOFT, loc="left")
        figure.set_figheight(figure.get_figheight() + ROW * len(below))  # type: ignore[union-attr]


def _told_below(flight: Flight, events: Sequence[Event], numbers: dict[int, str], more: int) -> list[str]:
    """Lines with number and text of marks that have only a number."""
    groups: dict[tuple[int, str], list[Event]] = {}
    for event in events:
        groups.setdefault((event.esc, event.text), []).append(event)
    told = list(groups.values())[:MOST_TOLD]
    lines = []
    for group in told:
        which = ", ".join(numbers[id(event)] for event in group[:8]) + (" …" if len(group) > 8 else "")
        at = clock(group[0].begin_ns - flight.origin_ns) + (" …" if len(group) > 1 else "")
        lines.append(f"{which}:  {_words(flight, group[0])} ({at})")
    left = more + len(events) - sum(map(len, told))
    return [*lines, f"{left} more are not told here"] if left else lines


def _words(flight: Flight, event: Event) -> str:
    return (f"{flight.names[event.esc]}: " if len(flight.names) > 1 else "") + event.text


def _width(text: str) -> float:
    """Of a label, in pixels."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    return float(TextPath((0, 0), text, size=7, prop=FontProperties()).get_extents().x1) * DPI / 72
