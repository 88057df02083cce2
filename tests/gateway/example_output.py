"""Adds the output of outputs/voltages to the package, as the recipe of docs/recipes.md demands."""

from dataclasses import dataclass
from pathlib import Path

import pytest

import kontronik_can_gw
from kontronik_can_gw.assembly import assemble, capture_setup
from kontronik_can_gw.config import keys, parse
from kontronik_can_gw.config.kinds import BOOLEAN, integer, key
from kontronik_can_gw.core.output_setup import OUTPUTS
from kontronik_can_gw.frames import MAX_EXTENDED_ID

NAME = "voltages"
FIRST_ID = 0x1234500


@dataclass(frozen=True)
class VoltagesConfig:
    """The table of the output: a class in config/output_keys.py."""

    enabled: bool = key(BOOLEAN, False, "send the battery voltage of each ESC")
    first_id: int = key(integer(0, MAX_EXTENDED_ID), FIRST_ID, "29-bit id of the first ESC")


@dataclass(frozen=True, kw_only=True)
class ConfigWithVoltages(keys.Config):
    """The configuration with this table: a line in config/keys.py."""

    voltages: VoltagesConfig


def add_to_package(patch: pytest.MonkeyPatch) -> None:
    """Let the package have the output's folder, its name in OUTPUTS, and its table."""
    folders = [*kontronik_can_gw.__path__, str(Path(__file__).with_name("outputs"))]
    patch.setattr(kontronik_can_gw, "__path__", folders)
    for module in (assemble, capture_setup, parse):
        patch.setattr(module, "OUTPUTS", (*OUTPUTS, NAME))
    patch.setattr(parse, "TABLES", {NAME: VoltagesConfig, **keys.TABLES})
    patch.setattr(parse, "Config", ConfigWithVoltages)
