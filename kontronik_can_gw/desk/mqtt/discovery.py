"""Home Assistant's discovery: which entity shows which value, with unit, device class and availability. Pure."""

from typing import TYPE_CHECKING, Any

from kontronik_can_gw import __version__
from kontronik_can_gw.esc.values import VALUES, Group

if TYPE_CHECKING:
    from kontronik_can_gw.desk.mqtt.messages import Published, Topics

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
"""Our unit: Home Assistant's unit, device class and state class. Speed and charge have none, and % is neither humidity nor battery.

What grows does so until the ESC or the gateway restarts.
"""
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


def device(topics: "Topics", member: "Published") -> dict[str, Any]:
    """The discovery of the gateway or of an ESC: one device with all its entities."""
    identifier, online = topics.identifier(member.name), {"topic": topics.of("online")}
    components: dict[str, dict[str, Any]] = {}
    for source in member.no_flags:
        if source not in _LEFT_OUT:
            components[source] = entity(source, member)
    if member.index is not None and member.has(*member.protocol.bits, *member.protocol.errors):
        components |= _ERROR_ENTITIES
    if member.has("operating_state", "operating_state_raw"):
        components["motor"] = _MOTOR
    for key, component in components.items():
        components[key] = {**component, "unique_id": f"{identifier}_{key}"}
        if key in VALUES and VALUES[key].group is Group.LINK:
            # values of the link are valid, and most useful, while the ESC sends nothing
            components[key] |= {
                "availability": [online, {"topic": topics.of("available")}],
                "availability_mode": "all",
            }
    return {
        "device": {"identifiers": [identifier], **_about(topics, member)},
        "origin": {"name": PROGRAM, "sw_version": __version__},
        "availability": [online, {"topic": topics.of(member.name, "available")}],
        "availability_mode": "all",
        "state_topic": topics.of(member.name, "state"),
        "components": components,
    }


def _about(topics: "Topics", member: "Published") -> dict[str, Any]:
    if member.index is None:
        return {"name": f"KONTRONIK gateway {topics.gateway}", "model": PROGRAM}
    model, firmware = member.identity or (None, None)
    about = {"name": f"{topics.gateway} {member.name}", "manufacturer": member.protocol.maker}
    about["model"] = model or "ESC"
    about["via_device"] = topics.identifier()
    return about if firmware is None else about | {"sw_version": firmware}


def entity(source: str, member: "Published") -> dict[str, Any]:
    """Home Assistant's entity of a value."""
    about, column = VALUES[source], member.view.reader.columns[member.columns[source]]
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
    counts = "total_increasing" if about.rolls else "measurement"
    unit, kind, made["state_class"] = _UNITS.get(about.unit, (about.unit or None, None, counts))
    made |= {"unit_of_measurement": unit, "device_class": kind}
    made["suggested_display_precision"] = None if source in member.factors else column.digits
    return {key: value for key, value in made.items() if value is not None}


def _in_words(source: str) -> str:
    words = [word.upper() if word in _UPPER else word for word in source.split("_")]
    text = " ".join("ESCs" if word == "escs" else word for word in words)
    return text[0].upper() + text[1:]
