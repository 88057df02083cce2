"""Findings of checks with severity and remedy."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

FORMAT = 1
"""Version of the JSON document; its keys stay the same as long as this does."""


class Severity(StrEnum):
    """``ok``: as it should be. ``note``: good to know. ``warning``: works, but not well. ``error``: does not work."""

    OK = "ok"
    NOTE = "note"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True)
class Finding:
    """One line of the report. ``remedy`` says in words what to do, ``command`` is a line to type; either may be empty."""

    group: str
    check: str
    """Stable name for programs, as ``port.parity``."""
    severity: Severity
    text: str
    remedy: str = ""
    command: str = ""


class Findings:
    """Collects the findings of one group."""

    def __init__(self, group: str) -> None:
        self.group = group
        self.found: list[Finding] = []

    def ok(self, check: str, text: str) -> None:
        self.add(Severity.OK, check, text)

    def note(self, check: str, text: str, remedy: str = "", command: str = "") -> None:
        self.add(Severity.NOTE, check, text, remedy, command)

    def warning(self, check: str, text: str, remedy: str = "", command: str = "") -> None:
        self.add(Severity.WARNING, check, text, remedy, command)

    def error(self, check: str, text: str, remedy: str = "", command: str = "") -> None:
        self.add(Severity.ERROR, check, text, remedy, command)

    def add(
        self, severity: Severity, check: str, text: str, remedy: str = "", command: str = ""
    ) -> None:
        self.found.append(Finding(self.group, check, severity, text, remedy, command))


def count(findings: Iterable[Finding], severity: Severity) -> int:
    return sum(finding.severity is severity for finding in findings)


def document(
    findings: Sequence[Finding], version: str, config: str, exit_code: int
) -> dict[str, Any]:
    """The report as one JSON document."""
    return {
        "format": FORMAT,
        "version": version,
        "config": config,
        "exit_code": exit_code,
        "errors": count(findings, Severity.ERROR),
        "warnings": count(findings, Severity.WARNING),
        "findings": [
            {
                "group": finding.group,
                "check": finding.check,
                "severity": finding.severity.value,
                "text": finding.text,
                "remedy": finding.remedy,
                "command": finding.command,
            }
            for finding in findings
        ],
    }
