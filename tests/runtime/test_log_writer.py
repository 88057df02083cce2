"""The log's thread: what stands still behind it holds nobody up."""

import io
import logging
import threading

import pytest

from kontronik_can_gw.runtime.log_writer import CAPACITY, BackgroundHandler


class StuckStream(io.StringIO):
    """A disk that takes nothing until it is let go."""

    def __init__(self) -> None:
        super().__init__()
        self.stands = threading.Event()
        self.free = threading.Event()
        self.written: list[str] = []

    def write(self, text: str) -> int:
        self.stands.set()
        assert self.free.wait(60)
        self.written.append(text)
        return len(text)


def logger_to(handler: logging.Handler) -> logging.Logger:
    logger = logging.getLogger("a test's own")
    logger.setLevel(logging.INFO)
    logger.propagate = False
    logger.handlers.clear()
    logger.addHandler(handler)
    return logger


def test_a_stream_that_stands_still_holds_nobody_up_and_losses_are_told() -> None:
    stream = StuckStream()
    handler = BackgroundHandler(stream, longest_end_s=0)
    logger = logger_to(handler)
    logger.info("first")
    assert stream.stands.wait(60)
    for n in range(CAPACITY + 500):
        logger.info("line %d", n)
    handler.close()
    assert stream.written == [], "all that was before anything was written"
    stream.free.set()
    handler._longest_end_s = 60
    handler.close()
    assert stream.written[0] == "first\n"
    lines = stream.written[1].splitlines()
    assert lines[:CAPACITY] == [f"line {n}" for n in range(CAPACITY)]
    assert lines[CAPACITY:] == ["500 log lines were lost: they could not be written in time"]


@pytest.mark.parametrize(
    "error", [OSError(5, "Input/output error"), ValueError("I/O operation on closed file")]
)
def test_a_stream_that_fails_is_no_trouble(error: Exception) -> None:
    class Broken(io.StringIO):
        def write(self, text: str) -> int:
            raise error

    handler = BackgroundHandler(Broken())
    logger = logger_to(handler)
    logger.info("nobody reads this")
    logger.info("%d", "not a number")
    handler.close()
