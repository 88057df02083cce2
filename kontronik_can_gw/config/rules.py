"""Rules of the configuration that concern several keys: names and ports of the ESCs, node-IDs, outputs, TLS."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from posixpath import normpath

from kontronik_can_gw.config.keys import Config, EscConfig, MqttConfig
from kontronik_can_gw.dbc.binding import VALUES_BY_KEY
from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.node_state import UNCONFIGURED


def esc_problems(escs: Mapping[int, EscConfig]) -> Iterator[str]:
    """Names and ports that are taken, names that are ambiguous. ``escs``: the valid ones, by their number in the file."""
    names = {number: normalize(esc.name) for number, esc in escs.items()}
    seen: dict[str, int] = {}
    for number, esc in escs.items():
        if (other := seen.setdefault(names[number], number)) != number:
            yield f"esc[{number}].name: {esc.name!r} is also that of esc[{other}]"
    seen = {}
    for number, esc in escs.items():
        if (other := seen.setdefault(esc.port, number)) != number:
            yield f"esc[{number}].port: {esc.port!r} is also that of esc[{other}]"
    for number, esc in escs.items():
        if esc.device is not None and esc.device_number is None:
            yield f"esc[{number}].device: {esc.device!r} is no device of the protocol {esc.protocol}"
    for number, esc in escs.items():
        if _is_ambiguous(names[number], {"", *names.values()}):
            yield (
                f"esc[{number}].name: {esc.name!r} makes signal names ambiguous. "
                "Choose another name."
            )


def _is_ambiguous(name: str, starts: set[str]) -> bool:
    """True where a name, after one of ``starts``, and a value's name make another value's name.

    "max" and "electrical_speed" give "max_electrical_speed", which is a value; "a" and "a_max" clash too.
    """
    rests = [name.removeprefix(start) for start in starts if name.startswith(start)]
    return any(
        value.startswith(rest) and value.removeprefix(rest) in VALUES_BY_KEY
        for rest in filter(None, rests)
        for value in VALUES_BY_KEY
    )


def name_problem(names: Sequence[str]) -> str | None:
    """Why these ESC names are ambiguous; None where they are not."""
    escs = {number: EscConfig(port=str(number), name=name) for number, name in enumerate(names, 1)}
    return next((line.partition(".name: ")[2] for line in esc_problems(escs)), None)


def output_problems(config: Config) -> Iterator[str]:
    """Outputs that are all off, a statistics file that is read elsewhere, node-IDs that clash."""
    if (path := config.statistics_path) is not None:
        read = {
            "the configuration": Path(config.file),
            "the DBC": config.dbc_path,
            "the EDS": config.eds_path,
        }
        for what, other in read.items():
            if normpath(path) == normpath(other):
                yield f"statistics.file: {str(path)!r} is {what}, which would be overwritten"
    if config.canopen.enabled:
        yield from _node_id_problems(config)
    elif not config.dbc.enabled:
        yield (
            "dbc.enabled, canopen.enabled: both are false, so nothing would be sent. Enable one."
        )


def _node_id_problems(config: Config) -> Iterator[str]:
    seen: dict[int, int] = {}
    for number, node_id in enumerate(config.node_ids, 1):
        if node_id == UNCONFIGURED:
            if config.canopen.read_only:
                yield (
                    f"esc[{number}]: waits for a node-ID by LSS, which canopen.read_only = true refuses. "
                    "Give it a node_id."
                )
        elif not 1 <= node_id <= 127:
            yield (
                f"esc[{number}]: its node-ID would be {node_id}. "
                "Choose a smaller canopen.node_id, or a node_id for it."
            )
        elif (other := seen.setdefault(node_id, number)) != number:
            yield f"esc[{number}].node_id: {node_id} is also that of esc[{other}]"


def mqtt_problems(mqtt: MqttConfig) -> Iterator[str]:
    """Keys that need another one."""
    for name in ("ca_file", "cert_file", "key_file"):
        if getattr(mqtt, name) is not None and not mqtt.tls:
            yield f"{name}: is for TLS, which is off. Switch mqtt.tls on (--tls)."
    if mqtt.key_file is not None and mqtt.cert_file is None:
        yield (
            "key_file: needs the certificate that it belongs to. Set mqtt.cert_file (--cert-file)."
        )
    if mqtt.password_file is not None and mqtt.username is None:
        yield "password_file: needs a user name. Set mqtt.username (--username)."
