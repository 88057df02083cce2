"""The shipped EDS as text, and with other keys or further objects, as an EDS editor leaves it."""

import re
from collections.abc import Mapping
from configparser import RawConfigParser

from kontronik_can_gw.config.keys import shipped

SHIPPED = shipped("eds/kontronik_esc.eds").read_bytes().decode("ascii")


def with_key(source: str, section: str, key: str, value: str) -> str:
    """The text with another value of a key, or with the key."""
    start = source.index(f"[{section}]")
    end = source.find("\r\n[", start)
    part = source[start : end if end >= 0 else None]
    changed = re.sub(rf"(?m)^{key}=.*?\r$", lambda _: f"{key}={value}\r", part)
    if changed == part and f"{key}={value}\r" not in part:
        changed = part.rstrip() + f"\r\n{key}={value}\r\n"
    return source.replace(part, changed)


def variable(data_type: int, access: str = "rw", name: str = "Test object", **keys: object) -> str:
    """The content of a section of a VAR."""
    values = {
        "ParameterName": name,
        "ObjectType": "0x7",
        "DataType": f"0x{data_type:04X}",
        "AccessType": access,
        **keys,
    }
    return "".join(f"{key}={value}\r\n" for key, value in values.items())


def with_object(source: str, index: int, content: str) -> str:
    """The text with one more manufacturer object, of which ``content`` is the section's."""
    count = int(re.search(r"\[ManufacturerObjects\]\r\nSupportedObjects=(\d+)", source)[1])  # type: ignore[index]
    source = with_key(source, "ManufacturerObjects", "SupportedObjects", str(count + 1))
    source = with_key(source, "ManufacturerObjects", str(count + 1), f"0x{index:04X}")
    return f"{source.rstrip()}\r\n\r\n[{index:04X}]\r\n{content}\r\n"


def device_info(text: str) -> dict[str, int]:
    """The numbers of [DeviceInfo], by their keys in lower case."""
    section = _parsed(text)["DeviceInfo"]
    return {key: int(value, 0) for key, value in section.items() if re.match("-?[0-9]", value)}


def lint(text: str) -> list[str]:
    """What CiA 306 wants and a gateway does not need to run: lists, counts and mappings that agree with the objects."""
    parsed = _parsed(text)
    objects = {int(name, 16): parsed[name] for name in parsed if re.fullmatch("[0-9A-F]{4}", name)}
    mandatory = {0x1000, 0x1001, 0x1018}
    own = {index for index in objects if 0x2000 <= index < 0x6000}
    lists = {
        "MandatoryObjects": mandatory,
        "OptionalObjects": set(objects) - mandatory - own,
        "ManufacturerObjects": own,
    }
    found = []
    for name, indices in lists.items():
        listed = {key: value for key, value in parsed[name].items() if key != "supportedobjects"}
        count = int(parsed[name]["SupportedObjects"], 0)
        if sorted(listed, key=int) != [str(number) for number in range(1, count + 1)]:
            found.append(f"[{name}] is not numbered 1 to {count}")
        if sorted(int(value, 0) for value in listed.values()) != sorted(indices):
            found.append(f"[{name}] has other objects")
    for index, section in objects.items():
        subs = [name for name in parsed if name.startswith(f"{index:04X}sub")]
        if int(section.get("SubNumber", "0"), 0) != len(subs):
            found.append(f"[{index:04X}] SubNumber")
    if device_info(text)["nroftxpdo"] != sum(0x1800 <= index < 0x1A00 for index in objects):
        found.append("[DeviceInfo] NrOfTXPDO")
    mapped = [name for name in parsed if not _may_be_mapped(parsed[name])]
    return found + [f"[{name}] PDOMapping" for name in mapped]


def _may_be_mapped(section: Mapping[str, str]) -> bool:
    if not int(section.get("PDOMapping", "0"), 0):
        return True
    has_length = int(section["DataType"], 0) not in (0x09, 0x0A, 0x0B, 0x0F)
    return has_length and section["AccessType"] != "wo"


def _parsed(text: str) -> RawConfigParser:
    parser = RawConfigParser()
    parser.read_string(text)
    return parser
