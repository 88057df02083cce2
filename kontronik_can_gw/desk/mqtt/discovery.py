"""Home Assistant's discovery: an entity for each value, with unit, device class, availability.

No I/O, no clock.
"""

from typing import Any

from kontronik_can_gw import __version__
from kontronik_can_gw.desk.mqtt.published import Published
from kontronik_can_gw.desk.mqtt.topics import Topics
from kontronik_can_gw.esc.values import VALUES, Group

PROGRAM = "kontronik-can-gw"
_UNITS: dict[str, tuple[str | None, str | None, str]] = {
    "V": ("V", "voltage", "measurement"),
    "A": ("A", "current", "measurement"),
    "W": ("W", "power", "measurement"),
    "°C": ("°C", "temperature", "measurement"),
    "Hz": ("Hz", "frequency", "measurement"),
    "ms": ("ms", "duration", "measurement"),
    "1/min": ("rpm", None, "measurement"),
    "%": ("%", None, "measurement"),
    "µs": ("µs", None, "measurement"),
    "Wh": ("Wh", "energy", "total_increasing"),
    "mAh": ("mAh", None, "total_increasing"),
    "s": ("s", "duration", "total_increasing"),
}
"""For our units: Home Assistant's unit, device class and state class.

Home Assistant has no device class for rotational speed or charge, and its classes for % are
humidity and battery level. Values of the class ``total_increasing`` restart at 0 with the ESC or
the gateway.
"""
_DIAGNOSTIC = {Group.LINK, Group.INFO, Group.GATEWAY}
"""Groups whose values are diagnostic."""
_NOT_DIAGNOSTIC = {"energy_used", "motor_run_time", "link_state"}
"""Values of these groups that are shown with the measured values nevertheless."""
_UPPER = {"bec", "pwm", "crc", "can", "id", "esc", "eeprom"}
"""Words that are written in capitals."""
_LEFT_OUT = {
    "operating_state_raw",
    "device_raw",
    "operating_errors",
    "selftest_errors",
    "firmware_main",
    "firmware_sub",
}
"""Sources without an entity, because another entity shows the same."""
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
        "value_template": (
            "{% if value_json.problem is none %}None"
            "{% elif value_json.problem %}ON{% else %}OFF{% endif %}"
        ),
    },
    "errors": {
        "platform": "sensor",
        "name": "Errors",
        "value_template": _NAMES.format("errors"),
    },
    "selftest": {
        "platform": "sensor",
        "name": "Self-test",
        "entity_category": "diagnostic",
        "value_template": _NAMES.format("selftest"),
    },
}


def device(topics: Topics, member: Published) -> dict[str, Any]:
    """Return the discovery payload of the gateway or an ESC: one device with all its entities."""
    identifier = topics.identifier(member.name)
    online = {"topic": topics.of("online")}
    gateway_available = {"topic": topics.of("available")}
    member_available = {"topic": topics.of(member.name, "available")}
    components: dict[str, dict[str, Any]] = {}
    for source in member.no_flags:
        if source not in _LEFT_OUT:
            components[source] = entity(source, member)
    protocol = member.protocol
    if member.index is not None and member.has(*protocol.bits, *protocol.errors):
        components |= _ERROR_ENTITIES
    if member.has("operating_state", "operating_state_raw"):
        components["motor"] = _MOTOR
    for key, component in components.items():
        components[key] = {**component, "unique_id": f"{identifier}_{key}"}
        if key in VALUES and VALUES[key].group is Group.LINK:
            # Values of the link stay valid while the ESC sends nothing, and are most useful then.
            components[key] |= {
                "availability": [online, gateway_available],
                "availability_mode": "all",
            }
    about = {"identifiers": [identifier]}
    about |= _about(topics, member)
    return {
        "device": about,
        "origin": {"name": PROGRAM, "sw_version": __version__},
        "availability": [online, member_available],
        "availability_mode": "all",
        "state_topic": topics.of(member.name, "state"),
        "components": components,
    }


def _about(topics: Topics, member: Published) -> dict[str, Any]:
    if member.index is None:
        return {"name": f"KONTRONIK gateway {topics.gateway}", "model": PROGRAM}
    model, firmware = member.identity or (None, None)
    about = {
        "name": f"{topics.gateway} {member.name}",
        "manufacturer": member.protocol.maker,
        "model": model or "ESC",
        "via_device": topics.identifier(),
    }
    if firmware is not None:
        about["sw_version"] = firmware
    return about


def entity(source: str, member: Published) -> dict[str, Any]:
    """Return Home Assistant's entity of a value."""
    value = VALUES[source]
    column = member.view.reader.columns[member.columns[source]]
    found: dict[str, Any] = {
        "platform": "sensor",
        "name": _display_name(source),
        "value_template": f"{{{{ value_json.{source} }}}}",
    }
    if value.group in _DIAGNOSTIC and source not in _NOT_DIAGNOSTIC:
        found["entity_category"] = "diagnostic"
    if column.texts:
        texts = [text for _, text in column.texts]
        found["device_class"] = "enum"
        found["options"] = list(dict.fromkeys(texts))
        return found
    if value.names:  # an enumeration that the DBC sends as a number without texts
        return found
    default_class = "total_increasing" if value.rolls else "measurement"
    default = (value.unit or None, None, default_class)
    unit, device_class, state_class = _UNITS.get(value.unit, default)
    found["state_class"] = state_class
    found["unit_of_measurement"] = unit
    found["device_class"] = device_class
    if source not in member.factors:
        found["suggested_display_precision"] = column.digits
    return {key: entry for key, entry in found.items() if entry is not None}


def _display_name(source: str) -> str:
    words = []
    for word in source.split("_"):
        if word in _UPPER:
            word = word.upper()
        elif word == "escs":
            word = "ESCs"
        words.append(word)
    text = " ".join(words)
    return text[0].upper() + text[1:]
