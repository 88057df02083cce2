"""``check``: says in short whether a configuration can be used and what it sends, without opening anything."""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from kontronik_can_gw.canopen.nodes import Nodes
from kontronik_can_gw.cli.arguments import CONFIG, JSON, config_file, option
from kontronik_can_gw.cli.common import say, show
from kontronik_can_gw.cli.recording import in_words, record_folder
from kontronik_can_gw.config.assemble import Loaded, load_configuration
from kontronik_can_gw.config.export import as_toml
from kontronik_can_gw.dbc.prepare import is_mute, reporter
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import MS
from kontronik_can_gw.node_state import UNCONFIGURED
from kontronik_can_gw.printable import printable_json
from kontronik_can_gw.signals.packer import float_of
from kontronik_can_gw.signals.plan import Layout, MessagePlan, Role, SendType, SignalPlan

_EXAMPLE_PORT = "_EXAMPLE-"
"""In the port of the configuration that ``init`` writes."""
OPTIONS = (
    CONFIG,
    (
        option("-v --verbose", "every key in effect, message, and signal with its source"),
        JSON,
    ),
)
EPILOG = (
    "Opens no port and no interface. Exit code: 0 it can be used (there may be warnings), 2 it cannot: "
    "each mistake is a line, with key and remedy. kontronik-can-gw describe shows the objects and PDOs of CANopen nodes."
)


def main(args: argparse.Namespace) -> int:
    path = config_file(args.config)
    try:
        loaded = load_configuration(path)
    except UserError as error:
        if not args.json:
            raise
        print(printable_json({"file": str(path), "mistakes": list(error.problems)}, indent=2))
        return error.exit_code
    examples = [
        f"{loaded.config.file}: port of {esc.name}: {esc.port} is the example's. "
        "Write the name of yours: ls /dev/serial/by-id"
        for esc in loaded.config.esc
        if _EXAMPLE_PORT in esc.port
    ]
    warnings = [*loaded.layout.warnings, *loaded.warnings, *examples]
    nodes = None if loaded.canopen is None else loaded.canopen.nodes(loaded.escs)
    shown = document(path, loaded, nodes, warnings)
    if args.json:
        print(printable_json(shown, indent=2))
        return 0
    for warning in warnings:
        say(f"warning: {warning}")
    for line in summary(shown, loaded, nodes):
        show(line)
    for line in details(shown, loaded) if args.verbose else ():
        show(line)
    return 0


def summary(shown: dict[str, Any], loaded: Loaded, nodes: Nodes | None) -> Iterator[str]:
    """What the gateway reads and sends, in a few lines that fit 80 columns."""
    config = loaded.config
    found = _counted(len(shown["warnings"]), "warning") if shown["warnings"] else "no warnings"
    yield f"{shown['file']}: can be used, {found}"
    for esc, settings in zip(config.esc, loaded.escs, strict=True):
        yield f"  ESC       {esc.name}: {_counted(settings.pole_pairs, 'pole pair')}, gear {float(settings.gear):g}"
        yield f"            {esc.port}"
    can = config.can
    rate = f"{can.bitrate // 1000} kbit/s" + (
        f", data {can.data_bitrate // 1000} kbit/s" if can.fd else ""
    )
    yield f"  CAN       {can.channel} ({can.interface}), {rate}"
    if config.dbc.enabled:
        ids = sorted((each["id"] for each in shown["messages"]), key=lambda each: (len(each), each))
        span = f", {' to '.join(dict.fromkeys((ids[0], ids[-1])))}" if ids else ""
        yield f"  DBC       {_counted(len(ids), 'message')}{span}, layout {shown['layout']}"
        yield f"            {shown['dbc']}"
    for node, each in zip(nodes.nodes if nodes else (), loaded.escs, strict=False):
        sent = f"node {node.node_id}, {_counted(sum(tpdo.valid for tpdo in node.tpdos), 'TPDO')}"
        yield f"  CANopen   {each.name}: {'waits for LSS' if node.node_id == UNCONFIGURED else sent}"
    for output in loaded.outputs:
        for line in output.summary():
            yield f"  {line}"
    if (folder := record_folder(config)) is not None:
        yield f"  captures  {in_words(config, folder)}"
    load, frames = shown["bus_load"], shown["frames_per_second"]
    yield f"  bus load  {load:.1%}, {frames:.0f} frames/s: ESCs at 100 Hz, worst stuffing, no SDO"


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


def document(
    path: Path, loaded: Loaded, nodes: Nodes | None, warnings: list[str]
) -> dict[str, Any]:
    """What ``--json`` prints, and text is made of: every message and signal too. What is sent on change is counted by its cycle."""
    config, layout = loaded.config, loaded.layout
    can = config.can
    load = layout.bus_load(can.bitrate, can.data_bitrate)
    frames = sum(message.rate_hz for message in layout.messages)
    traffic = [output.traffic() for output in loaded.outputs]
    for more, bits in traffic if nodes is None else [*traffic, nodes.traffic()]:
        load += bits / can.bitrate
        frames += more
    return {
        "file": str(path),
        "mistakes": [],
        "warnings": warnings,
        "escs": [{"name": e.name, "port": e.port, "protocol": e.protocol} for e in config.esc],
        "can": {"interface": can.interface, "channel": can.channel, "bitrate": can.bitrate},
        "bus_load": load,
        "frames_per_second": frames,
        "dbc": layout.file,
        "layout": layout.fingerprint,
        "messages": list(messages(layout, [esc.name for esc in loaded.escs])),
        "outputs": {output.name: output.lines() for output in loaded.outputs},
        "canopen_nodes": [
            None if node.node_id == UNCONFIGURED else node.node_id
            for node in (nodes.nodes if nodes else ())
        ],
    }


def messages(layout: Layout, esc_names: list[str]) -> Iterator[dict[str, Any]]:
    """Each message with its id, when it is sent, and of each signal the source and what is lost."""
    for message in layout.messages:
        signals = {}
        for signal in message.signals:
            lost = list(signal.notes)
            if is_mute(signal) and (found := reporter(message, signal)) is not None:
                lost.append(f"{found.name} reports the loss")
            signals[signal.name] = {"source": _source(signal, esc_names), "lost": "; ".join(lost)}
        can_id = f"{message.can_id:0{8 if message.extended else 3}X}h"
        yield {"name": message.name, "id": can_id, "sent": _timing(message), "signals": signals}


def details(shown: dict[str, Any], loaded: Loaded) -> Iterator[str]:
    """The effective configuration, each message and signal with its source and what is lost, and each output's own lines."""
    config, layout = loaded.config, loaded.layout
    yield ""
    yield f"# effective configuration of {config.file}"
    yield from as_toml(config).split("\n")
    if config.dbc.enabled:
        yield f"# messages of {layout.node} by {layout.file}"
        yield from table(shown["messages"])
        yield ""
    for output in loaded.outputs:
        yield f"# {output.title}"
        yield from shown["outputs"][output.name]
        yield ""


def table(found: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Message, id, cycle, signal, source and losses in columns."""
    rows: list[Sequence[str]] = [("message", "id", "sent", "signal", "source", "lost")]
    for message in found:
        first = (message["name"], message["id"], message["sent"])
        for name, signal in message["signals"].items():
            rows.append((*first, name, signal["source"], signal["lost"]))
            first = ("", "", "")
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        yield "  ".join(map(str.ljust, row, widths)).rstrip()


def _held(signal: SignalPlan, raw: int) -> str:
    """The physical value of raw bits, or their text in the value table."""
    if signal.is_float:
        value = float_of(raw, signal.length)
        return f"{value * float(signal.factor) + float(signal.offset):g} {signal.unit}".rstrip()
    return (
        signal.texts.get(raw)
        or f"{float(raw * signal.factor + signal.offset):.10g} {signal.unit}".rstrip()
    )


def _timing(message: MessagePlan) -> str:
    """Send type, cycle and minimum distance of a message, in words."""
    words = {
        f"every {message.cycle_ns // MS} ms": message.cycle_ns,
        "with each frame": SendType.EVENT in message.send_type,
        "on change": SendType.ON_CHANGE in message.send_type,
        f">= {message.delay_ns // MS} ms": message.delay_ns,
    }
    return ", ".join(text for text, applies in words.items() if applies)


def _source(signal: SignalPlan, esc_names: list[str]) -> str:
    """What a signal shows."""
    if signal.unbound:
        return f"(nothing: always {_held(signal, signal.constant)})"
    if signal.source is None:
        text = str(signal.constant) if signal.role is Role.CONSTANT else ""
        return f"({signal.role.value}{' ' + text if text else ''})"
    unit = f" {signal.source.unit}" if signal.source.unit else ""
    prefix = f"{esc_names[signal.esc]}." if signal.esc is not None and len(esc_names) > 1 else ""
    page = f" page {signal.page}" if signal.page is not None else ""
    return f"{prefix}{signal.source.name}{unit}{page}"
