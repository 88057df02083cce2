"""Findings of checks with severity and remedy, worded in checks.toml."""

import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from functools import cache
from pathlib import Path
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


@cache
def wordings() -> dict[str, dict[str, list[str]]]:
    """By check and case: severity, text, remedy, command; the last two may be missing."""
    return tomllib.loads(Path(__file__).with_name("checks.toml").read_text(encoding="utf-8"))


class Findings:
    """Collects the findings of one group. ``values``: for the wording of each of them."""

    def __init__(self, group: str, **values: object) -> None:
        self.group = group
        self.found: list[Finding] = []
        self._values = values

    def say(self, check: str, case: str, **values: object) -> None:
        """Add a case of checks.toml under the name of its check."""
        self.say_as(check, check, case, **values)

    def say_as(self, name: str, check: str, case: str, **values: object) -> None:
        """Add a case of a check that stands for several under another name."""
        severity, *texts = wordings()[check][case]
        filled = [text.format(**{**self._values, **values}) for text in texts]
        self.found.append(Finding(self.group, name, Severity(severity), *filled))


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
        "findings": [asdict(finding) for finding in findings],
    }
