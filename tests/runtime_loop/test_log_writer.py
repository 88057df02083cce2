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
        self.free = threading.Event()
        self.told_loss = threading.Event()
        self.written: list[str] = []

    def write(self, text: str) -> int:
        self.free.wait(600)
        self.written.append(text)
        if "lost" in text:
            self.told_loss.set()
        return len(text)


def logger_to(handler: logging.Handler) -> logging.Logger:
    logger = logging.getLogger("a test's own")
    logger.setLevel(logging.INFO)
    logger.propagate = False
    logger.handlers.clear()
    logger.addHandler(handler)
    return logger


def test_lines_come_in_order_and_the_end_waits_for_them() -> None:
    stream = io.StringIO()
    handler = BackgroundHandler(stream)
    logger = logger_to(handler)
    for n in range(500):
        logger.info("line %d", n)
    handler.close()
    assert stream.getvalue().splitlines() == [f"line {n}" for n in range(500)]


def test_a_stream_that_stands_still_holds_nobody_up_and_losses_are_told() -> None:
    stream = StuckStream()
    handler = BackgroundHandler(stream, longest_end_s=0.05)
    logger = logger_to(handler)
    for n in range(2 * CAPACITY + 500):  # as many may be taken at once as may wait
        logger.info("line %d", n)
    handler.close()
    assert stream.written == [], "all this while it stood still"
    stream.free.set()
    assert stream.told_loss.wait(120)
    text = "".join(stream.written)
    assert "log lines were lost" in text
    assert "line 0\n" in text


@pytest.mark.parametrize("error", [OSError(5, "Input/output error"), ValueError("I/O operation on closed file")])
def test_a_stream_that_fails_is_no_trouble(error: Exception) -> None:
    class Broken(io.StringIO):
        def write(self, text: str) -> int:
            raise error

    handler = BackgroundHandler(Broken())
    logger = logger_to(handler)
    logger.info("nobody reads this")
    logger.info("%d", "not a number")
    handler.close()
