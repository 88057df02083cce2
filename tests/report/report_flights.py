"""Simulated flights as inputs of the report: rows as ``open_input`` gives them, made by the real gateway without any file."""

import heapq
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path

from kontronik_can_gw.config import shipped
from kontronik_can_gw.dbc_output.expand import expand
from kontronik_can_gw.dbc_output.layout import DbcSettings, choose_node, load_database
from kontronik_can_gw.dbc_output.prepare import prepare
from kontronik_can_gw.dbc_output.unpacker import SignalReader, Value
from kontronik_can_gw.dbc_output.view import View
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.offline.layouts import BusLayout, layout_of_dbc
from kontronik_can_gw.simulator import EscOptions, SimulatedEsc
from kontronik_can_gw.telemetry import SECOND, EscSettings

Row = tuple[int, list[Value]]


def shipped_bus(names: Sequence[str] = ("esc1",)) -> BusLayout:
    """The shipped DBC for so many ESCs."""
    file = shipped("dbc/kontronik_esc.dbc")
    if len(names) == 1:
        return layout_of_dbc(file)
    escs = [EscSettings(name) for name in names]
    database = load_database(file)
    node = choose_node(database, None, str(file))
    database, bind = expand(database, node, escs, str(file), None, None, None)
    database, layout = prepare(database, str(file), escs, DbcSettings(bind, node), fd_allowed=True)
    return BusLayout(database, layout, escs)


def simulated(
    bus: BusLayout,
    seconds: float,
    options: Sequence[EscOptions] = (),
    start_ns: int = 5 * SECOND,
    seed: int = 7,
    alter: Callable[[int, int, bytes], bytes] = lambda _esc, _now, wire: wire,
) -> Iterator[Row]:
    """Simulated ESCs through the real gateway and the DBC: a row at each frame of theirs."""
    gateway = Gateway(bus.escs, bus.layout, start_ns)
    gateway.start(start_ns)
    view = View(SignalReader(bus.layout))
    escs = [
        SimulatedEsc(options[i] if i < len(options) else EscOptions(), seed=seed + i, start_ns=start_ns + i * 1_234_567)
        for i in range(len(bus.escs))
    ]
    due = [(esc.next_ns, index) for index, esc in enumerate(escs)]
    heapq.heapify(due)
    end_ns = start_ns + round(seconds * SECOND)
    while due[0][0] < end_ns:
        now, index = due[0]
        while (deadline := gateway.next_deadline()) is not None and deadline < now:
            gateway.advance(deadline)
            for frame in gateway.take_frames():
                view.take(frame.key, frame.data, deadline)
        for sent in escs[index].frames_until(now):
            gateway.receive_bytes(index, alter(index, now, sent.wire), now, now)
        gateway.advance(now)
        for frame in gateway.take_frames():
            view.take(frame.key, frame.data, now)
        view.expire(now)
        yield now, list(view.values)
        heapq.heapreplace(due, (escs[index].next_ns, index))


def column(bus: BusLayout, source: str, esc: int | None = 0) -> int:
    """Where a source is in a row."""
    found = SignalReader(bus.layout).column_of(source, esc)
    assert found is not None
    return found


def dbc_bus(
    file: str, pole_pairs: int = 1, gear: Fraction = Fraction(1), bind: dict[str, str] | None = None
) -> BusLayout:
    """A DBC of one ESC with settings as a configuration gives them."""
    escs = [EscSettings("esc1", pole_pairs=pole_pairs, gear=gear)]
    database = load_database(Path(file))
    node = choose_node(database, None, file)
    database, layout = prepare(database, file, escs, DbcSettings(bind or {}, node), fd_allowed=True)
    return BusLayout(database, layout, escs)
