"""Evaluates a recording as a flight."""

from collections.abc import Callable, Iterable

from kontronik_can_gw.desk.recordings.inputs import Input
from kontronik_can_gw.desk.recordings.recording import RowBlock
from kontronik_can_gw.desk.report.flight import Flight, needed_columns
from kontronik_can_gw.errors import UserError


def flight_of(
    recording: Input,
    window: tuple[float | None, float | None] = (None, None),
    watch: Callable[[Iterable[RowBlock]], Iterable[RowBlock]] = iter,
) -> Flight:
    """Return the flight after all rows of the window. All blocks pass through ``watch``.

    Raises UserError if nothing can be shown.
    """
    chosen = needed_columns(recording.fields)
    fields = [recording.fields[index] for index in chosen]
    flight = Flight(recording.bus.escs, fields, window=window)
    if not flight.has_anything:
        raise UserError(
            f"{recording.bus.layout.file}: has no signal that a report shows. Give another --dbc."
        )
    for block in watch(filter(len, recording.blocks(chosen))):
        if not flight.evaluate(block):
            break
    return flight.finish()
