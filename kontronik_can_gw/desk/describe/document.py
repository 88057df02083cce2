"""Makes sections with lines and tables of the facts, which ``markdown`` renders. Pure."""

from collections.abc import Callable, Iterable, Iterator, Mapping

from kontronik_can_gw.desk.describe.canopen_facts import BY_GATEWAY
from kontronik_can_gw.desk.describe.markdown import Code, Section, Table, markdown
from kontronik_can_gw.desk.describe.parts import Facts

Columns = Mapping[str, str | Callable[[Facts], str]]
"""The columns of a table by their heads: each shows what has this key, or what a function makes of the fact."""

_SOURCES = (
    "What a signal of a DBC of your own can be bound to, by its name or under [dbc.bind]. Those without a signal name in this table are "
    "not sent by the DBC in use."
)


def document(facts: Facts) -> str:
    """The description as Markdown."""
    return markdown(
        "What the gateway sends and what it means", list(_lead(facts)), list(_sections(facts))
    )


def _lead(facts: Facts) -> Iterator[str]:
    dbc, canopen = facts["dbc"], facts["canopen"]
    yield f"Made by {facts['program']} from the files in use, by: kontronik-can-gw describe."
    yield f"ESCs: {', '.join(facts['escs'])}."
    sent = f"{dbc['file']}, messages of {dbc['node']}" if dbc else "none, dbc.enabled is false"
    yield f"DBC: {sent}."
    yield f"EDS: {canopen['file']}." if canopen else "CANopen: none, canopen.enabled is false."


def _sections(facts: Facts) -> Iterator[Section]:
    if facts["dbc"]:
        yield from _messages(facts["dbc"], several=len(facts["escs"]) > 1)
    for title, key, text, columns in _REFERENCE:
        yield Section(title, 2, [text, _table(facts[key], columns)])
    if facts["canopen"]:
        yield from _canopen(facts["canopen"])
    yield Section("Sources", 2, [_SOURCES, _sources(facts["sources"])])


def _table(facts: Iterable[Facts], columns: Columns) -> Table:
    """A row for each of the facts."""
    rows = [
        tuple(
            str(fact[column]) if isinstance(column, str) else column(fact)
            for column in columns.values()
        )
        for fact in facts
    ]
    return Table(tuple(columns), rows)


def _name(fact: Facts) -> Code:
    return Code(fact["name"])


# --- messages


def _messages(dbc: Facts, several: bool) -> Iterator[Section]:
    columns: Columns = {
        "message": _name,
        "id": _id,
        "bytes": "length",
        "sent": _timing,
        "meaning": "comment",
    }
    yield Section("Messages", 2, [dbc["comment"], _table(dbc["messages"], columns)])
    for message in dbc["messages"]:
        fd = ", CAN FD" if message["fd"] else ""
        text = f"{_id(message)}, {message['length']} bytes{fd}. Sent {_timing(message)}."
        table = _signals(message["signals"], several)
        yield Section(f"{message['name']} {_id(message)}", 3, [text, message["comment"], table])


def _id(message: Facts) -> str:
    return f"{message['id']:08X}h" if message["extended"] else f"{message['id']:03X}h"


def _timing(message: Facts) -> str:
    words = {
        "event": "with each new value",
        "on change": "on change",
        "cyclic": f"every {_number(message['cycle_ms'])} ms",
    }
    text = " and ".join(words[kind] for kind in message["send_type"]) or "never"
    if message["delay_ms"]:
        text += f", at least {_number(message['delay_ms'])} ms apart"
    return text


def _signals(signals: Iterable[Facts], several: bool) -> Table:
    columns: Columns = {
        "signal": _name,
        "bits": _bits,
        "unit": "unit",
        "resolution": _resolution,
        "range": _range,
        "not available, error": _codes,
        "shows": lambda signal: _shown(signal, several),
        "meaning": _meaning,
    }
    return _table(signals, columns)


def _is_flag(signal: Facts) -> bool:
    return signal["length"] == 1 and not signal["signed"]


def _is_plain_flag(signal: Facts) -> bool:
    steps = signal["factor"], signal["minimum"], signal["maximum"]
    return _is_flag(signal) and steps == (1, 0, 1)


def _bits(signal: Facts) -> str:
    kind = "float" if signal["is_float"] else "signed" if signal["signed"] else "unsigned"
    order = "" if signal["byte_order"] == "little_endian" else ", big-endian"
    bits = f"{signal['start_bit']}+{signal['length']} {kind}{order}"
    if _is_flag(signal):
        bits = str(signal["start_bit"])
    return bits if signal["page"] is None else f"{bits}, page {signal['page']}"


def _resolution(signal: Facts) -> str:
    if _is_plain_flag(signal):
        return ""
    offset = f", offset {_number(signal['offset'])}" if signal["offset"] else ""
    return _number(signal["factor"]) + offset


def _range(signal: Facts) -> str:
    if _is_plain_flag(signal):
        return "0, 1"
    return f"{_number(signal['minimum'])} … {_number(signal['maximum'])}"


def _codes(signal: Facts) -> str:
    mask = (1 << signal["length"]) - 1
    codes = [code for code in (signal["not_available"], signal["error"]) if code is not None]
    return ", ".join(f"{code} ({code & mask:X}h)" for code in codes)


def _shown(signal: Facts, several: bool) -> str:
    if signal["source"] is None:
        return str(signal["role"])
    if signal["esc"] is not None and several:
        return Code(f"{signal['esc']}.{signal['source']}")
    return Code(signal["source"])


def _meaning(signal: Facts) -> str:
    codes = (signal["not_available"], signal["error"])
    values = [each for each in signal["values"] if each["value"] not in codes]
    named = ", ".join(f"{each['value']} {each['name']}" for each in values)
    texts = [signal["comment"], f"Values: {named}." if named else ""]
    texts += [f"{note}." for note in signal["notes"]]
    return " ".join(filter(None, texts))


# --- errors and states


def _peak_current(device: Facts) -> str:
    return "unknown" if device["peak_current"] is None else f"of the {device['peak_current']}"


_ABOUT: Columns = {"meaning": "meaning", "what to do": "remedy"}
_ERROR: Columns = {"bit": "bit", "name": _name, "class": "severity", **_ABOUT}
_STATE: Columns = {"number": "value", "state": _name, **_ABOUT}
_DEVICE: Columns = {
    "number": "value",
    "device": _name,
    "peak current": _peak_current,
    "does not supply": lambda device: ", ".join(device["not_supplied"]) or "nothing",
}
# fmt: off
_REFERENCE: tuple[tuple[str, str, str, Columns], ...] = (
    ("Operating errors", "operating_errors", "Bits of the error word that the ESC sends with each live frame.", _ERROR),
    ("Self-test errors", "selftest_errors",
     "Bits that the ESC sends about once a second, in its info frame. All of them mean that the self-test failed.", _ERROR),
    ("Operating states", "operating_states",
     "What the ESC is doing. Other numbers have no name; newer firmware may send them.", _STATE),
    ("Devices", "devices", "", _DEVICE),
    ("Link states", "link_states", "The telemetry line between an ESC and the gateway.", _STATE),
    ("CAN states", "can_states", "The gateway's CAN controller.", _STATE),
    ("Gateway states", "gateway_states", "", _STATE),
    ("Faults that the gateway finds", "gateway_faults",
     "Reported as emergencies on CANopen nodes, in the log and by kontronik-can-gw status.", {"fault": _name, **_ABOUT}),
)
# fmt: on
"""Title, key of the facts, text, columns."""


# --- CANopen


def _canopen(facts: Facts) -> Iterator[Section]:
    yield Section("CANopen nodes", 2, ["One node for each ESC, all with the objects below."])
    for node in facts["nodes"]:
        yield _node(node)
    text = "Emergency messages: bytes 0 and 1 are the code, byte 2 is 1001h, byte 3 the bit of the ESC's error word, or FFh."
    columns: Columns = {
        "code": lambda emergency: f"{emergency['code']:04X}h",
        "byte 3": lambda e: "FFh" if e["byte3"] == BY_GATEWAY else str(e["byte3"]),
        "byte 4": lambda emergency: str(emergency["byte4"] or ""),
        "name": _name,
        "class": "severity",
        **_ABOUT,
    }
    yield Section("Emergencies", 2, [text, _table(facts["emergencies"], columns)])
    writes = "Nothing can be written over the bus: canopen.read_only is true."
    notes = [*facts["notes"], writes if facts["read_only"] else ""]
    yield Section("CANopen objects", 2, notes)
    for item in facts["objects"]:
        blocks = [*item["notes"], _table(item["entries"], _ENTRY)]
        yield Section(f"{item['index']:04X}h {item['name']}", 3, blocks)


def _node(node: Facts) -> Section:
    cob_ids: Columns = {"COB-ID": lambda cob: f"{cob['id']:03X}h", "used for": "use"}
    table = _table(node["cob_ids"], cob_ids)
    if node["node_id"] is None:
        waits = "It waits for a node-ID by LSS, so it has no COB-IDs yet."
        return Section(f"Node of {node['esc']}", 3, [waits, table])
    pdos: Columns = {
        "TPDO": "number",
        "COB-ID": lambda pdo: f"{pdo['cob_id']:03X}h",
        "type": "transmission_type",
        "inhibit time ms": lambda pdo: _number(pdo["inhibit_ms"]),
        "event timer ms": lambda pdo: _number(pdo["event_ms"]),
        "mapped": lambda pdo: ", ".join(pdo["mapped"]),
    }
    tables = [table, _table(node["pdos"], pdos)] if node["pdos"] else [table]
    return Section(f"Node {node['node_id']} ({node['esc']})", 3, tables)


def _default(entry: Facts) -> str:
    default = entry["default"]
    if default is None or entry["source"] is not None:  # a live value has no default of its own
        default = ""
    elif isinstance(default, int) and default > 0xFFFF:
        default = f"{default:X}h"
    return f"$NODEID + {default}" if entry["plus_node_id"] else str(default)


def _limits(entry: Facts) -> str:
    if entry["low"] is None and entry["high"] is None:
        return ""
    return f"{_number(entry['low'])} … {_number(entry['high'])}"


def _steps(entry: Facts) -> str:
    step = "" if entry["resolution"] == 1 else _number(entry["resolution"])
    return f"{step} {entry['unit']}".strip()


_ENTRY: Columns = {
    "sub": lambda entry: f"{entry['sub']:02X}",
    "name": "name",
    "type": "type",
    "access": "access",
    "PDO": lambda entry: "yes" if entry["mappable"] else "",
    "default": _default,
    "limits": _limits,
    "unit": _steps,
    "shows": lambda entry: Code(entry["source"] or ""),
    "meaning": "meaning",
}


# --- sources


def _sources(sources: Iterable[Facts]) -> Table:
    columns: Columns = {
        "source": _name,
        "unit": "unit",
        "available": "available",
        "meaning": lambda s: f"{s['meaning']} Counter." if s["counter"] else s["meaning"],
        "signals": lambda source: ", ".join(source["signals"]),
        "objects": lambda source: ", ".join(source["objects"]),
    }
    return _table((source for source in sources if source["bindable"]), columns)


def _number(value: float | None) -> str:
    """A number in the usual notation; empty for None."""
    if value is None:
        return ""
    return str(value) if isinstance(value, int) else f"{value:.10g}"
