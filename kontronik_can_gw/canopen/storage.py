"""The parameters that one node keeps over a restart, and the text of their file.

Store 1010h and restore defaults 1011h follow CiA 301, 7.5.2.13/14, and verify configuration 1020h
follows CiA 302. The node-ID that LSS set is stored too.

The file has two lines of JSON in exactly one form. Each ends in a line feed::

    {"format":"kontronik-can-gw parameters","version":1,"crc32":"5D8B2C1F"}
    {"node_id":7,"communication":{"1017:00":"F401"},"application":{"2100:01":"07"}}

``crc32`` is the CRC-32 (zlib) of the second line with its line feed. Keys are index:sub-index in
hexadecimal, in ascending order. Values are the raw little-endian bytes in hexadecimal. ``node_id``
is null if no node-ID was set over the bus.
"""

import json
import re
import zlib
from collections import deque
from collections.abc import Callable, Container, Mapping
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
"""Objects whose values have rules beyond type and limits, except PDOs, which check their own."""
_NO_CONFIGURATION = frozenset({0x1003, 0x1010, 0x1011, VERIFY, at.RESET_STATISTICS})
"""Objects that can be written but are not part of a configuration."""
_PARAMETERS = {1: range(0x1000, 0x10000), 2: COMMUNICATION, 3: APPLICATION}
"""The indices that each sub-index of 1010h and 1011h concerns."""
_MAX_SAVES = 4
"""Maximum number of pending saves."""

_HEADER = re.compile(
    rb'\{"format":"kontronik-can-gw parameters",'
    rb'"version":([0-9]{1,9})[,}](?:"crc32":"([0-9A-F]{8})"\}\n)?'
)


@dataclass(frozen=True)
class Stored:
    """The parameters that one node keeps over a restart."""

    node_id: int | None = None
    """1..127, or 255 (unconfigured), as set over the bus. None: the configured one is used."""
    values: Mapping[int, bytes] = field(default_factory=dict)
    """Raw little-endian bytes by index << 8 | sub-index. The indices are 1000h..FFFFh."""

    @property
    def has_ids(self) -> bool:
        """True if it holds a node-ID or COB-IDs."""
        return self.node_id is not None or any(key >> 8 in _WITH_COB_ID for key in self.values)

    def without_ids(self) -> "Stored":
        """Return a copy without the node-ID and COB-IDs."""
        return Stored(None, self.without(_WITH_COB_ID)).unverified()

    def unverified(self) -> "Stored":
        """Return a copy without 1020h, because it does not describe this configuration."""
        return Stored(self.node_id, self.without((VERIFY,)))

    def without(self, indices: Container[int]) -> dict[int, bytes]:
        """Return the values of all other indices."""
        return {key: data for key, data in self.values.items() if key >> 8 not in indices}


def encode(stored: Stored) -> bytes:
    """Return the text of the file in ASCII, which is the same for equal content.

    ValueError for an impossible node-ID. All keys are objects of 1000h to FFFFh.
    """
    node_id = stored.node_id
    if node_id is not None and not _is_node_id(node_id):
        raise ValueError(f"node_id {node_id!r} is not 1..127, 255 or null")
    content = {
        "node_id": node_id,
        "communication": _texts(stored.values, COMMUNICATION),
        "application": _texts(stored.values, APPLICATION),
    }
    body = _line(content)
    header = {
        "format": "kontronik-can-gw parameters",
        "version": VERSION,
        "crc32": f"{zlib.crc32(body):08X}",
    }
    return _line(header) + body


def decode(data: bytes) -> Stored:
    """Return the content of a file's text.

    ValueError with the reason for any text that ``encode`` of this version does not write.
    """
    if not data:
        raise ValueError("the file is empty")
    header = _HEADER.match(data)
    if header is None:
        raise ValueError("the first line is not the header of a parameter file")
    version = int(header[1])
    if version != VERSION:
        raise ValueError(
            f"format version {version} is not supported. This program supports version {VERSION}"
        )
    body = data[header.end() :]
    if int(header[2] or b"-1", 16) != zlib.crc32(body):
        raise ValueError("the content does not match its CRC-32: damaged or truncated")
    try:
        content = json.loads(body)
        values = {}
        for address, text in (content["communication"] | content["application"]).items():
            values[int(address.replace(":", ""), 16)] = bytes.fromhex(text)
        stored = Stored(content["node_id"], values)
        if encode(stored) == data:
            return stored
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        pass  # written by hand or by another program, because the CRC fits
    raise ValueError("the content was not written by this program")


def _is_node_id(value: object) -> bool:
    """Return True for 1..127 and 255. JSON may hold any type here."""
    if type(value) is not int:
        return False
    return 1 <= value <= 127 or value == UNCONFIGURED


def _line(content: Mapping[str, Any]) -> bytes:
    text = json.dumps(content, separators=(",", ":"))
    return text.encode("ascii") + b"\n"


def _texts(values: Mapping[int, bytes], indices: range) -> dict[str, str]:
    """Return the values of these indices as in the file."""
    texts = {}
    for key in sorted(values):
        if key >> 8 in indices:
            texts[f"{key >> 8:04X}:{key & 0xFF:02X}"] = values[key].hex().upper()
    return texts


class Parameters:
    """Stores and restores the parameters of one node.

    ``save`` is called to begin a save. Its result is passed to ``saved`` later.
    """

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
        """The node-ID set over the bus, or None. It is stored with the application parameters."""
        self._dictionary = dictionary
        self._sdo = sdo
        self._begin_save = save
        self._node_id = UNCONFIGURED
        self._stored = stored
        """The content of the file."""
        self._wanted = stored
        """The content of the file after all pending saves."""
        self._pending: deque[tuple[int | None, Stored]] = deque()
        """Ticket of the SDO server (None for LSS) and content of each pending save."""
        for part in (1, 2, 3):
            for index, word, written in (
                (0x1010, b"save", self._store),
                (0x1011, b"load", self._restore),
            ):
                dictionary.bind(
                    index,
                    part,
                    read=self._stores_on_command,
                    check=signature(word),
                    written=partial(written, part),
                )

    # --- reset

    def reset_application(self, node_id: int) -> None:
        """Set 2000h..FFFFh to their power-on values."""
        self.rejected = self._dictionary.reset(APPLICATION, node_id, self._stored.values)

    def reset_communication(self, node_id: int) -> None:
        """Set 1000h..1FFFh to their power-on values."""
        self._node_id = node_id
        self.rejected += self._dictionary.reset(COMMUNICATION, node_id, self._stored.values)

    def reject_what_breaks_rules(self) -> None:
        """Replace stored communication parameters that a download would refuse by the defaults."""
        for number in self._stored.values:
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
        """Clear 1020h at a reset if the present parameters are not the ones stored with it."""
        application = self._dictionary.to_store(APPLICATION, self._node_id)
        if self.rejected or application != self._stored.without(COMMUNICATION):
            self._configuration_changed()

    # --- changes

    def on_download(self, variable: Variable, has_changed: bool) -> None:
        """Clear 1020h if a parameter was changed over the bus."""
        if has_changed and variable.entry.index not in _NO_CONFIGURATION:
            self._configuration_changed()

    def store_node_id(self) -> bool:
        """Begin to save only the node-ID, for LSS. False if too many saves are pending."""
        try:
            self._save(None, replace(self._wanted, node_id=self.set_node_id))
        except SdoAbort:
            return False
        return True

    def saved(self, is_saved: bool) -> int | None:
        """Note that the oldest pending save reached the disk, or failed.

        Returns its ticket of the SDO server, or None for LSS.
        """
        ticket, stored = self._pending.popleft()
        if is_saved:
            self._stored = stored
        elif not self._pending:
            self._wanted = self._stored
        return ticket

    def _configuration_changed(self) -> None:
        """Clear 1020h, so that a master downloads its configuration again."""
        for variable in self._dictionary.subs(VERIFY):
            variable.value = 0

    def _stores_on_command(self, _now: int) -> int:
        """Return the value of 1010h and 1011h: bit 0 is set unless writing is switched off."""
        return int(not self._dictionary.read_only)

    def _store(self, part: int, _now: int) -> bool:
        """Serve 1010h: store all (1), communication (2) or application parameters (3).

        Returns False, because the SDO server must wait for the result.
        """
        indices = _PARAMETERS[part]
        to_store = self._dictionary.to_store
        values = self._wanted.without(indices) | to_store(indices, self._node_id)
        node_id = self._wanted.node_id if part == 2 else self.set_node_id
        stored = Stored(node_id, values)
        if values != to_store(_PARAMETERS[1], self._node_id):
            stored = stored.unverified()
        self._save(self._sdo.waiting, stored)
        return False

    def _restore(self, part: int, _now: int) -> bool:
        """Serve 1011h: use defaults after the next reset.

        A node-ID that LSS stored is kept. LSS removes it. Returns False, because the SDO server
        must wait for the result.
        """
        wanted = self._wanted
        stored = Stored(wanted.node_id, wanted.without(_PARAMETERS[part]))
        self._save(self._sdo.waiting, stored.unverified())
        return False

    def _save(self, ticket: int | None, stored: Stored) -> None:
        if len(self._pending) >= _MAX_SAVES:  # the disk is too slow
            raise SdoAbort(Abort.LOCAL_CONTROL)
        self._wanted = stored
        self._pending.append((ticket, stored))
        self._begin_save(stored)
