"""All transmit PDOs of one node: made from the dictionary, set up at a reset, started, stopped, given SYNC."""

from collections.abc import Callable, Iterator

from kontronik_can_gw.canopen.abort import SdoAbort
from kontronik_can_gw.canopen.cob_ids import INVALID_BIT, Taken
from kontronik_can_gw.canopen.dictionary import Dictionary, Variable, key
from kontronik_can_gw.canopen.pdo import Tpdo
from kontronik_can_gw.canopen.pdo_parameters import COB_ID, COMMUNICATION, MAX_TPDOS
from kontronik_can_gw.esc.decoder import EscProtocol
from kontronik_can_gw.output import NEVER
from kontronik_can_gw.slots import Slot


class Tpdos:
    """Given in ascending numbers, as many as the EDS has. ``slot`` gives a further slot of the core."""

    def __init__(
        self,
        dictionary: Dictionary,
        protocol: EscProtocol,
        slot: Callable[[], Slot],
        taken: Taken,
    ) -> None:
        self._dictionary = dictionary
        self._held_up_ns = -NEVER
        self._tpdos = [
            Tpdo(number, dictionary, protocol, slot(), taken)
            for number in range(MAX_TPDOS)
            if dictionary.get(COMMUNICATION + number) is not None
        ]

    def __iter__(self) -> Iterator[Tpdo]:
        return iter(self._tpdos)

    # --- configuration

    def release_ids(self) -> None:
        """What PDOs had is free for another."""
        for tpdo in self._tpdos:
            tpdo.valid = False

    def reset(self, node_id: int, now: int) -> list[int]:
        """Take over the parameters as they are after a reset. Returns the keys of those that were rejected."""
        return [number for tpdo in self._tpdos for number in self._reset(tpdo, node_id, now)]

    def _reset(self, tpdo: Tpdo, node_id: int, now: int) -> list[int]:
        """Stored parameters that no longer make sense with this EDS give way to the defaults; without a free COB-ID there is no PDO."""
        rejected = []
        try:
            tpdo.configure(now)
            tpdo.check()
        except SdoAbort:
            for number, variable in self._dictionary.variables.items():
                if number >> 8 in tpdo.indices:
                    if variable.value != (default := variable.default(node_id)):
                        rejected.append(number)
                    variable.value = default
            tpdo.configure(now)
            cob_id = self._dictionary.get(tpdo.indices[0], COB_ID)
            if cob_id is not None and tpdo.valid and not tpdo.is_free():
                cob_id.value = int(cob_id.value) | INVALID_BIT
                rejected.append(key(tpdo.indices[0], COB_ID))
                tpdo.configure(now)
        return rejected

    # --- transmission

    def start(self, now: int) -> None:
        """The node has become OPERATIONAL."""
        for tpdo in self._tpdos:
            tpdo.start(now)

    def stop(self) -> None:
        """No PDO outside OPERATIONAL."""
        for tpdo in self._tpdos:
            tpdo.stop()

    def on_download(self, variable: Variable, now: int) -> None:
        """An object was written over the bus."""
        for tpdo in self._tpdos:
            tpdo.on_download(variable, now)

    def on_sync(self, counter: int, now: int, at: int) -> None:
        """A SYNC message that came ``at``; one from before a hold-up is counted, but not answered."""
        for tpdo in self._tpdos:
            tpdo.on_sync(counter, now, answer=at > self._held_up_ns)

    def held_up(self, now: int) -> None:
        """The process was held up until ``now``."""
        self._held_up_ns = now

    def repeat(self, now: int) -> None:
        """Send once more what is sent on change only."""
        for tpdo in self._tpdos:
            tpdo.repeat(now)
