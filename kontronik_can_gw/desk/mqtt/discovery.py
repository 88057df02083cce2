"""Home Assistant's discovery: an entity for each value, with unit, device class, availability.

No I/O, no clock.
"""

import tomllib
from pathlib import Path
from typing import Any

from kontronik_can_gw import __version__
from kontronik_can_gw.desk.mqtt.published import Published, Topics
from kontronik_can_gw.esc.values import VALUES, Group

PROGRAM = "kontronik-can-gw"
_TABLES = tomllib.loads(Path(__file__).with_name("discovery.toml").read_text(encoding="utf-8"))
_SOURCES = _TABLES["sources"]


def device(topics: Topics, member: Published) -> dict[str, Any]:
    """Return the discovery payload of the gateway or an ESC: one device with all its entities."""
    identifier = topics.identifier(member.name)
    online = {"topic": topics.of("online")}
    gateway_available = {"topic": topics.of("available")}
    member_available = {"topic": topics.of(member.name, "available")}
    components: dict[str, dict[str, Any]] = {}
    for source in member.no_flags:
        if source not in _SOURCES["left_out"]:
            components[source] = entity(source, member)
    protocol = member.protocol
    if member.index is not None and member.has(*protocol.bits, *protocol.errors):
        components |= _TABLES["errors"]
    if member.has("operating_state", "operating_state_raw"):
        components["motor"] = _TABLES["motor"]
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
    is_diagnostic = value.group.value in _SOURCES["diagnostic_groups"]
    if is_diagnostic and source not in _SOURCES["measured"]:
        found["entity_category"] = "diagnostic"
    if column.texts:
        texts = [text for _, text in column.texts]
        found["device_class"] = "enum"
        found["options"] = list(dict.fromkeys(texts))
        return found
    if value.names:  # an enumeration that the DBC sends as a number without texts
        return found
    default_class = "total_increasing" if value.rolls else "measurement"
    default = (value.unit, "", default_class)
    unit, device_class, state_class = _TABLES["units"].get(value.unit, default)
    found["state_class"] = state_class
    found["unit_of_measurement"] = unit
    found["device_class"] = device_class
    if source not in member.factors:
        found["suggested_display_precision"] = column.digits
    return {key: entry for key, entry in found.items() if entry not in (None, "")}


def _display_name(source: str) -> str:
    words = [word.upper() if word in _SOURCES["capitals"] else word for word in source.split("_")]
    text = " ".join("ESCs" if word == "escs" else word for word in words)
    return text[0].upper() + text[1:]
