"""What ``check -v`` prints: the configuration in effect, and tables of messages, signals and nodes."""

import re
from collections.abc import Iterator, Sequence

from kontronik_can_gw.canopen.nodes import Nodes
from kontronik_can_gw.canopen.pdo import Tpdo
from kontronik_can_gw.canopen.pdo_parameters import EVENT_TYPES
from kontronik_can_gw.canopen.uses import uses
from kontronik_can_gw.config.assemble import Loaded
from kontronik_can_gw.config.export import as_toml
from kontronik_can_gw.dbc.loss import is_mute, reporter
from kontronik_can_gw.esc.telemetry import MS
from kontronik_can_gw.node_state import UNCONFIGURED
from kontronik_can_gw.signals.packer import float_of
from kontronik_can_gw.signals.plan import Layout, MessagePlan, Role, SendType, SignalPlan


def details(loaded: Loaded, nodes: Nodes | None) -> Iterator[str]:
    """The effective configuration, each message and signal with its source, what is lost, and each node with its COB-IDs."""
    config, layout = loaded.config, loaded.layout
    yield f"# effective configuration of {config.file}"
    yield from as_toml(config).split("\n")
    if config.dbc.enabled:
        yield f"# messages of {layout.node} by {layout.file}"
        yield from table(layout, [esc.name for esc in config.escs])
        yield ""
        yield from unbound(layout)
    if loaded.canopen is not None and nodes is not None:
        yield f"# CANopen nodes by {loaded.canopen.eds.name}"
        yield from node_table(nodes, loaded)
        yield ""
    for output in loaded.outputs:
        yield f"# {output.title}"
        yield from output.lines()
        yield ""


def node_table(nodes: Nodes, loaded: Loaded) -> list[str]:
    """Each node's COB-IDs and PDOs in columns."""
    rows: list[tuple[str, ...]] = [("node", "COB-ID", "what", "sent", "objects")]
    for node, esc in zip(nodes.nodes, loaded.escs, strict=True):
        if node.node_id == UNCONFIGURED:
            serial = f"serial number {node.identity.identity[3]}"
            rows.append((f"{esc.name}: waits for LSS", "7E5h", "LSS", "", serial))
            continue
        first = f"{esc.name}: {node.node_id}"
        tpdos = {tpdo.cob_id: tpdo for tpdo in node.tpdos if tpdo.valid}
        for cob_id, what in {use.cob_id: use.what for use in uses(node)}.items():
            sent, objects = "", ""
            if (tpdo := tpdos.get(cob_id)) is not None:
                sent = pdo_timing(tpdo)
                objects = ", ".join(variable.entry.name for variable in tpdo.mapped)
            what = re.sub(rf" (of|to) CANopen node {node.node_id}$", "", what)
            rows.append((first, f"{cob_id:03X}h", what, sent, objects))
            first = ""
    return columns(rows)


def pdo_timing(tpdo: Tpdo) -> str:
    """Transmission type and times of a PDO, in words."""
    if tpdo.type not in EVENT_TYPES:
        return "at a SYNC after news" if tpdo.type == 0 else f"every {tpdo.type} SYNC"
    words = ["on change" if tpdo.on_change else "with each frame"]
    if tpdo.inhibit_ns:
        words.append(f">= {tpdo.inhibit_ns / MS:g} ms")
    if tpdo.event_ns:
        words.append(f"every {tpdo.event_ns // MS} ms")
    return ", ".join(words)


def table(layout: Layout, esc_names: list[str]) -> list[str]:
    """Message, id, cycle, signal, source and losses in columns."""
    head = ("message", "id", "sent", "signal", "source", "lost")
    rows: list[tuple[str, ...]] = []
    for message in layout.messages:
        first = (message.name, can_id(message), timing(message))
        for signal in message.signals:
            rows.append((*first, signal.name, source(signal, esc_names), lost(message, signal)))
            first = ("", "", "")
    return columns([head, *rows])


def unbound(layout: Layout) -> list[str]:
    """Unbound signals with their constant values, a line for each message."""
    lines = []
    for message in layout.messages:
        if found := [signal for signal in message.signals if signal.unbound]:
            held = ", ".join(
                f"{signal.name} = {shown(signal, signal.constant)}" for signal in found
            )
            lines.append(f"#   {message.name}: {held}")
    return ["# bound to nothing, so they hold these values for ever:", *lines, ""] if lines else []


def shown(signal: SignalPlan, raw: int) -> str:
    """The physical value of raw bits, or their text in the value table."""
    if signal.is_float:
        value = float_of(raw, signal.length)
        return f"{value * float(signal.factor) + float(signal.offset):g} {signal.unit}".rstrip()
    return (
        signal.texts.get(raw)
        or f"{float(raw * signal.factor + signal.offset):.10g} {signal.unit}".rstrip()
    )


def lost(message: MessagePlan, signal: SignalPlan) -> str:
    """What is lost in a signal: resolution, range, or the report of lost telemetry."""
    notes = list(signal.notes)
    if is_mute(signal) and (found := reporter(message, signal)) is not None:
        notes.append(f"{found.name} reports the loss")
    return "; ".join(notes)


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows as lines with aligned columns."""
    widths = [max(len(cell) for cell in column) for column in zip(*rows, strict=True)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def can_id(message: MessagePlan) -> str:
    """The id in hexadecimal: 3 digits for 11 bits, 8 for 29."""
    return f"{message.can_id:08X}h" if message.extended else f"{message.can_id:03X}h"


def timing(message: MessagePlan) -> str:
    """Send type, cycle and minimum distance of a message, in words."""
    words = []
    if message.cycle_ns:
        words.append(f"every {message.cycle_ns // MS} ms")
    if SendType.EVENT in message.send_type:
        words.append("with each frame")
    if SendType.ON_CHANGE in message.send_type:
        words.append("on change")
    if message.delay_ns:
        words.append(f">= {message.delay_ns // MS} ms")
    return ", ".join(words)


def source(signal: SignalPlan, esc_names: list[str]) -> str:
    if signal.source is None:
        text = str(signal.constant) if signal.role is Role.CONSTANT else ""
        return f"({signal.role.value}{' ' + text if text else ''})"
    unit = f" {signal.source.unit}" if signal.source.unit else ""
    prefix = f"{esc_names[signal.esc]}." if signal.esc is not None and len(esc_names) > 1 else ""
    page = f" page {signal.page}" if signal.page is not None else ""
    return f"{prefix}{signal.source.name}{unit}{page}"
