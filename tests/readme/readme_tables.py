"""The tables of README.md and docs/, made from their sources of truth. ``python tests/readme/readme_tables.py`` writes them there."""

import re
from dataclasses import MISSING, fields
from fractions import Fraction
from pathlib import Path

import cantools.database

from kontronik_can_gw.canopen.data_types import ARRAY, RECORD
from kontronik_can_gw.canopen.eds import Eds, load
from kontronik_can_gw.canopen.emergency_codes import BitCodes, GatewayError
from kontronik_can_gw.canopen.objects import BINDINGS
from kontronik_can_gw.config.keys import TABLES as KEYS
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.esc.kontronik.states import OperatingError
from kontronik_can_gw.esc.values import VALUES, Group

PROJECT = Path(__file__).resolve().parents[2]
PAGES = {
    path: path.read_text(encoding="utf-8")
    for path in [PROJECT / "README.md", *sorted((PROJECT / "docs").glob("*.md"))]
}
_FOLDED = {*range(0x1800, 0x1C00), 0x2002}
_TYPES = {2: "i8", 3: "i16", 4: "i32", 5: "u8", 6: "u16", 7: "u32", 9: "text", 15: "domain"}
_FOUND_BY_GATEWAY = {
    GatewayError.TELEMETRY_LOST: "telemetry lost",
    GatewayError.CRC_RATE: "telemetry degraded: many CRC errors or dropped bytes",
    GatewayError.PORT_GONE: "serial port gone",
    GatewayError.OTHER_DEVICE: "another device than `[esc].device` says",
    GatewayError.RECEIVE_OVERRUN: "received CAN frames were lost",
    GatewayError.CAN_PASSIVE: "CAN controller error passive",
    GatewayError.HEARTBEAT_LOST: "a watched heartbeat stayed away; byte 4: the node-ID",
    GatewayError.BUS_OFF_LEFT: "back from bus-off",
    GatewayError.ID_COLLISION: "somebody else sends with an id of this node: two nodes with one node-ID?",
    GatewayError.SYNC_LENGTH: "SYNC of a wrong length",
    GatewayError.PARAMETER_FILE: "the parameter file could not be read: defaults",
}
_WHEN = {
    Group.LIVE: "with fresh live data",
    Group.INFO: "with info of the present device",
    Group.LINK: "always",
    Group.GATEWAY: "always",
}


def configuration() -> str:
    lines = ["| key | range | default | meaning |", "|---|---|---|---|"]
    for name, table in KEYS.items():
        head = "[esc]" if name == "esc" else name
        for f in fields(table):
            default = (
                "**required**" if f.default is MISSING and f.default_factory is MISSING else ""
            )
            if f.default is not MISSING and f.default not in (None, ""):
                value = float(f.default) if isinstance(f.default, Fraction) else f.default
                default = str(value).lower() if isinstance(value, bool) else str(value)
            lines.append(
                f"| `{head}.{f.name}` | {f.metadata['kind'].span} | {default} | {f.metadata['doc']} |"
            )
    return "\n".join(lines)


def messages() -> str:
    database = cantools.database.load_file(shipped("dbc/kontronik_esc.dbc"))
    assert isinstance(database, cantools.database.Database)
    lines = []
    for message in database.messages:
        attributes = message.dbc.attributes if message.dbc else {}
        delay = attributes.get("GenMsgDelayTime")
        timing = re.sub(r"(?<!^)(?=[A-Z])", " ", str(message.send_type)).lower()
        timing += f", every {message.cycle_time} ms" if message.cycle_time else ""
        timing += f", at least {delay.value} ms apart" if delay is not None and delay.value else ""
        flags = [s for s in message.signals if s.length == 1]
        lines += [f"**{message.name}** {message.frame_id:03X}h: {timing}. {message.comment}", ""]
        lines += ["| signal | bits | unit | range | meaning |", "|---|---|---|---|---|"]
        for s in message.signals:
            if s in flags:
                continue
            span = (
                f"{s.minimum:.10g} … {s.maximum:.10g}"
                if s.minimum is not None and s.maximum is not None
                else ""
            )
            kind = "i" if s.is_signed else "u"
            place = f"{s.start}+{s.length} {kind}"
            step = f" × {s.scale:.10g}" if s.scale != 1 else ""
            lines.append(f"| {s.name} | {place}{step} | {s.unit or ''} | {span} | {s.comment} |")
        if flags:
            names = ", ".join(f"{s.start} {s.name}" for s in flags)
            lines.append(
                f"| flags | {flags[0].start}…{flags[-1].start} | | 0, 1 | bit and name: {names} |"
            )
        lines.append("")
    return "\n".join(lines).rstrip()


def source_table() -> str:
    lines = ["| source | unit | available |", "|---|---|---|"]
    flags: dict[Group, list[str]] = {}
    for source in VALUES.values():
        if source.bit is not None:
            flags.setdefault(source.group, []).append(f"`{source.name}`")
            continue
        when = _WHEN[source.group] + (", if supplied" if source.optional else "")
        note = "; counter" if source.rolls else "; names" if source.names else ""
        lines.append(f"| `{source.name}` | {source.unit} | {when}{note} |")
    for group, names in flags.items():
        lines.append(f"| {', '.join(names)} | flag | {_WHEN[group]} |")
    return "\n".join(lines)


def emergencies() -> str:
    lines = ["| code | byte 3 | meaning |", "|---|---|---|"]
    for bit in OperatingError:
        if bit is not OperatingError.PROGRAMMING_ALLOWED:
            lines.append(
                f"| {BitCodes(tuple(OperatingError)).code(bit):04X}h | {int(bit)} | {bit.meaning} |"
            )
    for error in GatewayError:
        code, which = error.value
        lines.append(
            f"| {code:04X}h | FFh{f', byte 4 = {which}' if which else ''} | {_FOUND_BY_GATEWAY[error]} |"
        )
    lines.append("| 0000h | FFh | no error any more |")
    return "\n".join(lines)


def objects() -> str:
    eds = load(shipped("eds/kontronik_esc.eds").read_bytes(), "kontronik_esc.eds")
    live = BINDINGS
    lines = [
        "| object | name | type | access | default | limits | PDO |",
        "|---|---|---|---|---|---|---|",
    ]
    for entry in eds.entries:
        index, sub = entry.index, entry.sub
        several = entry.object_type in (ARRAY, RECORD)
        if several and sub == 0:
            name = f"{eds.object_names[index]}{_pdo(eds, index)}"
            lines.append(f"| **{index:04X}h** | **{name}** | | | | | |")
        if index in _FOLDED or (several and sub == 0):
            continue
        where = f"{index:04X}h:{sub:02X}" if several else f"**{index:04X}h**"
        name = entry.name if several else f"**{entry.name}**"
        limits = (
            ""
            if entry.low is entry.high is None
            else f"{_number(entry.low)} … {_number(entry.high)}"
        )
        default = (
            f"$NODEID + {_number(entry.default)}" if entry.relative else _number(entry.default)
        )
        if (entry.index, entry.sub) in live:  # a formal 0
            default = ""
        mappable = "yes" if entry.mappable else ""
        lines.append(
            f"| {where} | {name} | {_TYPES[entry.data_type]} | {entry.access} | {default} | {limits} | {mappable} |"
        )
    return "\n".join(lines)


def _pdo(eds: Eds, index: int) -> str:
    """The default of a PDO, shown after the name of its parameters."""
    entries = {(e.index, e.sub): e for e in eds.entries}
    value = {at: entry.default for at, entry in entries.items() if isinstance(entry.default, int)}
    if index in range(0x1800, 0x1A00):
        cob_id, kind, inhibit, timer = (value[index, sub] for sub in (1, 2, 3, 5))
        if cob_id >> 31:
            return ": spare"
        return f": $NODEID + {cob_id & 0x7FF:X}h, type {kind}, inhibit time {inhibit / 10:g} ms, event timer {timer} ms"
    if index in range(0x1A00, 0x1C00):
        mapped = (value[index, sub] for sub in range(1, value[index, 0] + 1))
        return ": " + (", ".join(entries[m >> 16, m >> 8 & 0xFF].name for m in mapped) or "nothing")
    return ""


def _number(value: float | bytes | None) -> str:
    if value is None:
        return ""
    if isinstance(value, bytes):
        return value.decode("ascii")
    return f"{value:X}h" if isinstance(value, int) and value > 0xFFFF else str(value)


TABLES = {
    "configuration": configuration,
    "messages": messages,
    "sources": source_table,
    "emergencies": emergencies,
    "objects": objects,
}


def with_tables(text: str) -> str:
    """A page with each table in it made anew."""
    for name, make in TABLES.items():
        pattern = re.compile(rf"(<!-- made: {name} -->\n).*?(<!-- end: {name} -->)", re.DOTALL)
        text = pattern.sub(lambda found, make=make: f"{found[1]}{make()}\n{found[2]}", text)  # type: ignore[misc]
    return text


if __name__ == "__main__":
    for path, text in PAGES.items():
        path.write_text(with_tables(text), encoding="utf-8")
