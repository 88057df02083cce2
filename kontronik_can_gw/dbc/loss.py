"""What signals hide: flags without a code for "not available" where nothing reports lost telemetry, values that a protocol lacks."""

from collections.abc import Sequence

from kontronik_can_gw.dbc.reader import listed
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.signals.packer import has_code
from kontronik_can_gw.signals.plan import Layout, MessagePlan, SignalPlan

_OF_LINK = frozenset({"link_state", "data_age"})


def is_mute(signal: SignalPlan) -> bool:
    """True for a flag that shows one of its two values without telemetry."""
    source = signal.source
    if source is None or source.bit is None or signal.is_float or not source.supplied:
        return False
    values = {value * signal.slope + signal.intercept for value in (0, 1)}
    return source.group in (Group.LIVE, Group.INFO) and signal.not_available in values


def reporter(message: MessagePlan, flag: SignalPlan) -> SignalPlan | None:
    """The signal in the same frame as the flag that reports the loss."""
    for signal in message.signals:
        source = signal.source
        if source is None or signal.esc != flag.esc or signal.page not in (None, flag.page):
            continue
        assert flag.source is not None
        if source.name in _OF_LINK and flag.source.group is Group.LIVE:
            return signal
        if source.group is flag.source.group and not source.optional and has_code(signal):
            return signal
    return None


def unreported(layout: Layout, silent: bool) -> list[str]:
    """A warning for each message whose flags hide the loss of telemetry. ``silent``: ``dbc.on_loss``."""
    found = []
    for message in layout.messages:
        stops = bool(message.paces & {Group.LIVE, Group.INFO}) and Group.LINK not in message.paces
        flags = [s.name for s in message.signals if is_mute(s) and reporter(message, s) is None]
        if flags and not (silent and stops):
            remedy = ', or set dbc.on_loss = "silent"' if stops else ""
            found.append(
                f"{layout.file}: {message.name}: without telemetry {listed(flags, 3)} are sent as if they were known, and no signal "
                f"of the message reports the loss. Add one bound to link_state, or with NotAvailable in its value table{remedy}."
            )
    return found


def unsupplied(layout: Layout, escs: Sequence[EscSettings]) -> list[str]:
    """A warning for each message with values that the protocol of their ESC does not have."""
    found = []
    for message in layout.messages:
        missing = [s for s in message.signals if s.source is not None and not s.source.supplied]
        if missing:
            names = listed((signal.name for signal in missing), 3)
            whose = " or ".join(sorted({escs[signal.esc or 0].protocol for signal in missing}))
            found.append(
                f"{layout.file}: {message.name}: {names}: not supplied by the protocol {whose}, never available. "
                "A flag, which has no code for that, is sent as 0 or its start value."
            )
    return found
