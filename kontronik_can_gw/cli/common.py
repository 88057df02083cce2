"""What several commands share: from a configuration to a checked layout, and talk on standard error."""

import logging
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from kontronik_can_gw.config import Config, load
from kontronik_can_gw.dbc_output.layout import Layout, load_database
from kontronik_can_gw.dbc_output.prepare import check_load, prepare
from kontronik_can_gw.runtime.can_port import check_interface

if TYPE_CHECKING:
    from cantools.database.can import Database


def say(text: str) -> None:
    """One line of talk."""
    print(f"kontronik-can-gw: {text}", file=sys.stderr)


def load_all(path: Path) -> tuple[Config, "Database", Layout]:
    """The configuration, the exact database of what is sent, the layout. UserError with every mistake; warnings are said."""
    config = load(path)
    check_interface(config.can)
    database, layout = layout_of(config)
    for warning in (*layout.warnings, check_load(layout, config.can.bitrate, config.can.data_bitrate)):
        if warning:
            say(f"warning: {warning}")
    return config, database, layout


def layout_of(config: Config) -> tuple["Database", Layout]:
    """The database and layout that belong to a configuration."""
    file = config.dbc_path
    return prepare(load_database(file), str(file), config.escs, config.dbc_settings, config.can.fd)


def set_up_log(verbose: bool = False) -> None:
    """Log lines to standard error; under systemd without time, with the priorities that journald reads."""
    import os

    handler = logging.StreamHandler()
    if "JOURNAL_STREAM" in os.environ:
        handler.setFormatter(_JournalFormatter("%(message)s"))
    else:
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)-7s %(message)s"))
    logging.getLogger("can").addHandler(
        logging.NullHandler()
    )  # what python-can says is said again by us, with the remedy
    logger = logging.getLogger("kontronik_can_gw")
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG if verbose else logging.INFO)


class _JournalFormatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        level = 3 if record.levelno >= logging.ERROR else 4 if record.levelno >= logging.WARNING else 6
        return f"<{level}>{super().format(record)}"


@contextmanager
def stopping_on_signals(stop: Callable[[], None]) -> Iterator[None]:
    """SIGTERM and SIGINT call ``stop``, once more end the process at once."""

    def handler(_number: int, _frame: object) -> None:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)
        stop()

    numbers = (signal.SIGTERM, signal.SIGINT)
    before = [signal.signal(number, handler) for number in numbers]
    try:
        yield
    finally:
        for number, old in zip(numbers, before, strict=True):
            signal.signal(number, old)
