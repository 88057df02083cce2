"""``check``: reports if a configuration can be used and what it sends. It opens no port."""

import argparse
import contextlib
import tomllib
from collections.abc import Iterator
from operator import attrgetter, methodcaller
from pathlib import Path
from typing import Any

from kontronik_can_gw.assembly.assemble import Loaded, load_configuration
from kontronik_can_gw.cli.arguments import CONFIG, JSON, config_file, option
from kontronik_can_gw.cli.common import canopen_setup, say, show
from kontronik_can_gw.cli.recording import events_in_words, in_words, record_folder, ring_size
from kontronik_can_gw.config.export import as_toml
from kontronik_can_gw.dbc.reader import listed
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.native.load import make_core
from kontronik_can_gw.printable import printable_json
from kontronik_can_gw.runtime.status.statistics import NOT_OURS, has_other_content
from kontronik_can_gw.signals.plan import MessageLayout, MessagePlan
from kontronik_can_gw.status import UNCONFIGURED

_EXAMPLE_PORT = "_EXAMPLE-"
"""Part of the port's name in the configuration that ``init`` writes."""
OPTIONS = (
    CONFIG,
    (option("-v --verbose", "also print all keys in effect, messages and signals"), JSON),
)
EPILOG = (
    "Opens neither ports nor interfaces. Each mistake is one line with key and remedy. "
    "kontronik-can-gw describe "
    "shows the objects and PDOs of CANopen nodes. Exit codes: "
    "0 the configuration can be used, perhaps with warnings; "
    "2 it cannot be used."
)


def main(args: argparse.Namespace) -> int:
    path = config_file(args.config)
    try:
        loaded = load_configuration(path)
    except UserError as error:
        if not args.json:
            raise
        result = {"file": str(path), "mistakes": list(error.problems)}
        print(printable_json(result, indent=2))
        return error.exit_code
    examples = [
        f"{loaded.config.file}: esc[{number}].port: {esc.port} is only an example. "
        "Write the name of your port: ls /dev/serial/by-id"
        for number, esc in enumerate(loaded.config.esc, 1)
        if _EXAMPLE_PORT in esc.port
    ]
    warnings = [*loaded.layout.warnings, *loaded.warnings, *examples, *_file_warnings(loaded)]
    shown = document(path, loaded, warnings)
    if args.json:
        print(printable_json(shown, indent=2))
        return 0
    for warning in warnings:
        say(f"warning: {warning}")
    for line in summary(shown, loaded):
        show(line)
    if args.verbose:
        for line in details(loaded):
            show(line)
    return 0


def _file_warnings(loaded: Loaded) -> Iterator[str]:
    """Yield a warning if the status cannot be written, because the file is not the gateway's."""
    file = loaded.config.statistics_path
    if file is None:
        return
    with contextlib.suppress(OSError):  # unreadable for this user, which is not the service's
        if file.is_file() and has_other_content(file):
            yield (
                f"{loaded.config.file}: statistics.file: the status is not written to {file}: "
                f"{NOT_OURS}"
            )


def summary(shown: dict[str, Any], loaded: Loaded) -> Iterator[str]:
    """Yield a summary of the gateway's inputs and outputs, in lines of at most 80 columns."""
    config = loaded.config
    found = _counted(len(shown["warnings"]), "warning") if shown["warnings"] else "no warnings"
    yield f"{shown['file']}: can be used, {found}"
    for esc, settings in zip(config.esc, loaded.escs, strict=True):
        poles = _counted(settings.pole_pairs, "pole pair")
        yield f"  ESC       {esc.name}: {poles}, gear {float(settings.gear):g}"
        yield f"            {esc.port}"
    can = config.can
    rate = f"{can.bitrate // 1000} kbit/s"
    if can.fd:
        rate += f", data {can.data_bitrate // 1000} kbit/s"
    yield f"  CAN       {can.channel} ({can.interface}), {rate}"
    if can.quiet_after_s:
        yield f"            quiet after {can.quiet_after_s} s without telemetry"
    if can.restart_after_ns:
        yield f"            restarted after {can.restart_after_s:g} s in which no frame has left,"
        yield "            if root or the service's user runs the gateway"
    if config.dbc.enabled:
        messages = sorted(loaded.layout.messages, key=attrgetter("extended", "can_id"))
        ends = [f"{each.can_id:0{8 if each.extended else 3}X}h" for each in messages]
        span = " to ".join(dict.fromkeys([*ends[:1], *ends[-1:]]))
        about = ", ".join(filter(None, [_counted(len(messages), "message"), span]))
        yield f"  DBC       {about}, layout {shown['layout']}"
        yield f"            {shown['dbc']}"
    for profile, names in _protected(loaded.layout).items():
        yield f"  E2E       profile {profile}: {listed(names, 3)}"
    for output in loaded.outputs:
        for line in output.summary(loaded.escs):
            yield f"  {line}"
    folder = record_folder(config)
    if folder is not None:
        yield f"  captures  {in_words(config, folder)}"
        if config.record.on_event:
            yield f"            {events_in_words(config)}"
    yield f"  core      {shown['core']}"
    if shown["core_reason"]:
        yield f"            {shown['core_reason']}"
    load = shown["bus_load"]
    frames = shown["frames_per_second"]
    yield f"  bus load  {load:.1%}, {frames:.0f} frames/s: ESCs at 100 Hz, worst stuffing, no SDO"
    worst = shown["worst_bus_load"]
    worst_frames = shown["worst_frames_per_second"]
    if worst_frames > frames:
        condition = "if every value changes all the time"
        yield f"  at worst  {worst:.1%}, {worst_frames:.0f} frames/s: {condition}"


def _protected(layout: MessageLayout) -> dict[str, list[str]]:
    """Return the names of the protected messages by their E2E profile."""
    found: dict[str, list[str]] = {}
    for message in layout.messages:
        if message.e2e is not None:
            found.setdefault(message.e2e.profile.name, []).append(message.name)
    return found


def details(loaded: Loaded) -> Iterator[str]:
    """Yield all keys in effect, the data of further outputs, and the tables of ``describe``."""
    from kontronik_can_gw.desk.describe.markdown import markdown  # not at each start of the service
    from kontronik_can_gw.desk.describe.tables import dbc
    from kontronik_can_gw.desk.recordings.layouts import BusLayout

    yield from ("", *as_toml(loaded.config).splitlines())
    for output in loaded.outputs:
        if lines := output.lines():
            yield from ("", *lines)
    if loaded.database is not None:
        bus = BusLayout(
            loaded.database,
            loaded.layout,
            loaded.escs,
            loaded.config,
        )
        text = markdown("Messages", [], dbc(bus, loaded.escs))
        yield from ("", *text.splitlines())


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def document(path: Path, loaded: Loaded, warnings: list[str]) -> dict[str, Any]:
    """Return the document of ``--json``. The text of ``summary`` is made from it, too."""
    config = loaded.config
    layout = loaded.layout
    can = config.can
    load = layout.bus_load(can.bitrate, can.data_bitrate)
    frames = sum(map(MessagePlan.rate_hz, layout.messages))
    worst = layout.bus_load(can.bitrate, can.data_bitrate, is_worst=True)
    worst_frames = sum(map(methodcaller("rate_hz", is_worst=True), layout.messages))
    for output in loaded.outputs:
        more, bits = output.traffic()
        load += bits / can.bitrate
        frames += more
        more, bits = output.traffic(is_worst=True)
        worst += bits / can.bitrate
        worst_frames += more
    core = make_core(loaded.core_settings, 0)
    node_ids: list[int | None] = []
    setup = canopen_setup(loaded)
    if setup is not None:
        for node in setup.nodes(loaded.escs).nodes:
            node_ids.append(None if node.node_id == UNCONFIGURED else node.node_id)
    return {
        "file": str(path),
        "mistakes": [],
        "warnings": warnings,
        "configuration": tomllib.loads(as_toml(config)),
        "escs": [
            {"name": esc.name, "port": esc.port, "protocol": esc.protocol} for esc in config.esc
        ],
        "can": {"interface": can.interface, "channel": can.channel, "bitrate": can.bitrate},
        "bus_load": load,
        "frames_per_second": frames,
        "worst_bus_load": worst,
        "worst_frames_per_second": worst_frames,
        "dbc": layout.file,
        "layout": layout.fingerprint,
        "e2e": {
            message.name: {
                "profile": message.e2e.profile.name,
                "data_ids": list(message.e2e.data_ids),
            }
            for message in layout.messages
            if message.e2e is not None
        },
        "outputs": {each.name: lines for each in loaded.outputs if (lines := each.lines())},
        "canopen_nodes": node_ids,
        "core": core.language,
        "core_reason": core.note or None,
        "record_ring_bytes": ring_size(config),
    }
