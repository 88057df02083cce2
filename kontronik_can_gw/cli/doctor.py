"""``doctor``: checks machine and configuration and prints remedies; it changes nothing and sends nothing."""

import argparse
import os
import shutil
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from kontronik_can_gw import __version__
from kontronik_can_gw.canopen.traffic import bits_per_second
from kontronik_can_gw.cli.arguments import CONFIG, JSON
from kontronik_can_gw.cli.common import show
from kontronik_can_gw.cli.recording import record_folder
from kontronik_can_gw.config.assemble import Loaded, assemble
from kontronik_can_gw.config.keys import Config
from kontronik_can_gw.config.nodes import parameter_folder
from kontronik_can_gw.config.output_keys import SHIPPED
from kontronik_can_gw.config.parse import load
from kontronik_can_gw.desk.doctor.can_interface import check_can
from kontronik_can_gw.desk.doctor.findings import Finding, Findings, Severity, count, document
from kontronik_can_gw.desk.doctor.folders import check_folder, check_readable
from kontronik_can_gw.desk.doctor.line import look
from kontronik_can_gw.desk.doctor.machine import check_machine
from kontronik_can_gw.desk.doctor.serial_ports import check_port
from kontronik_can_gw.desk.doctor.service import Unit, unit_of
from kontronik_can_gw.desk.doctor.system import System
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.native.load import in_words, make_core
from kontronik_can_gw.printable import printable, printable_json
from kontronik_can_gw.runtime.open_can import check_interface
from kontronik_can_gw.runtime.store import parameter_file

_STYLES = {
    Severity.OK: "green",
    Severity.NOTE: "cyan",
    Severity.WARNING: "bold yellow",
    Severity.ERROR: "bold red",
}
_INDENT = " " * 11
_WIDTHS = (40, 100)
OPTIONS = (CONFIG, JSON)
EPILOG = (
    "Changes nothing and sends nothing, neither to the bus nor to an ESC; may be called while the gateway runs. "
    "As root it sees more. Exit code: 0 no error (there may be warnings), 1 errors, 2 the configuration cannot be used."
)


def main(args: argparse.Namespace) -> int:
    findings, code = examine(System(), args.config)
    if args.json:
        print(printable_json(document(findings, __version__, str(args.config), code), indent=2))
    else:
        _show(findings)
    return code


def examine(system: System, path: Path) -> tuple[list[Finding], int]:
    """All findings, and the exit code. Parts that do not depend on a mistake in the configuration are checked nevertheless."""
    unit = unit_of(system, str(path.absolute()))
    about = Findings("Configuration")
    config, loaded, refused = _load(path, unit)
    if refused is not None:
        command = "" if config is None else f"kontronik-can-gw check -c {path}"
        for problem in refused.problems:
            about.say("config", "mistake", problem=problem, command=command)
    found = about.found
    if config is not None:
        _configuration(system, about, config, loaded, unit)
        for esc in config.esc:
            line = look if protocol_named(esc.protocol).even_parity else None
            found += check_port(system, esc.name, esc.port, unit, line)
        found += check_can(system, config.can)
    found += check_machine(system, unit)
    code = int(count(found, Severity.ERROR) > 0)
    return found, code if refused is None else refused.exit_code


def _load(path: Path, unit: Unit | None) -> tuple[Config | None, Loaded | None, UserError | None]:
    """Configuration, the objects made from it, and the error; None for what could not be made."""
    config = None
    try:
        config = load(path)
        if unit is not None and config.canopen.store is None:  # as set by systemd
            config = replace(config, canopen=replace(config.canopen, store=unit.state_folder))
        check_interface(config.can)
        return config, assemble(config), None
    except UserError as error:
        return config, None, error


def _configuration(
    system: System, findings: Findings, config: Config, loaded: Loaded | None, unit: Unit | None
) -> None:
    if loaded is not None:
        _outputs(findings, config, loaded)
        _warnings(findings, config, loaded)
    files = [Path(config.file)]
    if config.dbc.enabled and config.dbc.file != SHIPPED:
        files.append(config.dbc_path)
    if config.canopen.enabled and config.canopen.eds != SHIPPED:
        files.append(config.eds_path)
    for file in files:
        check_readable(system, findings, str(file.absolute()), unit)

    def check(name: str, what: str, folder: Path, reserve: int = 0) -> None:
        path = str(folder.absolute())
        check_folder(system, findings, f"config.{name}", what, path, unit, reserve)

    if config.canopen.enabled:
        check("store", "stored parameters", parameter_folder(config))
    if (captures := record_folder(config)) is not None:
        check("record", "captures", captures, config.record.min_free_mb * 1_000_000)
    if config.statistics_path is not None:
        check("statistics", "statistics", config.statistics_path.absolute().parent)


def _outputs(findings: Findings, config: Config, loaded: Loaded) -> None:
    number = len(config.esc)
    words = [f"{number} ESC{'s' * (number > 1)}"]
    load = loaded.layout.bus_load(config.can.bitrate, config.can.data_bitrate)
    if config.dbc.enabled:
        words.append(f"{len(loaded.layout.messages)} messages of {config.dbc_path.name}")
    if loaded.canopen is not None:
        nodes = loaded.canopen.nodes(loaded.escs).nodes
        words.append(f"{len(nodes)} CANopen node{'s' * (number > 1)} of {config.eds_path.name}")
        load += bits_per_second(nodes) / config.can.bitrate
    findings.say("config", "ok", file=config.file, outputs=", ".join(words))
    findings.say("config.bus_load", "ok", load=load, kilobits=config.can.bitrate // 1000)
    core, why = make_core(loaded.escs, loaded.layout, 0, silent=False)
    findings.say("config.core", "python" if why else "ok", core=in_words(core.language, why))


def _warnings(findings: Findings, config: Config, loaded: Loaded) -> None:
    damaged = {}
    for esc, reason in loaded.damaged:
        name = loaded.escs[esc].name
        damaged[f"{name}: stored parameters: {reason}"] = name
    for warning in (*loaded.layout.warnings, *loaded.warnings):
        if warning not in damaged:
            findings.say("config.warning", "any", warning=warning)
    for damage, name in damaged.items():
        is_open = os.access(parameter_file(parameter_folder(config), name), os.R_OK)
        findings.say("config.parameters", "damaged" if is_open else "closed", damage=damage)


def _show(findings: list[Finding]) -> None:
    lowest, highest = _WIDTHS
    lines = _lines(findings, max(lowest, min(highest, shutil.get_terminal_size().columns)))
    if not sys.stdout.isatty():
        for word, _, text in lines:
            show(word + text)
        return
    from rich.console import Console
    from rich.text import Text

    console = Console(highlight=False, soft_wrap=True)
    for word, style, text in lines:
        console.print(Text.assemble((printable(word), style), printable(text)))


def _lines(findings: list[Finding], width: int) -> Iterator[tuple[str, str, str]]:
    """The lines of the report: a word, its style, text. Commands are not wrapped, so that they can be copied."""
    group = ""
    for finding in findings:
        if finding.group != group:
            if group:
                yield "", "", ""
            group = finding.group
            yield group, "bold", ""
        first, *more = _wrapped(finding.text, width) or [""]
        yield f"  {finding.severity:<9}", _STYLES[finding.severity], first
        for line in more:
            yield "", "", _INDENT + line
        arrow = "-> "
        for line in _wrapped(finding.remedy, width - len(arrow)):
            yield "", "", f"{_INDENT}{arrow}{line}"
            arrow = "   "
        if finding.command:
            yield _INDENT + arrow, "", finding.command
    yield "", "", ""
    parts = []
    for severity in (Severity.ERROR, Severity.WARNING, Severity.NOTE):
        number = count(findings, severity)
        parts.append(f"{number or 'no'} {severity}{'s' * (number != 1)}")
    yield "", "", ", ".join(parts)


def _wrapped(text: str, width: int) -> list[str]:
    return textwrap.wrap(text, width - len(_INDENT), break_on_hyphens=False)
