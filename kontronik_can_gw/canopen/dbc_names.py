"""Names in the PDO DBC."""

import re
from collections.abc import Sequence

from kontronik_can_gw.canopen.emergency_codes import BitCodes, GatewayError
from kontronik_can_gw.dbc.names import MAX_NAME
from kontronik_can_gw.esc.decoder import ErrorBit


class Names:
    """Makes names that are unique in the file, even if case is ignored, and not too long."""

    def __init__(self) -> None:
        self._taken: set[str] = set()

    def take(self, prefix: str, stem: str, end: str = "") -> str:
        """Return a new name of ``prefix``, ``stem`` and ``end``.

        The stem is shortened if necessary. A number is added to it if the name is already used.
        """
        number = 1
        while True:
            tail = end if number == 1 else f"{number}{end}"
            room = MAX_NAME - len(prefix) - len(tail)
            name = prefix + stem[:room] + tail
            if name.lower() not in self._taken:
                self._taken.add(name.lower())
                return name
            number += 1


def pascal_case(text: str) -> str:
    """Return a name in the spelling of DBC files.

    For example, ``bec_voltage``, ``BEC voltage`` and ``BecVoltage`` become ``BecVoltage``.
    """
    words = (
        re.sub("[A-Z]+(?=[A-Z][a-z]|[^a-z]*$)", _capitalized, word)
        for word in re.split("[^A-Za-z0-9]+", text)
    )
    return "".join(word[:1].upper() + word[1:] for word in words)


def emergency_names(bits: Sequence[ErrorBit]) -> dict[int, str]:
    """Return the names of all emergency codes that a node can send. 0 is NoError."""
    named = {int(bit): pascal_case(bit.name) for bit in bits}
    codes = BitCodes(bits)
    found = {0: "NoError"}
    for bit in range(32):
        found[codes.code(bit)] = named.get(bit, f"Bit{bit}")
    for error in GatewayError:
        code, _ = error.value
        found[code] = pascal_case(error.name)
    shared_code, _ = GatewayError.TELEMETRY_LOST.value
    found[shared_code] = "TelemetryFault"  # the name for all errors with this code
    return found


def _capitalized(match: re.Match[str]) -> str:
    return match[0].capitalize()
