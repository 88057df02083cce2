"""Makes the support bundle of `doctor --bundle`: the output of other commands, files and captures.

The bundle is written even if the gateway does not run, the configuration has mistakes, or files
cannot be read. Each missing part is reported in one line.
"""

import argparse
import io
import json
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from typing import Any

from kontronik_can_gw.cli import make_parser, say
from kontronik_can_gw.cli.desk import watched
from kontronik_can_gw.cli.output import check_output, configuration_files, writing
from kontronik_can_gw.cli.recording import record_folder
from kontronik_can_gw.config.parse import load
from kontronik_can_gw.desk.bundle.archive import write_archive
from kontronik_can_gw.desk.bundle.parts import (
    Contents,
    add_captures,
    add_configuration,
    add_journal,
    add_versions,
    known_secrets,
)
from kontronik_can_gw.desk.bundle.secrets import Cleaner
from kontronik_can_gw.desk.doctor import Finding
from kontronik_can_gw.desk.doctor.machine import Machine
from kontronik_can_gw.desk.doctor.service import ServiceUnit, unit_of
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.runtime.status.facts import utc

_STATE = "state"
_RUNNING = (0, 1)
"""Exit codes of `status` for a running gateway."""


def write_bundle(
    args: argparse.Namespace,
    machine: Machine,
    config: Path,
    findings: Sequence[Finding],
    report: Callable[[Sequence[Finding]], Iterable[str]],
) -> int:
    """Write the bundle of a configuration. Returns the exit code.

    ``findings`` are the results of doctor, and ``report`` returns their lines.
    """
    if args.bundle == "-":
        raise UserError("--bundle: a zip file cannot be shown. Give the name of a file.")
    inputs = [config]
    with suppress(UserError):
        inputs = configuration_files(config)
    check_output(args.bundle, inputs, force=args.force)
    if Path(args.bundle).exists() and not Path(args.bundle).is_file():
        raise UserError(f"{args.bundle}: is not a regular file. Give another name.")
    made_ns = time.time_ns()
    contents = Contents(Cleaner(known_secrets(config)))
    _add_findings(contents, findings, report)
    with contents.noting("check.txt"):  # --verbose would show the comments of the DBC
        check_code, text = printed(["check", "-c", str(config)])
        contents.add_text("check.txt", f"{text}exit code {check_code}\n")
    document = _add_status(contents, config)
    add_configuration(contents, config, with_dbc=not args.without_dbc)
    if args.without_dbc:
        contents.missing.append("dbc: left out by --without-dbc")
    add_journal(contents, machine)
    add_versions(contents, machine, utc(made_ns / 1e9))
    if args.without_captures:
        contents.missing.append("captures: left out by --without-captures")
    else:
        unit = unit_of(machine, str(config.absolute()))
        folders = capture_folders(
            machine,
            config,
            unit,
            document,
        )
        add_captures(
            contents,
            folders,
            with_dbc=not args.without_dbc,
            watch=_watched,
        )
    with writing(args.bundle, force=args.force) as out:
        write_archive(out.open(), contents, made_ns)
        out.is_whole = True
    for line in contents.missing:
        say(contents.cleaner.text(f"missing: {line}", "messages"), "doctor")
    say(f"{args.bundle} written. README.txt in it lists the removed secrets.", "doctor")
    return 0


def _watched(data: Iterator[bytes], name: str) -> Iterator[bytes]:
    """Show how much of a capture was read, because it may be large."""
    return watched(data, f"{name}: bytes", data_on_screen=False)


def _add_findings(
    contents: Contents,
    findings: Sequence[Finding],
    report: Callable[[Sequence[Finding]], Iterable[str]],
) -> None:
    """Add the report of doctor. It is cleaned before its lines are wrapped."""
    name = "doctor.txt"
    cleaned = []
    for finding in findings:
        texts = [contents.cleaner.text(text, name) for text in finding]
        cleaned.append(Finding(*texts))
    contents.add_text(name, "".join(f"{line}\n" for line in report(cleaned)))


def printed(words: Sequence[str]) -> tuple[int, str]:
    """Run a command, and return its exit code and everything that it prints."""
    out = io.StringIO()
    with redirect_stdout(out), redirect_stderr(out):
        args = make_parser([words[0]]).parse_args(words)
        try:
            code: int = args.main(args)
        except UserError as error:
            code = error.exit_code
            for problem in error.problems:
                say(problem, words[0])
    return code, out.getvalue()


def _add_status(contents: Contents, config: Path) -> Any:
    """Add the state of the gateway with this configuration, or of all if there is no such gateway.

    Returns the document of ``status --json``, or None.
    """
    document = None
    with contents.noting("status.txt"):
        words = ["status", "-c", str(config)]
        code, text = printed(words)
        if code not in _RUNNING:
            contents.missing.append(f"status: {text.splitlines()[0].partition(': ')[2]}")
            words = words[:1]
            _, every = printed(words)
            if every != text:
                text += every
        contents.add_text("status.txt", f"{text}exit code {code}\n")
        _, shown = printed([*words, "--json"])
        document = json.loads(shown[: shown.rindex("}") + 1]) if "}" in shown else None
        if document is not None and document["gateways"]:
            contents.add_document("status.json", document)
    return document


def capture_folders(
    machine: Machine, config: Path, unit: ServiceUnit | None, document: Any
) -> Iterator[Path]:
    """Yield the folders of captures: of the running gateway, and of the configuration."""
    for gateway in (document or {}).get("gateways", ()):
        recording = (gateway.get("document") or {}).get("recording") or {}
        if recording.get("file"):
            yield Path(recording["file"]).parent
    with suppress(UserError):
        configured = load(config)
        if configured.record.directory == _STATE and unit is not None:
            yield machine.path(f"{unit.state_folder}/captures")
        elif (folder := record_folder(configured)) is not None:
            yield folder
