"""``kontronik-can-gw mqtt`` without a broker: each mistake is one line with the remedy."""

import errno
import sys
from pathlib import Path
from typing import NoReturn

import pytest
from command_line import refused, run, written

CAPTURE = Path(__file__).parents[1] / "golden/captures/state.kcap"


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--broker", "127.0.0.1:1", "--ca-file", "x"], 2, "--tls"),
        (
            ["--broker", "127.0.0.1:1", "--username", "x", "--password-file", "empty"], 1,
            "has no password on its first line",
        ),
        (["--broker", "127.0.0.1:1", "--tls", "--ca-file", "empty"], 1, "empty: [X509: NO_CERTIFICATE"),
        (["--broker", "127.0.0.1:1", "--interface", "socketcan", "--channel", "no0"], 1, "no0"),
        (["--broker", "127.0.0.1:1", "--discovery", "empty"], 2, "is a file. Give FILE before the options."),
    ],
)  # fmt: skip
def test_each_mistake_is_one_line_with_the_remedy(
    words: list[str], code: int, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "empty", "\nx")
    assert said in refused(code, "mqtt", *words)


def test_a_machine_without_loopback_is_one_line_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unreachable(_: object) -> NoReturn:
        raise OSError(errno.ENETUNREACH, "Network is unreachable")

    monkeypatch.setattr("paho.mqtt.client.Client.loop_start", unreachable)
    done = run("mqtt", CAPTURE, "--broker", "192.0.2.1")
    assert (done.code, "Traceback" in done.err) == (1, False)
    assert "127.0.0.1: Network is unreachable." in done.err
    assert done.err.endswith("sudo ip link set lo up\n")


def test_without_the_library_its_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [
        name for name in sys.modules if name.startswith(("paho", "kontronik_can_gw.desk.mqtt"))
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "paho", None)
    assert (
        refused(1, "mqtt", "--broker", "x")
        == "needs paho-mqtt 2: pip install 'kontronik-can-gw[mqtt]'"
    )
