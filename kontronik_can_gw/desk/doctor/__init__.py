"""The checks of `doctor`: configuration, serial ports, CAN interface and service. They change nothing and send nothing.

A check has a name, a probe (the modules here) and a remedy for each of its results (checks.toml).
"""

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

_WORDINGS: dict[str, dict[str, list[str]]] = tomllib.loads(
    Path(__file__).with_name("checks.toml").read_text(encoding="utf-8")
)
"""By check and case: severity, text, remedy, command; the last two may be missing."""


class Finding(NamedTuple):
    """One line of the report. ``remedy`` says in words what to do, ``command`` is a line to type; either may be empty."""

    group: str
    check: str
    """Stable name for programs, as ``port.parity``."""
    severity: str
    text: str
    remedy: str = ""
    command: str = ""


def count(findings: Sequence[Finding], severity: str) -> int:
    """How many have a severity."""
    return sum(finding.severity == severity for finding in findings)


class Findings:
    """Collects the findings of one group. ``values``: for the wording of each of them."""

    def __init__(self, group: str, **values: object) -> None:
        self.group = group
        self.found: list[Finding] = []
        self.values = values

    def say(self, check: str, case: str, **values: object) -> None:
        """Add a case of a check."""
        severity, *texts = _WORDINGS[check][case]
        filled = [text.format(**{**self.values, **values}) for text in texts]
        self.found.append(Finding(self.group, check, severity, *filled))
