"""An output before it is made: its settings, the ids that it takes, and the traffic that it causes."""

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any, NamedTuple, Protocol

from kontronik_can_gw.core.output import Output
from kontronik_can_gw.esc.telemetry import EscSettings, EscTelemetry
from kontronik_can_gw.status import GatewayStatus


class Given(NamedTuple):
    """What an output is made from, besides the ESCs: what a capture holds of it."""

    table: Any
    """Its table of the configuration."""
    identity: bytes
    """A digest of what identifies this machine; empty where there is nothing."""
    version: tuple[int, int]
    """Of the program: major and minor."""
    seed: int
    """A random number of 64 bits, of this start."""


class OutputSetup(Protocol):
    """An output that can be made, and what is to be known of it before."""

    @property
    def name(self) -> str:
        """As in OUTPUTS."""

    @property
    def title(self) -> str:
        """What they are, in a sentence."""

    @property
    def given(self) -> Given:
        """What it is made from."""

    def make(self, escs: Sequence[EscTelemetry], gateway: GatewayStatus, now: int) -> Output:
        """The output as it is at the start."""

    def taken_ids(self) -> Mapping[int, str]:
        """The ids and blocks of ids that no message may have, and what has them."""

    def traffic(self) -> tuple[float, float]:
        """Frames and bits a second to be expected, with the most stuffing."""

    def warnings(self, bitrate: int) -> list[str]:
        """What may not work as it is meant, on a bus with this bit rate."""

    def summary(self) -> list[str]:
        """What ``check`` shows, in short: lines of up to 78 characters that begin with the output's name in 10 columns."""

    def lines(self) -> list[str]:
        """What ``check --json`` has: facts a line each."""


OUTPUTS = ("dronecan",)
"""The outputs besides DBC and CANopen: each is a folder, loaded only where it is enabled.

Its module ``setup`` has ``configured``, which makes an OutputSetup; its table of the configuration has its name and a key ``enabled``.
"""


def setup_of(name: str, given: Given, escs: Sequence[EscSettings]) -> OutputSetup:
    """The setup of the output with this name. UserError with the mistakes in its table."""
    setup: OutputSetup = import_module(f"kontronik_can_gw.{name}.setup").configured(given, escs)
    return setup
