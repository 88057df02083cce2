"""Parameters that outlive a restart: store 1010h, restore defaults 1011h, verify configuration 1020h (CiA 301, 7.5.2.13/14; CiA 302)."""

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.abort import Abort, SdoAbort
from kontronik_can_gw.canopen.dictionary import Dictionary, Variable, signature
from kontronik_can_gw.canopen.sdo import SdoServer
from kontronik_can_gw.canopen.storage import APPLICATION, COMMUNICATION, VERIFY, Stored
from kontronik_can_gw.node_state import UNCONFIGURED

CHECKED = frozenset({0x1005, 0x1014, 0x1016, 0x1019, 0x1F80})
"""Objects of services whose values have rules beyond type and limits (those of PDOs have their own)."""
_NO_CONFIGURATION = frozenset({0x1003, 0x1010, 0x1011, VERIFY, at.RESET_STATISTICS})
"""Objects that can be written and are no part of a configuration."""
_ALL_OR_COMMUNICATION, _ALL_OR_APPLICATION = (1, 2), (1, 3)  # sub-indices
_MAX_SAVES = 4


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
