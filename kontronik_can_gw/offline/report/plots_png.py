"""The report's plots as PNG files, by matplotlib: the same lines, colours and marks as on the page."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.offline.report.flight import Flight, PlotData
from kontronik_can_gw.offline.report.page import clock
from kontronik_can_gw.offline.report.quantities import PLOTS, STATE_CLASSES, STYLES, class_of
from kontronik_can_gw.telemetry import SECOND

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDTH, HEIGHT, DPI = 12.0, 4.0, 110
MOST_TEXTS = 12
"""Marks beyond them have a line and no text."""
_MARK = {"error": "#c4261d", "warning": "#9a5b00"}
_SOFT = "#5b6470"


def check_matplotlib() -> None:
    """UserError where matplotlib is missing."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        raise UserError("--png: needs matplotlib: pip install 'kontronik-can-gw[plot]'") from None


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
    height = HEIGHT if plot is not None else 1.4 + 0.35 * rows
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
    axes.set_title(_plain(title), loc="right", fontsize=9, color=_SOFT)
    axes.set_title(what, loc="left", fontsize=11, fontweight="bold")
    begin, end = _seconds(flight, flight.start_ns), _seconds(flight, flight.end_ns)
    axes.set_xlim(begin, max(end, begin + 0.1))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda t, _: clock(round(t * SECOND), 0 if end - begin > 10 else 1)))
    _draw_marks(axes, flight, with_text=plot is not None)
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


def _draw_marks(axes: "Axes", flight: Flight, *, with_text: bool) -> None:
    several = len(flight.names) > 1
    top = axes.get_xaxis_transform()
    texts = 0
    for event in flight.events:
        if event.kind != "error":
            continue
        tone = _MARK.get(event.severity, _SOFT)
        begin = _seconds(flight, event.begin_ns)
        axes.axvline(begin, color=tone, linewidth=0.9, linestyle="-" if event.severity == "error" else "--")
        if event.end_ns is not None:
            axes.axvline(_seconds(flight, event.end_ns), color=tone, linewidth=0.7, linestyle=":")
        if with_text and texts < MOST_TEXTS:
            text = (f"{flight.names[event.esc]}: " if several else "") + event.text
            axes.text(
                begin,
                0.99 - 0.05 * (texts % 4),
                f" {_plain(text)}",
                color=tone,
                fontsize=7,
                transform=top,
                va="top",
                clip_on=True,
            )
            texts += 1
