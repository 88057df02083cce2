"""The ESC protocols that the gateway can decode. Another one is a folder beside ``kontronik`` and a line here."""

from kontronik_can_gw.esc.decoder import EscProtocol
from kontronik_can_gw.esc.kontronik.protocol import KONTRONIK

PROTOCOLS: tuple[EscProtocol, ...] = (KONTRONIK,)
"""The first is that of an ESC whose configuration names none."""


def protocol_named(name: str | None) -> EscProtocol:
    """The protocol of this name; None, as in files of 0.5.0: the first. ValueError where there is none."""
    if name is None:
        return PROTOCOLS[0]
    for protocol in PROTOCOLS:
        if protocol.name == name:
            return protocol
    raise ValueError(
        f"ESC protocol {name[:40]!r} is unknown, there is {', '.join(protocol_names())}"
    )


def protocol_names() -> tuple[str, ...]:
    """Names of all protocols."""
    return tuple(protocol.name for protocol in PROTOCOLS)


def device_names() -> tuple[str, ...]:
    """Names of all devices of all protocols."""
    return tuple(dict.fromkeys(text for each in PROTOCOLS for text in each.devices.values()))
