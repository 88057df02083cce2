"""Findings of checks with severity and remedy, worded in checks.toml."""

import tomllib
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from pathlib import Path


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
        self.values = values

    def say(self, check: str, case: str, **values: object) -> None:
        """Add a case of a check."""
        severity, *texts = wordings()[check][case]
        filled = [text.format(**{**self.values, **values}) for text in texts]
        self.found.append(Finding(self.group, check, Severity(severity), *filled))
