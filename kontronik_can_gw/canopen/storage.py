"""What one node keeps over a restart: store 1010h, restore defaults 1011h, verify configuration 1020h (CiA 301, 7.5.2.13/14; CiA 302), the
node-ID that LSS gave; and the text of the file that it is kept in.

Two lines of JSON, each ended by a line feed, in one form only::

    {"format":"kontronik-can-gw parameters","version":1,"crc32":"5D8B2C1F"}
    {"node_id":7,"communication":{"1017:00":"F401"},"application":{"2100:01":"07"}}

``crc32`` is the CRC-32 (zlib) of the second line with its line feed. Keys are index:sub-index in hexadecimal, in ascending
order; values are the raw little-endian bytes in hexadecimal; ``node_id`` is null if none was set over the bus.
"""

import json
import re
import zlib
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.dictionary import Abort, Dictionary, SdoAbort, Variable, signature
from kontronik_can_gw.canopen.sdo import SdoServer
from kontronik_can_gw.status import UNCONFIGURED

VERSION = 1
VERIFY = 0x1020
COMMUNICATION = range(0x1000, 0x2000)
APPLICATION = range(0x2000, 0x10000)
_WITH_COB_ID = frozenset({0x1005, 0x1014, *range(0x1800, 0x1A00)})
CHECKED = frozenset({0x1005, 0x1014, 0x1016, 0x1019, 0x1F80})
"""Objects of services whose values have rules beyond type and limits (those of PDOs have their own)."""
_NO_CONFIGURATION = frozenset({0x1003, 0x1010, 0x1011, VERIFY, at.RESET_STATISTICS})
"""Objects that can be written and are no part of a configuration."""
_ALL_OR_COMMUNICATION, _ALL_OR_APPLICATION = (1, 2), (1, 3)  # sub-indices
_MAX_SAVES = 4

_HEADER = re.compile(
    rb'\{"format":"kontronik-can-gw parameters","version":([0-9]{1,9})[,}](?:"crc32":"([0-9A-F]{8})"\}\n)?'
)


@dataclass(frozen=True)
class Stored:
    """What one node keeps over a restart. Keys of both mappings: index << 8 | sub-index; values: raw little-endian bytes."""

    node_id: int | None = None
    """1..127, or 255 (unconfigured), as set over the bus; None: as configured."""
    communication: Mapping[int, bytes] = field(default_factory=dict)
    """Objects 1000h..1FFFh."""
    application: Mapping[int, bytes] = field(default_factory=dict)
    """Objects 2000h..FFFFh."""

    @property
    def has_ids(self) -> bool:
        """Whether a node-ID or COB-IDs are in it."""
        return self.node_id is not None or any(
            key >> 8 in _WITH_COB_ID for key in self.communication
        )

    def without_ids(self) -> "Stored":
        """Without the node-ID and COB-IDs."""
        left = {k: data for k, data in self.communication.items() if k >> 8 not in _WITH_COB_ID}
        return replace(self, node_id=None, communication=left).unverified()

    def unverified(self) -> "Stored":
        """Without 1020h: these parameters are not, or no longer, all of the configuration that it names."""
        left = {key: data for key, data in self.communication.items() if key >> 8 != VERIFY}
        return replace(self, communication=left)


def encode(stored: Stored) -> bytes:
    """Write the file's text: ASCII, the same for equal content. ValueError for what is no node-ID, or no key of its mapping."""
    node_id = stored.node_id
    if node_id is not None and (
        type(node_id) is not int or not (1 <= node_id <= 127 or node_id == UNCONFIGURED)
    ):
        raise ValueError(f"node_id {node_id!r} is not 1..127, 255 or null")
    content = {
        "node_id": node_id,
        "communication": _texts(stored.communication, COMMUNICATION),
        "application": _texts(stored.application, APPLICATION),
    }
    body = _line(content)
    header = {
        "format": "kontronik-can-gw parameters",
        "version": VERSION,
        "crc32": f"{zlib.crc32(body):08X}",
    }
    return _line(header) + body


def decode(data: bytes) -> Stored:
    """Read the file's text. ValueError with the reason for everything that ``encode`` of this version does not write."""
    if not data:
        raise ValueError("the file is empty")
    header = _HEADER.match(data)
    if header is None:
        raise ValueError("the first line is not that of a parameter file")
    if (version := int(header[1])) != VERSION:
        raise ValueError(
            f"format version {version} is unknown, this program knows version {VERSION}"
        )
    body = data[header.end() :]
    if int(header[2] or b"-1", 16) != zlib.crc32(body):
        raise ValueError("the content does not fit its CRC-32: damaged or truncated")
    try:
        content = json.loads(body)
        values = [_values(content[profile]) for profile in ("communication", "application")]
        stored = Stored(content["node_id"], *values)
        if encode(stored) == data:
            return stored
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        pass  # written by hand or by another program, for the CRC fits
    raise ValueError("the content is not in the form in which this program writes it")


def _line(content: Mapping[str, Any]) -> bytes:
    return json.dumps(content, separators=(",", ":")).encode("ascii") + b"\n"


def _texts(values: Mapping[int, bytes], indices: range) -> dict[str, str]:
    for key in values:
        if key >> 8 not in indices:
            raise ValueError(f"{key >> 8:04X}h is not {indices[0]:04X}h to {indices[-1]:04X}h")
    return {f"{key >> 8:04X}:{key & 0xFF:02X}": values[key].hex().upper() for key in sorted(values)}


def _values(texts: Mapping[str, str]) -> dict[int, bytes]:
    return {int(key.replace(":", ""), 16): bytes.fromhex(text) for key, text in texts.items()}


class Parameters:
    """What one node keeps over a restart. ``save`` begins to store; ``saved`` is called with the result."""

    def __init__(
        self,
        dictionary: Dictionary,
        stored: Stored,
        sdo: SdoServer,
        save: Callable[[Stored], None],
    ) -> None:
        self.rejected: list[int] = []
        """Keys of stored values that were rejected at the last reset."""
        self.set_node_id = stored.node_id
        """The node-ID as set over the bus, None: never; stored with the application parameters."""
        self._dictionary = dictionary
        self._sdo = sdo
        self._begin_save = save
        self._node_id = UNCONFIGURED
        self._stored = stored
        self._wanted = stored
        # the SDO server's ticket, None for LSS
        self._pending: deque[tuple[int | None, Stored]] = deque()
        for index, word, written in (
            (0x1010, b"save", self._store),
            (0x1011, b"load", self._restore),
        ):
            for part in (1, 2, 3):
                check, then = signature(word), partial(written, part)
                dictionary.bind(
                    index, part, read=self._stores_on_command, check=check, written=then
                )

    # --- reset

    def reset_application(self, node_id: int) -> None:
        """Power-on values of 2000h..FFFFh."""
        self.rejected = self._dictionary.reset(APPLICATION, node_id, self._stored.application)

    def reset_communication(self, node_id: int) -> None:
        """Power-on values of 1000h..1FFFh."""
        self._node_id = node_id
        self.rejected += self._dictionary.reset(COMMUNICATION, node_id, self._stored.communication)

    def reject_what_breaks_rules(self) -> None:
        """Stored communication parameters pass the same checks as downloads, or give way to the defaults."""
        for number in self._stored.communication:
            variable = self._dictionary.variables.get(number)
            if variable is None or variable.check is None or number >> 8 not in CHECKED:
                continue
            assert isinstance(variable.value, int)
            try:
                variable.check(variable.value)
            except SdoAbort:
                variable.value = variable.default(self._node_id)
                self.rejected.append(number)

    def verify(self) -> None:
        """Clear 1020h at a reset if it was stored with other parameters than those that hold now."""
        application = self._dictionary.to_store(APPLICATION, self._node_id)
        if self.rejected or application != self._stored.application:
            self._configuration_changed()

    # --- changes

    def on_download(self, variable: Variable, changed: bool) -> None:
        """An object was written over the bus."""
        if changed and variable.entry.index not in _NO_CONFIGURATION:
            self._configuration_changed()

    def store_node_id(self) -> bool:
        """LSS: begin to store the node-ID alone. False: refused."""
        try:
            self._save(None, replace(self._wanted, node_id=self.set_node_id))
        except SdoAbort:
            return False
        return True

    def saved(self, ok: bool) -> int | None:
        """The oldest request to store is done: on disk, or failed. Returns the SDO server's ticket, None for LSS."""
        ticket, stored = self._pending.popleft()
        if ok:
            self._stored = stored
        elif not self._pending:
            self._wanted = self._stored
        return ticket

    def _configuration_changed(self) -> None:
        """1020h no longer names the configuration: its master downloads it anew."""
        for variable in self._dictionary.subs(VERIFY):
            variable.value = 0

    def _stores_on_command(self, _now: int) -> int:
        """What 1010h and 1011h show: bit 0."""
        return int(not self._dictionary.read_only)

    def _store(self, part: int, _now: int) -> bool:
        """1010h: sub-index 1 all, 2 communication, 3 application parameters."""
        communication = self._dictionary.to_store(COMMUNICATION, self._node_id)
        application = self._dictionary.to_store(APPLICATION, self._node_id)
        stored = self._wanted
        if part in _ALL_OR_COMMUNICATION:
            stored = replace(stored, communication=communication)
        if part in _ALL_OR_APPLICATION:
            stored = replace(stored, application=application, node_id=self.set_node_id)
        if (stored.communication, stored.application) != (communication, application):
            stored = stored.unverified()
        self._save(self._sdo.waiting, stored)
        return False

    def _restore(self, part: int, _now: int) -> bool:
        """1011h: defaults from the next reset on. A node-ID that LSS stored stays: it is taken back by LSS."""
        stored = self._wanted
        if part in _ALL_OR_COMMUNICATION:
            stored = replace(stored, communication={})
        if part in _ALL_OR_APPLICATION:
            stored = replace(stored, application={})
        self._save(self._sdo.waiting, stored.unverified())
        return False

    def _save(self, ticket: int | None, stored: Stored) -> None:
        if len(self._pending) >= _MAX_SAVES:  # a disk that does not come round
            raise SdoAbort(Abort.LOCAL_CONTROL)
        self._wanted = stored
        self._pending.append((ticket, stored))
        self._begin_save(stored)
