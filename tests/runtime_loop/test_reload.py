"""Reading another configuration while the gateway runs."""

import logging
import select
import threading
from types import SimpleNamespace

import pytest
from wire_world import World, loop_in, run

from kontronik_can_gw.cli.common import fingerprint
from kontronik_can_gw.config import parse
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.runtime.reload import Reloader
from kontronik_can_gw.telemetry import SECOND

log = logging.getLogger("kontronik_can_gw")


def taken(reloader: Reloader) -> bool:
    assert select.select([reloader], [], [], 5)[0]
    return reloader.take(log.log)


def test_a_faulty_configuration_is_refused_with_its_lines_and_the_next_one_taken(
    caplog: pytest.LogCaptureFixture,
) -> None:
    answers: list[object] = [UserError("a.toml: pole_pairs: too many", "a.toml: x: unknown"), None, KeyError("oops"), 7]

    def read() -> object | None:
        answer = answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    reloader = Reloader(read)
    try:
        with caplog.at_level(logging.INFO, "kontronik_can_gw"):
            results = []
            for _ in range(4):
                assert reloader.begin()
                results.append(taken(reloader))
        assert results == [False, False, False, True]
        assert reloader.new == 7
        said = "\n".join(caplog.messages)
        assert "a.toml: pole_pairs: too many\na.toml: x: unknown\nthe new configuration is refused" in said
        assert "the configuration is unchanged" in said
        assert "KeyError('oops')" in said
    finally:
        reloader.close()


def test_a_second_request_while_it_is_being_read_is_none() -> None:
    gate = threading.Event()

    def read() -> object | None:
        gate.wait(10)
        return 1

    reloader = Reloader(read)
    assert reloader.begin()
    assert not reloader.begin()
    assert not select.select([reloader], [], [], 0)[0]
    gate.set()
    assert taken(reloader)
    reloader.close()


def test_a_reading_that_ends_behind_the_gateway_does_no_harm() -> None:
    gate = threading.Event()
    reloader = Reloader(lambda: int(gate.wait(10)))
    assert reloader.begin()
    reloader.close()
    gate.set()
    assert reloader._thread is not None
    reloader._thread.join(5)
    assert not reloader._thread.is_alive()


def test_what_belongs_to_another_process_changes_nothing() -> None:
    def of(**tables: object) -> bytes:
        return fingerprint(parse({"esc": [{"port": "/dev/ttyUSB0"}], **tables}, "a.toml"))

    assert of() == of(mqtt={"broker": "b", "rate": 2})
    assert of() != of(record={"directory": "c"})
    assert of() != of(can={"channel": "can1"})


def test_a_request_that_comes_while_a_reading_begins_is_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """A signal's handler runs between any two steps: what it asks for is not answered by the reading that had begun."""
    world = World()
    loop = loop_in(world, monkeypatch)
    begun: list[int] = []

    def begin() -> bool:
        begun.append(world.now)
        if len(begun) == 1:
            loop.reload()
        return True

    loop._reloader = SimpleNamespace(begin=begin)  # type: ignore[assignment]
    loop.open()
    loop.begin()
    loop.reload()
    run(loop, world, world.now + SECOND)
    loop.close()
    assert len(begun) == 2
    assert not loop.reload_asked
