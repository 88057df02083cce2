"""``kontronik-can-gw mqtt`` without a broker: each mistake is one line with a remedy."""

import errno
from pathlib import Path
from typing import NoReturn

import pytest
from command_line import refused, run, written

pytestmark = pytest.mark.promise("mqtt")

HERE = "broker = '127.0.0.1:1'\n"


def configuration(folder: Path, mqtt: str) -> Path:
    text = f'[can]\ninterface = "virtual"\n[mqtt]\n{mqtt}[[esc]]\nport = "x"\n'
    return written(folder / "gateway.toml", text)


@pytest.mark.parametrize(
    ("mqtt", "words", "code", "said"),
    [
        ("", [], 2, "no broker. Give --broker HOST"),
        ("", ["--broker", "a b"], 2, '--broker: "a b" is not a broker'),
        ("", ["flight.kcap"], 2, "Type kontronik-can-gw replay flight.kcap --on can"),
        (HERE + "ca_file = 'x'\n", [], 2, "mqtt.ca_file: has no effect without mqtt.tls"),
        (HERE + "password_file = 'x'\n", [], 2,
         "mqtt.password_file: has no effect without mqtt.username"),
        (HERE + "username = 'x'\npassword_file = 'empty'\n", [], 2,
         "has no password on its first line"),
        (HERE + "tls = true\nca_file = 'empty'\n", [], 2,
         "empty: cannot be used for TLS. Certificates must be in PEM form"),
        (HERE, ["--interface", "socketcan", "--channel", "no0"], 1, "no0"),
    ],
)  # fmt: skip
def test_mistake_is_one_line_with_a_remedy(
    mqtt: str,
    words: list[str],
    code: int,
    said: str,
    tmp_path: Path,
) -> None:
    written(tmp_path / "empty", "\nx")
    assert said in refused(code, "mqtt", "-c", configuration(tmp_path, mqtt), *words)


def test_missing_loopback_is_one_line_with_a_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unreachable(_: object) -> NoReturn:
        raise OSError(errno.ENETUNREACH, "Network is unreachable")

    monkeypatch.setattr("paho.mqtt.client.Client.loop_start", unreachable)
    done = run("mqtt", "-c", configuration(tmp_path, HERE))
    assert done.code == 1
    assert "Traceback" not in done.err
    assert "127.0.0.1: Network is unreachable." in done.err
    assert done.err.endswith("sudo ip link set lo up\n")
