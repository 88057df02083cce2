"""Names in the PDO DBC."""

import re
from collections.abc import Sequence

from kontronik_can_gw.canopen.emergency_codes import BitCodes, GatewayError
from kontronik_can_gw.dbc.names import MAX_NAME
from kontronik_can_gw.esc.decoder import ErrorBit


class Names:
    """Names that are unique over the file, also where case is ignored, and no longer than tools take."""

    def __init__(self) -> None:
        self._taken: set[str] = set()

    def take(self, prefix: str, stem: str, end: str = "") -> str:
        """``prefix`` + ``stem`` + ``end``. The stem is cut to fit, and gets a number where the name is taken."""
        number = 1
        while True:
            tail = f"{number if number > 1 else ''}{end}"
            name = prefix + stem[: MAX_NAME - len(prefix) - len(tail)] + tail
            if name.lower() not in self._taken:
                self._taken.add(name.lower())
                return name
            number += 1


def pascal_case(text: str) -> str:
    """A name in any spelling as DBC files have it: ``bec_voltage``, ``BEC voltage`` and ``BecVoltage`` become ``BecVoltage``."""
    words = (
        re.sub("[A-Z]+(?=[A-Z][a-z]|[^a-z]*$)", _capitalized, word)
        for word in re.split("[^A-Za-z0-9]+", text)
    )
    return "".join(word[:1].upper() + word[1:] for word in words)


def emergency_names(bits: Sequence[ErrorBit]) -> dict[int, str]:
    """Every emergency code a node can send, with its name; 0 is NoError."""
    named = {int(bit): pascal_case(bit.name) for bit in bits}
    codes = BitCodes(bits)
    found = {0: "NoError"} | {codes.code(bit): named.get(bit, f"Bit{bit}") for bit in range(32)}
    found |= {error.value[0]: pascal_case(error.name) for error in GatewayError}
    found[GatewayError.TELEMETRY_LOST.value[0]] = (
        "TelemetryFault"  # several findings share this code
    )
    return found


def _capitalized(match: re.Match[str]) -> str:
    return match[0].capitalize()
