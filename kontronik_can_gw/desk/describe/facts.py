"""Collects everything about what a gateway sends as plain data: the content of ``describe --format json``.

Nothing is defined here: messages and signals are from the DBC in use, objects from the EDS in use, their sources from the compiled layout
and the bindings, errors and states from their definitions. Ids, indices and bit numbers are integers; times in ms.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from kontronik_can_gw import __version__
from kontronik_can_gw.canopen.dbc_names import pascal_case
from kontronik_can_gw.canopen.eds import Eds
from kontronik_can_gw.canopen.emergency_codes import GatewayError
from kontronik_can_gw.canopen.nodes import CanopenSetup
from kontronik_can_gw.canopen.objects import BINDINGS
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.describe.bus_facts import bus_facts
from kontronik_can_gw.desk.describe.canopen_facts import canopen_facts
from kontronik_can_gw.desk.describe.line_states import CAN_STATES, GATEWAY_STATES, LINK_STATES, Text
from kontronik_can_gw.desk.describe.parts import Facts, error, one_line, value_table
from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc
from kontronik_can_gw.esc.decoder import EscProtocol, State
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.values import VALUES, Group

FORMAT = "kontronik-can-gw description"
VERSION = 1
"""Version of the document: grows when something is renamed or removed, not when something is added."""
_AVAILABLE = {
    Group.LIVE: "with fresh live data",
    Group.INFO: "with info of the present device",
    Group.LINK: "always",
    Group.GATEWAY: "always",
}
_STATES: Mapping[str, Mapping[Any, Text]] = {
    "link_states": LINK_STATES,
    "can_states": CAN_STATES,
    "gateway_states": GATEWAY_STATES,
}


def describe(
    bus: BusLayout | None, canopen: CanopenSetup | None, escs: Sequence[EscSettings]
) -> Facts:
    """Describe a gateway with this DBC, these CANopen nodes and these ESCs. None: without that output."""
    names = [esc.name for esc in escs]
    dbc = None if bus is None else bus_facts(bus, names)
    protocols = list(dict.fromkeys(protocol_named(esc.protocol) for esc in escs))
    meanings = _meanings(protocols)
    return {
        "format": FORMAT,
        "version": VERSION,
        "program": f"kontronik-can-gw {__version__}",
        "escs": names,
        "dbc": dbc,
        "canopen": None if canopen is None else canopen_facts(canopen, escs, meanings),
        "sources": _sources(dbc, None if canopen is None else canopen.eds, meanings),
        **{
            word: [
                {"bit": int(bit), **error(bit)}
                for protocol in protocols
                for bit in protocol.errors.get(word, ())
            ]
            for word in ("operating_errors", "selftest_errors")
        },
        "operating_states": [
            _state(number, state.text, state)
            for protocol in protocols
            for number, state in protocol.states.items()
        ],
        "devices": [
            _device(protocol, number) for protocol in protocols for number in protocol.devices
        ],
        **{
            key: [_state(state, pascal_case(state.name), text) for state, text in texts.items()]
            for key, texts in _STATES.items()
        },
        "gateway_faults": [_fault(fault) for fault in GatewayError],
    }


# --- sources


def _meanings(protocols: Sequence[EscProtocol]) -> dict[str, str]:
    """Meaning of each source: of a flag that of the bit, else the comment of the shipped signal bound to it."""
    shown = layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))
    comments = {
        (m.name, s.name): one_line(s.comment) for m in shown.database.messages for s in m.signals
    }
    found = {
        plan.source.name: comments[message.name, plan.name]
        for message in shown.layout.messages
        for plan in message.signals
        if plan.source is not None
    }
    return found | {
        bit.text: bit.meaning
        for protocol in protocols
        for bits in protocol.errors.values()
        for bit in bits
    }


def _sources(dbc: Facts | None, eds: Eds | None, meanings: Mapping[str, str]) -> list[Facts]:
    """The values that signals and objects can carry, with the signals and objects that do."""
    signals: dict[str, list[str]] = {}
    for message in dbc["messages"] if dbc else ():
        for signal in message["signals"]:
            shown = signals.setdefault(signal["source"], [])
            shown.append(f"{message['name']}.{signal['name']}")
    objects: dict[str, list[str]] = {}
    names: dict[str, str] = {}
    for entry in eds.entries if eds else ():
        if bound := BINDINGS.get((entry.index, entry.sub)):
            name = bound.source.name
            objects.setdefault(name, []).append(f"{entry.index:04X}h:{entry.sub:02X}")
            names.setdefault(name, entry.name)
    sources = [binding.source for binding in BINDINGS.values()]
    others = {source.name: source for source in sources if source.name not in VALUES}
    return [
        {
            "name": name,
            "unit": source.unit,
            "available": _AVAILABLE[source.group] + (", where supplied" if source.optional else ""),
            "meaning": meanings.get(name) or names.get(name, name.replace("_", " ").capitalize()),
            "counter": source.rolls,
            "bindable": name in VALUES,
            "values": value_table({int(value): text for value, text in source.names.items()}),
            "signals": signals.get(name, []),
            "objects": objects.get(name, []),
        }
        for name, source in {**VALUES, **others}.items()
    ]


# --- states, devices, faults


def _state(state: int, name: str, text: Text | State) -> Facts:
    return {"value": int(state), "name": name, "meaning": text.meaning, "remedy": text.remedy}


def _device(protocol: EscProtocol, device: int) -> Facts:
    """A kind of ESC; ``peak_current``: what it is the peak of, None where that is not known."""
    fields = [field for field in protocol.fields if not field.is_info]
    return {
        "value": device,
        "name": protocol.devices[device],
        "peak_current": protocol.peak_current_of.get(device),
        "not_supplied": [field.name for field in fields if device in field.not_on],
    }


def _fault(fault: GatewayError) -> Facts:
    """A fault that the gateway detects, and the emergency that reports it on a CANopen node."""
    return {
        "name": fault.name.lower(),
        "meaning": fault.meaning,
        "remedy": fault.remedy,
        "emergency_code": fault.value[0],
    }
