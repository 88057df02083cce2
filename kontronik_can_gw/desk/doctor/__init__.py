"""The checks of `doctor`: configuration, serial ports, CAN interface and service.

They change nothing and send nothing. A check has a name, a probe (one of these modules), and a
remedy for each of its results (checks.toml).
"""

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

_WORDINGS: dict[str, dict[str, list[str]]] = tomllib.loads(
    Path(__file__).with_name("checks.toml").read_text(encoding="utf-8")
)
"""By check and case: severity, text, remedy, command. The last two may be missing."""


class Finding(NamedTuple):
    """One line of the report."""

    group: str
    check: str
    """Stable name for programs, for example ``port.parity``."""
    severity: str
    text: str
    remedy: str = ""
    """Instructions for the user, or empty."""
    command: str = ""
    """A command line to type, or empty."""


def count(findings: Sequence[Finding], severity: str) -> int:
    """Return the number of findings with a severity."""
    return sum(finding.severity == severity for finding in findings)


class Findings:
    """Collects the findings of one group. ``values`` are inserted into the texts of all of them."""

    def __init__(self, group: str, **values: object) -> None:
        self.group = group
        self.found: list[Finding] = []
        self.values = values

    def add(self, check: str, case: str, **values: object) -> None:
        """Add the finding for a case of a check."""
        severity, *texts = _WORDINGS[check][case]
        all_values = self.values | values
        filled = [text.format(**all_values) for text in texts]
        self.found.append(Finding(self.group, check, severity, *filled))
