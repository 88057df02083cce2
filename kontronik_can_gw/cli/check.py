"""``check``: says in short whether a configuration can be used and what it sends, without opening anything."""

import argparse
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from kontronik_can_gw.assembly.assemble import Loaded, load_configuration
from kontronik_can_gw.cli.arguments import CONFIG, JSON, config_file, option
from kontronik_can_gw.cli.common import canopen_setups, say, show
from kontronik_can_gw.cli.recording import in_words, record_folder
from kontronik_can_gw.config.export import as_toml
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.printable import printable_json
from kontronik_can_gw.status import UNCONFIGURED

_EXAMPLE_PORT = "_EXAMPLE-"
"""In the port of the configuration that ``init`` writes."""
OPTIONS = (
    CONFIG,
    (option("-v --verbose", "also print all keys in effect, messages and signals"), JSON),
)
EPILOG = (
    "Opens neither ports nor interfaces. Each mistake is one line with key and remedy. kontronik-can-gw describe "
    "shows the objects and PDOs of CANopen nodes. Exit codes: 0 the configuration can be used, perhaps with warnings; "
    "2 it cannot be used."
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
    shown = document(path, loaded, warnings)
    if args.json:
        print(printable_json(shown, indent=2))
        return 0
    for warning in warnings:
        say(f"warning: {warning}")
    for line in summary(shown, loaded):
        show(line)
    for line in details(loaded) if args.verbose else ():
        show(line)
    return 0


def summary(shown: dict[str, Any], loaded: Loaded) -> Iterator[str]:
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
        keys = sorted((each.extended, each.can_id) for each in loaded.layout.messages)
        ids = [f"{can_id:0{8 if extended else 3}X}h" for extended, can_id in keys]
        span = f", {' to '.join(dict.fromkeys((ids[0], ids[-1])))}" if ids else ""
        yield f"  DBC       {_counted(len(ids), 'message')}{span}, layout {shown['layout']}"
        yield f"            {shown['dbc']}"
    for output in loaded.outputs:
        for line in output.summary(loaded.escs):
            yield f"  {line}"
    if (folder := record_folder(config)) is not None:
        yield f"  captures  {in_words(config, folder)}"
    load, frames = shown["bus_load"], shown["frames_per_second"]
    yield f"  bus load  {load:.1%}, {frames:.0f} frames/s: ESCs at 100 Hz, worst stuffing, no SDO"
    worst, worst_frames = shown["worst_bus_load"], shown["worst_frames_per_second"]
    if worst_frames > frames:
        yield f"  at worst  {worst:.1%}, {worst_frames:.0f} frames/s: while all that is sent on change changes"


def details(loaded: Loaded) -> Iterator[str]:
    """Every key in effect, what further outputs send, messages and signals as ``describe`` has them."""
    from kontronik_can_gw.desk.describe.markdown import markdown  # not at each start of the service
    from kontronik_can_gw.desk.describe.tables import dbc
    from kontronik_can_gw.desk.recordings.layouts import BusLayout

    yield from ("", *as_toml(loaded.config).splitlines())
    for output in loaded.outputs:
        if lines := output.lines():
            yield from ("", *lines)
    if loaded.database is not None:
        bus = BusLayout(loaded.database, loaded.layout, loaded.escs, loaded.config)
        yield from ("", *markdown("What is sent", [], dbc(bus, loaded.escs)).splitlines())


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


def document(path: Path, loaded: Loaded, warnings: list[str]) -> dict[str, Any]:
    """The document of ``--json``, and what the text is made of."""
    config, layout = loaded.config, loaded.layout
    can = config.can
    load = layout.bus_load(can.bitrate, can.data_bitrate)
    frames = sum(message.rate_hz for message in layout.messages)
    worst = layout.bus_load(can.bitrate, can.data_bitrate, is_worst=True)
    worst_frames = sum(message.worst_rate_hz for message in layout.messages)
    for output in loaded.outputs:
        more, bits = output.traffic()
        load += bits / can.bitrate
        frames += more
        more, bits = output.traffic(is_worst=True)
        worst += bits / can.bitrate
        worst_frames += more
    node_ids = []
    for setup in canopen_setups(loaded):
        for node in setup.nodes(loaded.escs).nodes:
            node_ids.append(None if node.node_id == UNCONFIGURED else node.node_id)
    return {
        "file": str(path),
        "mistakes": [],
        "warnings": warnings,
        "configuration": tomllib.loads(as_toml(config)),
        "escs": [{"name": e.name, "port": e.port, "protocol": e.protocol} for e in config.esc],
        "can": {"interface": can.interface, "channel": can.channel, "bitrate": can.bitrate},
        "bus_load": load,
        "frames_per_second": frames,
        "worst_bus_load": worst,
        "worst_frames_per_second": worst_frames,
        "dbc": layout.file,
        "layout": layout.fingerprint,
        "outputs": {each.name: lines for each in loaded.outputs if (lines := each.lines())},
        "canopen_nodes": node_ids,
    }
