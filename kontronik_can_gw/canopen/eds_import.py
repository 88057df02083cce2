"""The entries of a checked EDS as the ``canopen`` package reads them.

That package lets much pass (wrong numbers, counts, CompactSubObj), so it is given sections that were checked, in one spelling.
"""

import io
from collections.abc import Iterable, Iterator
from dataclasses import replace

from kontronik_can_gw.canopen.data_types import (
    ARRAY,
    RECORD,
    UNICODE_STRING,
    VAR,
    VISIBLE_STRING,
)
from kontronik_can_gw.canopen.eds_object import EdsObject, Entry
from kontronik_can_gw.canopen.eds_sections import spelling
from kontronik_can_gw.lean import without_asammdf

_CODINGS = {VISIBLE_STRING: "ascii", UNICODE_STRING: "utf-16-le"}


def import_entries(objects: Iterable[EdsObject]) -> Iterator[Entry]:
    """All entries in the order of the objects, node-ID 0."""
    with without_asammdf():
        from canopen.objectdictionary.eds import import_eds

    listed = list(objects)
    text = "\n".join(["[DeviceInfo]", *(line for item in listed for line in _lines(item))])
    dictionary = import_eds(io.StringIO(text), 0)  # type: ignore[no-untyped-call]  # import_od wants a file with a name
    for item in listed:
        for sub, entry in sorted(item.subs.items()):
            variable = dictionary.get_variable(item.index, sub)
            assert variable is not None
            default = variable.default
            if isinstance(default, str):
                default = default.encode(_CODINGS[entry.data_type])
            yield replace(
                entry,
                name=variable.name,
                access=variable.access_type,
                mappable=variable.pdo_mappable,
                low=variable.min,
                high=variable.max,
                default=default,
                relative=variable.relative,
            )


def _lines(item: EdsObject) -> Iterator[str]:
    """The sections of an object in one spelling."""
    lists = item.kind in (ARRAY, RECORD)
    if lists:
        yield from (f"[{item.index:04X}]", f"ParameterName={item.name}", f"ObjectType={item.kind}")
    for sub, entry in item.subs.items():
        yield f"[{spelling(item.index, sub if lists else None)}]"
        yield f"ParameterName={entry.name}"
        yield f"ObjectType={VAR if lists else item.kind}"
        yield f"DataType={entry.data_type}"
        yield f"AccessType={entry.access}"
        yield f"PDOMapping={int(entry.mappable)}"
        if entry.low is not None:
            yield f"LowLimit={entry.low}"
        if entry.high is not None:
            yield f"HighLimit={entry.high}"
        if entry.default is not None:
            yield f"DefaultValue={'$NODEID+' * entry.relative}{_default(entry)}"


def _default(entry: Entry) -> str:
    if not isinstance(entry.default, bytes):
        return str(entry.default)
    if entry.data_type in _CODINGS:
        return entry.default.decode(_CODINGS[entry.data_type])
    return entry.default.hex()
