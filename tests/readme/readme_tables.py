"""The README's tables, made from their sources of truth. ``python tests/readme/readme_tables.py`` writes them into README.md."""

import re
from dataclasses import MISSING, fields
from fractions import Fraction
from pathlib import Path

import cantools.database

from kontronik_can_gw.config import CanConfig, DbcConfig, EscConfig, RunConfig, shipped
from kontronik_can_gw.sources import Group, sources
from kontronik_can_gw.telemetry import EscSettings

README = Path(__file__).resolve().parents[2] / "README.md"
_WHEN = {
    Group.LIVE: "with fresh live data",
    Group.INFO: "with info of the present device",
    Group.LINK: "always",
    Group.GATEWAY: "always",
}


def configuration() -> str:
    lines = ["| key | range | default | meaning |", "|---|---|---|---|"]
    for head, table in (("can", CanConfig), ("dbc", DbcConfig), ("run", RunConfig), ("[esc]", EscConfig)):
        for f in fields(table):
            limits = f.metadata
            span = f"{limits['low']} … {limits['high']}" if "low" in limits else limits["kind"]
            if "choices" in limits:
                span = ", ".join(f'"{choice}"' for choice in limits["choices"])
            default = "**required**" if f.default is MISSING and f.default_factory is MISSING else ""
            if f.default is not MISSING and f.default not in (None, ""):
                value = float(f.default) if isinstance(f.default, Fraction) else f.default
                default = str(value).lower() if isinstance(value, bool) else str(value)
            lines.append(f"| `{head}.{f.name}` | {span} | {default} | {limits['doc']} |")
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
            span = f"{s.minimum:.10g} … {s.maximum:.10g}" if s.minimum is not None and s.maximum is not None else ""
            kind = "i" if s.is_signed else "u"
            place = f"{s.start}+{s.length} {kind}"
            step = f" × {s.scale:.10g}" if s.scale != 1 else ""
            lines.append(f"| {s.name} | {place}{step} | {s.unit or ''} | {span} | {s.comment} |")
        if flags:
            names = ", ".join(f"{s.start} {s.name}" for s in flags)
            lines.append(f"| flags | {flags[0].start}…{flags[-1].start} | | 0, 1 | bit and name: {names} |")
        lines.append("")
    return "\n".join(lines).rstrip()


def source_table() -> str:
    lines = ["| source | unit | available |", "|---|---|---|"]
    flags: dict[Group, list[str]] = {}
    for source in sources(EscSettings()).values():
        if source.bit is not None:
            flags.setdefault(source.group, []).append(f"`{source.name}`")
            continue
        when = _WHEN[source.group] + (", if supplied" if source.supplied else "")
        note = "; counter" if source.rolls else "; names" if source.names else ""
        lines.append(f"| `{source.name}` | {source.unit} | {when}{note} |")
    for group, names in flags.items():
        lines.append(f"| {', '.join(names)} | flag | {_WHEN[group]} |")
    return "\n".join(lines)


TABLES = {"configuration": configuration, "messages": messages, "sources": source_table}


def with_tables(text: str) -> str:
    """The README's text with every table made anew."""
    for name, make in TABLES.items():
        pattern = re.compile(rf"(<!-- made: {name} -->\n).*?(<!-- end: {name} -->)", re.DOTALL)
        assert pattern.search(text), f"README.md has no place for the table {name}"
        text = pattern.sub(lambda found, make=make: f"{found[1]}{make()}\n{found[2]}", text)  # type: ignore[misc]
    return text


if __name__ == "__main__":
    README.write_text(with_tables(README.read_text(encoding="utf-8")), encoding="utf-8")
