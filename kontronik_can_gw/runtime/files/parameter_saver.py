"""Hands the nodes' parameters to the store, and returns the results to the nodes."""

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING

from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.runtime.ports.esc_port import EscPort
from kontronik_can_gw.runtime.status.facts import StoreFacts

if TYPE_CHECKING:
    from kontronik_can_gw.runtime.files.store import ParameterStore

log = logging.getLogger("kontronik_can_gw")


class ParameterSaver:
    """Hands savings to the store's thread in their order. A node has only a few at a time.

    If ``store`` is None, every saving fails.
    """

    def __init__(
        self,
        gateway: Gateway,
        escs: Sequence[EscPort],
        store: "ParameterStore | None",
    ) -> None:
        self._gateway = gateway
        self._escs = escs
        self._store = store
        self._waiting = 0
        self._last_error: str | None = None

    def save(self, now: int) -> None:
        """Hand over what is to be stored."""
        for index, content in self._gateway.take_saves():
            name = self._escs[index].name
            if self._store is not None and self._store.save(name, content):
                self._waiting += 1
            else:
                self._take(index, "there is no parameter store", now)

    def take_results(self, now: int, _events: int = 0) -> None:
        """Return the store's results to the nodes. Call it when they are readable."""
        if self._store is None:
            return
        names = [esc.name for esc in self._escs]
        for name, error in self._store.results():
            self._waiting -= 1
            self._take(names.index(name), error, now)

    def _take(self, index: int, error: str | None, now: int) -> None:
        name = self._escs[index].name
        if error is None:
            self._last_error = None
            log.info("%s: parameters stored", name)
        else:
            self._last_error = f"{name}: {error}"
            log.error("%s: parameters cannot be stored: %s", name, error)
        self._gateway.saved(index, error, now)

    def facts(self) -> StoreFacts | None:
        """Return the state of the store for the status document. None without a store."""
        if self._store is None:
            return None
        return StoreFacts(self._waiting, self._last_error)
