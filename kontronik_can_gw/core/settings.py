"""The settings of a core: one object, which both cores and the export get."""

from collections.abc import Sequence
from dataclasses import dataclass

from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.times import END_OF_TIME

NUMBERS = {"quiet_after_ns": END_OF_TIME - 1}
"""The settings that are one number, each with its largest value.

A capture's header and the core in C (``kcg_plan``) have them by these names.
"""


@dataclass(frozen=True)
class CoreSettings:
    """Everything that a core is told at its start.

    It is made from a configuration (``Config.core_settings``) or from a capture's header
    (``assembly/capture_setup.py``).
    """

    escs: Sequence[EscSettings]
    layout: MessageLayout
    """The messages of the DBC. They may be none."""
    silent_on_loss: bool = False
    """Messages stop while telemetry is lost (``core/messages.py: Traits``)."""
    quiet_after_ns: int = 0
    """Time without telemetry after which quiet mode begins. 0: never."""
    slots: int = 0
    """Number of slots of each ESC for which the core in C has room. Python runs further ones."""

    @property
    def numbers(self) -> dict[str, int]:
        """The settings of NUMBERS by name."""
        return {name: getattr(self, name) for name in NUMBERS}
