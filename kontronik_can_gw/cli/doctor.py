"""``doctor``: checks machine and configuration and prints remedies.

It changes nothing and sends nothing.
"""

import argparse
import platform
import textwrap
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from kontronik_can_gw import __version__
from kontronik_can_gw.assembly.assemble import Loaded, assemble
from kontronik_can_gw.assembly.this_machine import parameter_folder
from kontronik_can_gw.cli.arguments import (
    CONFIG,
    CONFIG_PLACES,
    FORCE,
    JSON,
    config_file,
    default_config,
    option,
)
from kontronik_can_gw.cli.common import show
from kontronik_can_gw.cli.recording import record_folder
from kontronik_can_gw.config.keys import Config
from kontronik_can_gw.config.parse import load
from kontronik_can_gw.desk.doctor import Finding, Findings, count
from kontronik_can_gw.desk.doctor.can import check_can
from kontronik_can_gw.desk.doctor.clock import check_clock
from kontronik_can_gw.desk.doctor.machine import Machine
from kontronik_can_gw.desk.doctor.ports import check_port, diagnoses
from kontronik_can_gw.desk.doctor.service import (
    ServiceUnit,
    check_file_system,
    check_folder,
    check_service,
    unit_of,
)
from kontronik_can_gw.desk.monitor.status import NOT_RUNNING, look_at_first, possible_files
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.native.load import in_words, make_core
from kontronik_can_gw.printable import printable_json
from kontronik_can_gw.runtime.can.open_can import check_interface

_GAP = " " * 11
"""Indentation of the further lines of a finding."""
OPTIONS = (
    CONFIG,
    (
        JSON,
        option("--bundle FILE", "write a zip file for support, without passwords and keys"),
        option("--parcel FILE", argparse.SUPPRESS, dest="bundle"),  # the name until 0.6.0
    ),
    option("--without-captures", "leave captures out of the bundle"),
    option("--without-dbc", "leave the DBC out of the bundle, also out of its captures"),
    FORCE,
)
EPILOG = (
    "It changes nothing, and sends nothing to the bus or to an ESC, so you can call it while the "
    "gateway runs. "
    "It has the permissions of its user. To check the permissions of the service, run it as the "
    "service's user "
    "(sudo -u kontronik-can-gw). Root sees more. "
    "Exit codes: 0 no error, perhaps warnings; 1 errors; 2 the configuration cannot be used. "
    "With --bundle: 0 the file was written, 1 it was not."
)


def main(args: argparse.Namespace) -> int:
    machine = Machine()
    if args.bundle is not None:
        from kontronik_can_gw.cli.bundle import write_bundle

        # support needs the bundle even if there is no configuration
        config = args.config or default_config() or CONFIG_PLACES[-1]
        findings, _ = examine(machine, config)
        return write_bundle(
            args,
            machine,
            config,
            findings,
            report_lines,
        )
    config = config_file(args.config)
    findings, code = examine(machine, config)
    if args.json:
        document = {
            "format": 1,
            "version": __version__,
            "config": str(config),
            "exit_code": code,
            "errors": count(findings, "error"),
            "warnings": count(findings, "warning"),
            "findings": [finding._asdict() for finding in findings],
        }
        print(printable_json(document, indent=2))
    else:
        for line in report_lines(findings):
            show(line)
    return code


def examine(machine: Machine, path: Path) -> tuple[list[Finding], int]:
    """Return all findings and the exit code.

    If the configuration has mistakes, the parts that do not depend on them are checked.
    """
    full = str(path.absolute())
    unit = unit_of(machine, full)
    about = Findings("Configuration")
    rest = Findings("Machine")
    found = about.found
    config = None
    code = 0
    try:
        config = load(path)
        if unit is not None and config.canopen.store is None:  # systemd sets the folder
            canopen = replace(config.canopen, store=unit.state_folder)
            config = replace(config, canopen=canopen)
        check_interface(config.can)
        _outputs(about, assemble(config))
    except UserError as error:
        code = error.exit_code
        command = ""
        if config is not None:
            command = f"kontronik-can-gw check -c {path}"
        for problem in error.problems:
            about.add(
                "config",
                "mistake",
                problem=problem,
                command=command,
            )
    if config is not None:
        _folders(machine, about, config, unit)
        files = [machine.path(str(file)) for file in possible_files(path)]
        seen = look_at_first(files, time.monotonic_ns(), path)
        reasons = {} if seen.code == NOT_RUNNING else diagnoses(seen.document)
        for esc in config.esc:
            even = protocol_named(esc.protocol).even_parity
            found += check_port(machine, esc.name, esc.port, even, reasons.get(esc.name, ""))
        found += check_can(machine, config.can)
    check_service(machine, rest, unit, full)
    check_clock(machine, rest)
    if _has_low_voltage(machine):
        rest.add("machine.power", "low")
    versions = {"python": platform.python_version(), "kernel": platform.release()}
    rest.add(
        "machine.versions",
        "ok",
        version=__version__,
        **versions,
    )
    found += rest.found
    if code == 0 and count(found, "error") > 0:
        code = 1
    return found, code


def _has_low_voltage(machine: Machine) -> bool:
    """Return True for a Raspberry Pi's alarm about its supply. USB adapters suffer first."""
    folder = "/sys/class/hwmon"
    files = [f"{folder}/{name}/in0_lcrit_alarm" for name in machine.names(folder)]
    return any(machine.text(file) == "1" for file in files)


def _outputs(findings: Findings, loaded: Loaded) -> None:
    """Report the core that would run, and warnings."""
    findings.add("config", "ok", file=loaded.config.file)
    core = make_core(loaded.core_settings, 0)
    case = "python" if core.note else "ok"
    findings.add("config.core", case, core=in_words(core.language, core.note))
    for warning in (*loaded.layout.warnings, *loaded.warnings):
        findings.add("config.warning", "any", warning=warning)


def _folders(
    machine: Machine, findings: Findings, config: Config, unit: ServiceUnit | None
) -> None:
    """Check the folders to which the gateway writes."""
    store = parameter_folder(config) if config.canopen.enabled else None
    status = config.statistics_path
    reserve = config.record.min_free_mb * 1_000_000
    folders = (
        ("stored parameters", store, 0),
        ("captures", record_folder(config), reserve),
        ("statistics", status.parent if status else None, 0),
    )
    for use, folder, min_free in folders:
        if folder is not None:
            path = folder.absolute()
            own = unit is not None and path.is_relative_to(unit.state_folder)
            check_folder(
                machine,
                findings,
                use,
                str(path),
                own,
                min_free,
            )
    if store is not None:
        check_file_system(machine, findings, "stored parameters", str(store.absolute()))


def report_lines(findings: Sequence[Finding]) -> Iterator[str]:
    """Yield the report in 80 columns. Commands are not wrapped, so that they can be copied."""
    group = ""
    for finding in findings:
        if finding.group != group:
            group = finding.group
            yield group
        yield from _wrapped(f"  {finding.severity:<9}", finding.text)
        yield from _wrapped(f"{_GAP}-> ", finding.remedy)
        if finding.command:
            yield f"{_GAP}$ {finding.command}"
    counts = []
    for severity in ("error", "warning", "note"):
        number = count(findings, severity)
        noun = severity if number == 1 else f"{severity}s"
        counts.append(f"{number or 'no'} {noun}")
    yield ", ".join(counts)


def _wrapped(first: str, text: str) -> list[str]:
    """Return the lines of a text after ``first``, with its further lines indented."""
    return textwrap.wrap(
        text, 80, initial_indent=first, subsequent_indent=_GAP, break_on_hyphens=False
    )
