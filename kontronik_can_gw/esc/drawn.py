"""What an ESC has drawn and how long its motor has turned: integrals over its live data."""

from collections.abc import Sequence
from fractions import Fraction

from kontronik_can_gw.esc.decoder import SECOND_NS, EscProtocol


class Drawn:
    """``energy`` in whole milliwatt seconds, drawn from the battery (regeneration does not count); ``run_time`` in ns.

    Between two readings the power, and whether the motor turns, are those of the first.
    """

    __slots__ = ("_power", "_power_factor", "_rest", "_speed", "_turns", "_unit", "energy", "run_time")  # fmt: skip

    def __init__(self, protocol: EscProtocol) -> None:
        self.energy = 0
        self.run_time = 0
        self._rest = 0  # power steps by nanoseconds, less than a milliwatt second
        self._turns = False
        self._power = 0  # in steps
        voltage, current = (
            protocol.by_name.get(name) for name in ("battery_voltage", "battery_current")
        )
        speed = protocol.by_name.get("electrical_speed")
        self._speed = None if speed is None else speed.word
        self._power_factor: tuple[int, int, int] | None = None
        self._unit = SECOND_NS
        if voltage is not None and current is not None:
            # a step of voltage (10 mV) by one of current (0.1 A) is exactly 1 mW with KONTRONIK
            milliwatts = Fraction(1000, voltage.per_unit * current.per_unit)
            self._power_factor = voltage.word, current.word, milliwatts.numerator
            self._unit = SECOND_NS * milliwatts.denominator

    @property
    def energy_mw_ns(self) -> int:
        """The energy in milliwatt nanoseconds, as a capture holds it."""
        return self.energy * SECOND_NS + self._rest * SECOND_NS // self._unit

    @energy_mw_ns.setter
    def energy_mw_ns(self, energy: int) -> None:
        self.energy, rest = divmod(energy, SECOND_NS)
        self._rest = rest * self._unit // SECOND_NS

    def add(self, ns: int) -> None:
        """Time passed since the last reading, which was fresh all the while."""
        if self._power > 0:
            rest = self._rest + self._power * ns
            if rest >= self._unit:
                self.energy += rest // self._unit
                rest %= self._unit
            self._rest = rest
        if self._turns:
            self.run_time += ns

    def take(self, live: Sequence[int]) -> None:
        """The newest live data."""
        if (power := self._power_factor) is not None:
            self._power = live[power[0]] * live[power[1]] * power[2]
        if self._speed is not None:
            self._turns = live[self._speed] != 0
