"""The tables of README.md and docs/, made from their sources of truth. ``python tests/readme/readme_tables.py`` writes them there."""

import re
from dataclasses import MISSING, fields
from fractions import Fraction
from pathlib import Path

from kontronik_can_gw.config.keys import TABLES as KEYS
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.config.nodes import shipped_canopen
from kontronik_can_gw.desk.describe.facts import describe
from kontronik_can_gw.desk.describe.parts import Facts
from kontronik_can_gw.desk.recordings.layouts import layout_of_dbc
from kontronik_can_gw.esc.values import VALUES

PROJECT = Path(__file__).resolve().parents[2]
PAGES = {
    path: path.read_text(encoding="utf-8")
    for path in [PROJECT / "README.md", *sorted((PROJECT / "docs").glob("*.md"))]
}
_BUS = layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))
FACTS = describe(_BUS, shipped_canopen([1]), _BUS.escs)
_FOLDED = {*range(0x1800, 0x1C00), 0x2002}
_TYPES = {"VISIBLE_STRING": "text", "DOMAIN": "domain"}


def _table(head: str, *rows: str) -> str:
    columns = head.count("|") + 1
    return "\n".join([f"| {head} |", "|" + "---|" * columns, *(f"| {row} |" for row in rows)])


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
    parts = []
    for message in FACTS["dbc"]["messages"]:
        timing = " and ".join(message["send_type"])
        timing += f", every {message['cycle_ms']} ms" if message["cycle_ms"] else ""
        timing += f", at least {message['delay_ms']} ms apart" if message["delay_ms"] else ""
        parts.append(f"**{message['name']}** {message['id']:03X}h: {timing}. {message['comment']}")
        flags = [s for s in message["signals"] if s["length"] == 1]
        rows = [_signal(s) for s in message["signals"] if s not in flags]
        if flags:
            names = ", ".join(f"{s['start_bit']} {s['name']}" for s in flags)
            bits = f"{flags[0]['start_bit']}…{flags[-1]['start_bit']}"
            rows.append(f"flags | {bits} | | 0, 1 | bit and name: {names}")
        parts.append(_table("signal | bits | unit | range | meaning", *rows))
    return "\n\n".join(parts)


def _signal(signal: Facts) -> str:
    place = f"{signal['start_bit']}+{signal['length']} {'i' if signal['signed'] else 'u'}"
    step = f" × {signal['factor']:.10g}" if signal["factor"] != 1 else ""
    span = f"{signal['minimum']:.10g} … {signal['maximum']:.10g}"
    return f"{signal['name']} | {place}{step} | {signal['unit']} | {span} | {signal['comment']}"


def source_table() -> str:
    rows: list[str] = []
    flags: dict[str, list[str]] = {}
    for source in (source for source in FACTS["sources"] if source["bindable"]):
        name = f"`{source['name']}`"
        if VALUES[source["name"]].bit is not None:
            flags.setdefault(source["available"], []).append(name)
            continue
        note = "; counter" if source["counter"] else "; names" if source["values"] else ""
        rows.append(f"{name} | {source['unit']} | {source['available']}{note}")
    rows += [f"{', '.join(names)} | flag | {when}" for when, names in flags.items()]
    return _table("source | unit | available", *rows)


def emergencies() -> str:
    rows = []
    for found in FACTS["canopen"]["emergencies"]:
        byte4 = f", byte 4 = {found['byte4']}" if found["byte4"] else ""
        byte3 = "FFh" if found["byte3"] == 0xFF else found["byte3"]
        rows.append(f"{found['code']:04X}h | {byte3}{byte4} | {found['meaning']}")
    return _table("code | byte 3 | meaning", *rows)


def objects() -> str:
    rows = []
    for item in FACTS["canopen"]["objects"]:
        index, several = item["index"], item["kind"] in ("ARRAY", "RECORD")
        if several:
            rows.append(f"**{index:04X}h** | **{item['name']}{_pdo(index)}** | | | | |")
        for entry in item["entries"]:
            if index in _FOLDED or (several and entry["sub"] == 0):
                continue
            where = f"{index:04X}h:{entry['sub']:02X}" if several else f"**{index:04X}h**"
            name = entry["name"] if several else f"**{entry['name']}**"
            default = _number(entry["default"])
            default = f"$NODEID + {default}" if entry["plus_node_id"] else default
            low, high = _number(entry["low"]), _number(entry["high"])
            cells = [where, name, _type(entry["type"]), entry["access"]]
            cells += ["" if entry["source"] else default, f"{low} … {high}" if low + high else ""]
            rows.append(" | ".join([*cells, "yes" if entry["mappable"] else ""]))
    return _table("object | name | type | access | default | limits | PDO", *rows)


def _type(name: str) -> str:
    short = name.replace("UNSIGNED", "u").replace("INTEGER", "i")
    return _TYPES.get(name, short)


def _pdo(index: int) -> str:
    """The default of a PDO, shown after the name of its parameters."""
    pdos = {pdo["number"]: pdo for pdo in FACTS["canopen"]["nodes"][0]["pdos"]}
    pdo = pdos.get((index & 0x1FF) + 1)
    if index in range(0x1800, 0x1A00):
        if pdo is None:
            return ": spare"
        kind, inhibit, timer = (
            pdo[name] for name in ("transmission_type", "inhibit_ms", "event_ms")
        )
        return f": $NODEID + {pdo['cob_id'] - 1:X}h, type {kind}, inhibit time {inhibit:g} ms, event timer {timer} ms"
    if index in range(0x1A00, 0x1C00):
        mapped = [] if pdo is None else [name.partition(" ")[2] for name in pdo["mapped"]]
        return ": " + (", ".join(mapped) or "nothing")
    return ""


def _number(value: float | str | None) -> str:
    if value is None:
        return ""
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
