"""What an ESC has drawn and how long its motor has turned: integrals over its live data."""

from collections.abc import Sequence

from kontronik_can_gw.esc.decoder import SECOND_NS, EscProtocol


class Drawn:
    """``energy`` in whole milliwatt seconds, drawn from the battery (regeneration does not count); ``run_time`` in ns.

    Between two readings the power, and whether the motor turns, are those of the first.
    """

    __slots__ = ("_current", "_speed", "_sum", "_unit", "_voltage", "run_time")

    def __init__(self, protocol: EscProtocol) -> None:
        self.run_time = 0
        self._sum = 0  # steps of voltage by steps of current by nanoseconds
        self._unit = SECOND_NS  # what of it makes a milliwatt second: a whole number
        fields = protocol.by_name
        voltage, current = fields.get("battery_voltage"), fields.get("battery_current")
        speed = fields.get("electrical_speed")
        self._speed = None if speed is None else speed.word
        self._voltage: int | None = None
        self._current = 0
        if voltage is not None and current is not None:
            self._voltage, self._current = voltage.word, current.word
            self._unit = SECOND_NS // 1000 * voltage.per_unit * current.per_unit

    @property
    def energy(self) -> int:
        return self._sum // self._unit

    @property
    def energy_mw_ns(self) -> int:
        """The energy in milliwatt nanoseconds, as a capture holds it."""
        return self._sum * SECOND_NS // self._unit

    @energy_mw_ns.setter
    def energy_mw_ns(self, energy: int) -> None:
        self._sum = energy * self._unit // SECOND_NS

    def add(self, live: Sequence[int], ns: int) -> None:
        """Time passed since a reading, which was fresh all the while."""
        if self._voltage is not None:
            power = live[self._voltage] * live[self._current]
            if power > 0:
                self._sum += power * ns
        if self._speed is not None and live[self._speed]:
            self.run_time += ns
