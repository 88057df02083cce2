"""Names of messages, signals and values in the PDO DBC."""

import re
from collections.abc import Sequence

from kontronik_can_gw.canopen.emergency_codes import BitCodes, GatewayError
from kontronik_can_gw.dbc.names import MAX_NAME
from kontronik_can_gw.esc.decoder import ErrorBit


class Names:
    """Names that are unique in a file, even without regard to case, and short enough for tools."""

    def __init__(self) -> None:
        self._taken: set[str] = set()

    def make_unique(self, prefix: str, stem: str, end: str = "") -> str:
        """Return ``prefix`` + ``stem`` + ``end``, and note the name as taken.

        The stem is cut to fit, and gets a number if the name is taken already.
        """
        number = 1
        while True:
            tail = f"{number}{end}" if number > 1 else end
            room = MAX_NAME - len(prefix) - len(tail)
            name = prefix + stem[:room] + tail
            if name.lower() not in self._taken:
                self._taken.add(name.lower())
                return name
            number += 1


def pascal_case(text: str) -> str:
    """Return a name of any spelling in Pascal case, as DBC files have it.

    ``bec_voltage``, ``BEC voltage`` and ``BecVoltage`` become ``BecVoltage``.
    """
    parts = []
    for word in re.split("[^A-Za-z0-9]+", text):
        capitalized = re.sub(
            "[A-Z]+(?=[A-Z][a-z]|[^a-z]*$)", lambda match: match[0].capitalize(), word
        )
        parts.append(capitalized[:1].upper() + capitalized[1:])
    return "".join(parts)


def emergency_names(bits: Sequence[ErrorBit]) -> dict[int, str]:
    """Return the name of every emergency code that a node can send. 0 is NoError."""
    bit_names = {int(bit): pascal_case(bit.name) for bit in bits}
    codes = BitCodes(bits)
    names = {0: "NoError"}
    for bit in range(32):
        names[codes.code(bit)] = bit_names.get(bit, f"Bit{bit}")
    for error in GatewayError:
        code, _ = error.value
        names[code] = pascal_case(error.name)
    # several errors of the gateway share this code
    code, _ = GatewayError.TELEMETRY_LOST.value
    names[code] = "TelemetryFault"
    return names
