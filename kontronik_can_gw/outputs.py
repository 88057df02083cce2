"""The outputs besides DBC and CANopen: each is a folder, loaded only where it is enabled.

Its module ``setup`` has ``configured``, which makes an OutputSetup; its table of the configuration has its name and a key ``enabled``.
"""

from collections.abc import Sequence
from importlib import import_module

from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.output import Given, OutputSetup

OUTPUTS = ("dronecan",)


def setup_of(name: str, given: Given, escs: Sequence[EscSettings]) -> OutputSetup:
    """The setup of the output with this name. UserError with the mistakes in its table."""
    setup: OutputSetup = import_module(f"{__package__}.{name}.setup").configured(given, escs)
    return setup
