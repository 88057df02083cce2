"""``check``: says in short whether a configuration can be used and what it sends, without opening anything."""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from kontronik_can_gw.canopen.nodes import Nodes
from kontronik_can_gw.cli.arguments import CONFIG, JSON, config_file, option
from kontronik_can_gw.cli.check_details import can_id, details, lost, source, timing
from kontronik_can_gw.cli.common import say, show
from kontronik_can_gw.cli.recording import in_words, record_folder
from kontronik_can_gw.config.assemble import Loaded, load_configuration
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.node_state import UNCONFIGURED
from kontronik_can_gw.printable import printable_json

_EXAMPLE_PORT = "_EXAMPLE-"
"""In the port of the configuration that ``init`` writes."""
OPTIONS = (
    CONFIG,
    (
        option("-v --verbose", "every key in effect, message, signal with its source, and node"),
        JSON,
    ),
)
EPILOG = (
    "Opens no port and no interface. Exit code: 0 it can be used (there may be warnings), 2 it cannot: "
    "each mistake is a line, with key and remedy."
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
    warnings = [*loaded.layout.warnings, *loaded.warnings, *_examples(loaded)]
    nodes = None if loaded.canopen is None else loaded.canopen.nodes(loaded.escs)
    if args.json:
        print(printable_json(document(path, loaded, nodes, warnings), indent=2))
        return 0
    for warning in warnings:
        say(f"warning: {warning}")
    for line in summary(path, loaded, nodes, len(warnings)):
        show(line)
    if args.verbose:
        show()
        for line in details(loaded, nodes):
            show(line)
    return 0


def _examples(loaded: Loaded) -> Iterator[str]:
    """A warning for each port that is still the example's."""
    for esc in loaded.config.esc:
        if _EXAMPLE_PORT in esc.port:
            yield (
                f"{loaded.config.file}: port of {esc.name}: {esc.port} is the example's. "
                "Write the name of yours: ls /dev/serial/by-id"
            )


def summary(path: Path, loaded: Loaded, nodes: Nodes | None, warnings: int) -> Iterator[str]:
    """What the gateway reads and sends, in a few lines that fit 80 columns."""
    config, layout = loaded.config, loaded.layout
    found = _counted(warnings, "warning") if warnings else "no warnings"
    yield f"{path}: can be used, {found}"
    for esc, settings in zip(config.esc, loaded.escs, strict=True):
        yield f"  ESC       {esc.name}: {_counted(settings.pole_pairs, 'pole pair')}, gear {float(settings.gear):g}"
        yield f"            {esc.port}"
    can = config.can
    rate = f"{can.bitrate // 1000} kbit/s" + (
        f", data {can.data_bitrate // 1000} kbit/s" if can.fd else ""
    )
    yield f"  CAN       {can.channel} ({can.interface}), {rate}"
    if config.dbc.enabled:
        ids = [can_id(message) for message in sorted(layout.messages, key=lambda each: each.can_id)]
        span = f", {' to '.join(dict.fromkeys((ids[0], ids[-1])))}" if ids else ""
        yield f"  DBC       {_counted(len(layout.messages), 'message')}{span}, layout {layout.fingerprint}"
        yield f"            {layout.file}"
    for node, each in zip(nodes.nodes if nodes else (), loaded.escs, strict=False):
        sent = f"node {node.node_id}, {_counted(sum(tpdo.valid for tpdo in node.tpdos), 'TPDO')}"
        yield f"  CANopen   {each.name}: {'waits for LSS' if node.node_id == UNCONFIGURED else sent}"
    for output in loaded.outputs:
        for line in output.summary():
            yield f"  {line}"
    if (folder := record_folder(config)) is not None:
        yield f"  captures  {in_words(config, folder)}"
    load, frames = _traffic(loaded, nodes)
    yield f"  bus load  {load:.1%}, {frames:.0f} frames/s: ESCs at 100 Hz, worst stuffing, no SDO"


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


def _traffic(loaded: Loaded, nodes: Nodes | None) -> tuple[float, float]:
    """Share of the bus and frames a second. What is sent on change is counted by its cycle."""
    can, layout = loaded.config.can, loaded.layout
    load = layout.bus_load(can.bitrate, can.data_bitrate)
    frames = sum(message.rate_hz for message in layout.messages)
    others = [] if nodes is None else [nodes.traffic()]
    for more, bits in (*others, *(output.traffic() for output in loaded.outputs)):
        load += bits / can.bitrate
        frames += more
    return load, frames


def document(
    path: Path, loaded: Loaded, nodes: Nodes | None, warnings: list[str]
) -> dict[str, Any]:
    """The same as JSON, with every message and signal."""
    config, layout = loaded.config, loaded.layout
    names = [esc.name for esc in loaded.escs]
    load, frames = _traffic(loaded, nodes)
    return {
        "file": str(path),
        "mistakes": [],
        "warnings": warnings,
        "escs": [{"name": e.name, "port": e.port, "protocol": e.protocol} for e in config.esc],
        "can": {
            "interface": config.can.interface,
            "channel": config.can.channel,
            "bitrate": config.can.bitrate,
        },
        "bus_load": load,
        "frames_per_second": frames,
        "dbc": layout.file,
        "layout": layout.fingerprint,
        "messages": [
            {
                "name": message.name,
                "id": can_id(message),
                "sent": timing(message),
                "signals": {
                    signal.name: {"source": source(signal, names), "lost": lost(message, signal)}
                    for signal in message.signals
                },
            }
            for message in layout.messages
        ],
        "outputs": {output.name: output.lines() for output in loaded.outputs},
        "canopen_nodes": [
            None if node.node_id == UNCONFIGURED else node.node_id
            for node in (nodes.nodes if nodes else ())
        ],
    }
