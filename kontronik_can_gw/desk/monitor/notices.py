"""Notices about the gateway and the bus, and the fault of an ESC's link, with remedies. Pure."""

from collections.abc import Iterator
from enum import Enum

from kontronik_can_gw.desk.member import Flag
from kontronik_can_gw.desk.monitor.model import SILENCE_NS, Esc, Monitor
from kontronik_can_gw.desk.sources import Source
from kontronik_can_gw.desk.words import words
from kontronik_can_gw.esc.decoder import Severity
from kontronik_can_gw.esc.value_names import normalize
from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.runtime.system.fault_log import duration
from kontronik_can_gw.times import MS

_NO_TELEMETRY = "no telemetry{since}: is the ESC powered and its cable plugged in?"
_TROUBLES = {
    "searching": (
        "bytes but no telemetry: is it the right port? Does the ESC send {protocol} telemetry?"
    ),
    "porterror": "the gateway cannot open the port: see its log, or kontronik-can-gw status",
}


class NoticeKind(Enum):
    """The kind of a notice."""

    REPLAY = "replay"
    FAULT = "fault"
    HINT = "hint"
    WAITING = "waiting"


def notices(monitor: Monitor, source: Source) -> Iterator[tuple[str, NoticeKind]]:
    """Yield notices about gateway and source with their kinds."""
    frames = f"frames of {monitor.file} on {source.name}"
    if monitor.is_replay and not source.is_file:
        text = "REPLAY: the gateway plays a recording; these are not values of a live ESC."
        yield text, NoticeKind.REPLAY
    has_no_frame = not monitor.view.frames
    if source.problem:
        yield source.problem, NoticeKind.FAULT
    elif source.has_ended and has_no_frame:
        text = f"{source.name} contains no frame of {monitor.file}."
        yield f"{text} Give the DBC of its frames (-c, --dbc).", NoticeKind.FAULT
    elif monitor.is_quiet:
        yield "the gateway is quiet: it sends again when an ESC is heard.", NoticeKind.HINT
    elif source.is_file:
        pass  # a recording may have pauses without a fault
    elif monitor.silent_ns >= SILENCE_NS:
        yield f"no {frames}", NoticeKind.FAULT
        for hint in source.hints:
            yield hint, NoticeKind.HINT
    elif has_no_frame:
        yield f"waiting for {frames} ...", NoticeKind.WAITING
    count = monitor.gateway.number("esc_count")
    known = len(monitor.escs)
    if count is not None and count > known:
        text = f"the gateway has {count:.0f} ESCs, but the DBC in use describes {known}. "
        yield text + "Give its configuration (-c) or DBC (--dbc).", NoticeKind.HINT


def link_of(esc: Esc) -> tuple[str, str]:
    """Return the state of an ESC's link in words, alone and with the frame rate of a good link.

    A dash means not available.
    """
    link = "-"
    if esc.link is not None:
        link = words(esc.link)
    elif esc.is_known(Group.LIVE) and not esc.has("link_state"):
        link = "ok"
    rate = esc.number("frame_rate")
    if rate is not None and link == "ok":
        return link, f"ok {rate:.0f} Hz"
    return link, link


def trouble_of(esc: Esc) -> Flag | None:
    """Return the fault of an ESC's link with its remedy. None if there is no fault."""
    link = normalize(esc.link or "")
    if esc.is_known(Group.LIVE) or link in ("", "ok"):
        if link != "degraded":
            return None
        remedy = "Check cable and ground."
        return Flag("link", Severity.WARNING, "frames are damaged", remedy)
    age = esc.number("data_age")
    since = ""
    if age is not None and link != "neverseen":
        since = f" for {duration(round(age * MS))}"
    text = _TROUBLES.get(link, _NO_TELEMETRY)
    text = text.format(protocol=esc.protocol.name.upper(), since=since)
    return Flag("link", Severity.ERROR, text)
