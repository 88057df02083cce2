"""The ESC protocols that the gateway can decode.

To add one, create a folder beside ``kontronik`` and add its ``EscProtocol`` to the tuple here.
"""

from kontronik_can_gw.esc.decoder import EscProtocol
from kontronik_can_gw.esc.kontronik.protocol import KONTRONIK

PROTOCOLS: tuple[EscProtocol, ...] = (KONTRONIK,)
"""All protocols. The first is used for an ESC whose configuration does not name one."""


def protocol_named(name: str | None) -> EscProtocol:
    """Return the protocol with this name, or raise ValueError if it is unknown.

    None returns the first protocol: captures of version 0.5.0 do not name one.
    """
    if name is None:
        return PROTOCOLS[0]
    for protocol in PROTOCOLS:
        if protocol.name == name:
            return protocol
    raise ValueError(f"unknown ESC protocol {name[:40]!r}. Known: {', '.join(protocol_names())}")


def protocol_names() -> tuple[str, ...]:
    """Return the names of all protocols."""
    return tuple(protocol.name for protocol in PROTOCOLS)


def device_names() -> tuple[str, ...]:
    """Return the device names of all protocols, each once."""
    names: dict[str, None] = {}
    for protocol in PROTOCOLS:
        names |= dict.fromkeys(protocol.devices.values())
    return tuple(names)
