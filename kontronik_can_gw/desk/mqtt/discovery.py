"""Home Assistant's discovery: which entity shows which value, with unit, device class and availability. Pure."""

import json
from collections.abc import Sequence
from typing import Any

from kontronik_can_gw import __version__
from kontronik_can_gw.desk.mqtt.topics import Topics
from kontronik_can_gw.desk.mqtt.values import Published
from kontronik_can_gw.esc.values import VALUES, Group
from kontronik_can_gw.signals.unpacker import Column

PROGRAM = "kontronik-can-gw"
_MEASURED: dict[str, tuple[str, str | None]] = {
    "V": ("V", "voltage"),
    "A": ("A", "current"),
    "W": ("W", "power"),
    "degC": ("°C", "temperature"),
    "Hz": ("Hz", "frequency"),
    "ms": ("ms", "duration"),
    "1/min": ("rpm", None),
    "%": ("%", None),
    "us": ("µs", None),
}
"""Our unit: Home Assistant's unit and device class. Speed and charge have no class, and % here is neither humidity nor battery."""
_TOTALS: dict[str, tuple[str, str | None]] = {
    "Wh": ("Wh", "energy"),
    "mAh": ("mAh", None),
    "s": ("s", "duration"),
}
"""Values that only grow until the ESC or the gateway restarts."""
_DIAGNOSTIC = {Group.LINK, Group.INFO, Group.GATEWAY}
_OF_USE = {"energy_used", "motor_run_time", "link_state"}
_UPPER = {"bec", "pwm", "crc", "can", "id", "esc", "eeprom"}
_LEFT_OUT = {"operating_state_raw", "device_raw", "operating_errors", "selftest_errors"}
_LEFT_OUT |= {"firmware_main", "firmware_sub"}
"""Sources without an entity, because another one shows the same."""
_MOTOR: dict[str, Any] = {
    "platform": "sensor",
    "name": "Motor",
    "device_class": "enum",
    "options": ["idle", "start", "run", "brake", "fault"],
    "value_template": "{{ value_json.motor }}",
}
_NAMES = (
    "{{% if value_json.{0} is none %}}None{{% else %}}"
    "{{{{ (value_json.{0} | map(attribute='name') | join(', ') or 'none')[:255] }}}}{{% endif %}}"
)
_ERROR_ENTITIES: dict[str, dict[str, Any]] = {
    "problem": {
        "platform": "binary_sensor",
        "name": "Problem",
        "device_class": "problem",
        "value_template": "{% if value_json.problem is none %}None{% elif value_json.problem %}ON{% else %}OFF{% endif %}",
    },
    "errors": {"platform": "sensor", "name": "Errors", "value_template": _NAMES.format("errors")},
    "selftest": {
        "platform": "sensor",
        "name": "Self-test",
        "entity_category": "diagnostic",
        "value_template": _NAMES.format("selftest"),
    },
}


def device(topics: Topics, member: Published, columns: Sequence[Column]) -> dict[str, Any]:
    """The discovery of the gateway or of an ESC: one device with all its entities."""
    identifier = topics.identifier(member.name)
    online = {"topic": topics.online}
    components: dict[str, dict[str, Any]] = {}
    for source, at in member.no_flags.items():
        if (component := entity(source, columns[at])) is not None:
            components[source] = component
    if member.index is not None and member.has(*member.protocol.bits, *member.protocol.errors):
        components |= _ERROR_ENTITIES
    if member.has("operating_state", "operating_state_raw"):
        components["motor"] = _MOTOR
    for key, component in components.items():
        components[key] = {**component, "unique_id": f"{identifier}_{key}"}
        if key in VALUES and VALUES[key].group is Group.LINK:
            # values of the link are valid, and most useful, while the ESC sends nothing
            components[key] |= {
                "availability": [online, {"topic": topics.available()}],
                "availability_mode": "all",
            }
    return {
        "device": {"identifiers": [identifier], **_about(topics, member)},
        "origin": {"name": PROGRAM, "sw_version": __version__},
        "availability": [online, {"topic": topics.available(member.name)}],
        "availability_mode": "all",
        "state_topic": topics.state(member.name),
        "components": components,
    }


def _about(topics: Topics, member: Published) -> dict[str, Any]:
    if member.index is None:
        return {"name": f"KONTRONIK gateway {topics.gateway}", "model": PROGRAM}
    name, (model, firmware) = f"{topics.gateway} {member.name}", member.identity
    about = {"name": name, "manufacturer": member.protocol.maker, "model": model or "ESC"}
    about["via_device"] = topics.identifier()
    return about if firmware is None else about | {"sw_version": firmware}


def entity(source: str, column: Column) -> dict[str, Any] | None:
    """Home Assistant's entity of a value; None where another one shows the same."""
    if source in _LEFT_OUT:
        return None
    about = VALUES[source]
    made: dict[str, Any] = {
        "platform": "sensor",
        "name": _in_words(source),
        "value_template": f"{{{{ value_json.{source} }}}}",
    }
    if about.group in _DIAGNOSTIC and source not in _OF_USE:
        made["entity_category"] = "diagnostic"
    if column.texts:
        options = list(dict.fromkeys(text for _, text in column.texts))
        return made | {"device_class": "enum", "options": options}
    if about.names:  # sent as a plain number
        return made
    own = column.unit or about.unit
    unit, kind = _TOTALS.get(own) or _MEASURED.get(own) or (own, None)
    grows = own in _TOTALS or (own not in _MEASURED and about.rolls)
    if unit:
        made["unit_of_measurement"] = unit
    made["state_class"] = "total_increasing" if grows else "measurement"
    if kind is not None:
        made["device_class"] = kind
    if column.digits is not None:
        made["suggested_display_precision"] = column.digits
    return made


def _in_words(source: str) -> str:
    words = [word.upper() if word in _UPPER else word for word in source.split("_")]
    text = " ".join("ESCs" if word == "escs" else word for word in words)
    return text[0].upper() + text[1:]


def is_ours(payload: bytes, topics: Topics) -> bool:
    """True for the discovery of this gateway or one of its ESCs, published by any version."""
    try:
        found = json.loads(payload)
        return (
            found["origin"]["name"] == PROGRAM and {"topic": topics.online} in found["availability"]
        )
    except (ValueError, KeyError, TypeError):
        return False
