"""How a DBC is used: the part of the configuration that the compiler needs."""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class DbcSettings:
    """How a DBC is used. ``bind``: "Message.Signal" or "Signal" to a source name (``name`` or ``esc.name``) or a constant."""

    bind: Mapping[str, str | float] = field(default_factory=dict)
    node: str | None = None
    """The transmitter node whose messages we send; None: the only one that sends."""
    base_id: int | None = None
    id_step: int | None = None
    data_ids: Mapping[str, int] = field(default_factory=dict)
    """Message name to E2E data id; otherwise the CAN id's low 16 bits."""
    units: Mapping[str, str] = field(default_factory=dict)
    """Unit text of the DBC to the unit that it means."""
    send_types: Mapping[str, str] = field(default_factory=dict)
    """GenMsgSendType to the entry of ``send_types.NAMES`` that it means."""
    messages: tuple[str, ...] = ()
    """Patterns that select our messages by name (used by ``prepare``); empty: all."""
    unbound: str = "error"
    """For a signal without a source: "error", or always send its "start_value"."""
    flags_on_loss: int | None = None
    """Value without telemetry of a flag that has no code for it; None: its own start value, else 0."""
