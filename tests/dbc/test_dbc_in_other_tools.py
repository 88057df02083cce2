"""The shipped DBCs are read alike by cantools, canmatrix, opendbc and asammdf, without an error or a warning."""

import logging
import math
import random
import sys
from pathlib import Path
from typing import Any

import pytest
from dbc_rules import Database, Message, Signal, parse

SHIPPED = Path(__file__).parents[2] / "dbc" / "kontronik_esc.dbc"
FRAMES_PER_MESSAGE = 100
BOTH = pytest.mark.parametrize(
    "file", [SHIPPED, SHIPPED.with_name("kontronik_canopen.dbc")], ids=lambda path: path.stem
)


def layout(file: Path = SHIPPED) -> Database:
    return parse(file.read_bytes())


def raw_value(signal: Signal, data: bytes) -> int:
    """The raw value of an Intel signal, from the definition of the format alone."""
    raw = int.from_bytes(data, "little") >> signal.start & ((1 << signal.length) - 1)
    return raw - (1 << signal.length) if signal.signed and raw >> (signal.length - 1) else raw


def frame(message: Message, raw: dict[str, int]) -> bytes:
    """The bytes of a message from raw values, the inverse of `raw_value`."""
    bits = 0
    for signal in message.signals:
        bits |= (raw[signal.name] & ((1 << signal.length) - 1)) << signal.start
    return bits.to_bytes(message.dlc, "little")


# --- cantools -------------------------------------------------------------------------------------------------------


@BOTH
@pytest.mark.filterwarnings("error")
def test_cantools_loads_the_file_strictly_and_silently(
    file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    import cantools

    with caplog.at_level(logging.INFO):
        cantools.database.load_file(file, database_format="dbc", encoding="ascii", strict=True)
    assert caplog.records == []


# --- canmatrix ------------------------------------------------------------------------------------------------------


def matrix_of(file: Path, caplog: pytest.LogCaptureFixture) -> Any:
    import canmatrix.formats  # type: ignore[import-untyped]

    with caplog.at_level(logging.WARNING):
        matrix = canmatrix.formats.loadp_flat(str(file))
    assert [record.getMessage() for record in caplog.records] == []
    assert matrix.load_errors == []
    return matrix


@BOTH
def test_canmatrix_sees_what_the_lines_say(file: Path, caplog: pytest.LogCaptureFixture) -> None:
    matrix, db = matrix_of(file, caplog), layout(file)
    comments = dict(db.comments)
    assert [ecu.name for ecu in matrix.ecus] == db.nodes
    assert matrix.attributes == {"LayoutVersion": db.attribute("LayoutVersion"), "BusType": "CAN"}
    for message, seen in zip(db.messages, matrix.frames, strict=True):
        place = (seen.name, seen.arbitration_id.id, seen.size, seen.transmitters, seen.comment)
        comment = comments[("BO_", message.id)]
        assert place == (message.name, message.id, message.dlc, [message.sender], comment)
        kinds = (seen.arbitration_id.extended, seen.is_fd, seen.is_j1939, seen.is_multiplexed)
        assert not any(kinds)
        assert seen.attributes["GenMsgSendType"] == db.send_type(message)
        assert seen.cycle_time == db.number("GenMsgCycleTime", message)
        for signal in message.signals:
            its = seen.signal_by_name(signal.name)
            assert not its.is_float
            assert (its.min, its.max) == (signal.minimum, signal.maximum)
            assert (its.unit, its.receivers) == (signal.unit, list(signal.receivers))
            assert its.comment == comments[("SG_", *signal.key)]
            assert its.values == db.tables.get(signal.key, {})
            start = int(db.attribute("GenSigStartValue", "SG_", *signal.key) or 0)
            assert its.initial_value == start * signal.factor


ON_OLDER_PYTHON = pytest.mark.skipif(
    sys.version_info >= (3, 13), reason="opendbc refuses Python 3.13: run it by an older one"
)


# --- opendbc --------------------------------------------------------------------------------------------------------


@ON_OLDER_PYTHON
@BOTH
def test_opendbc_reads_every_signal_from_the_path_of_the_file(file: Path) -> None:
    """It takes a path where one exists, else the name of a packaged file. What it does not understand it skips."""
    from opendbc.can.dbc import DBC

    db = layout(file)
    seen = DBC(str(file))
    assert {address: message.name for address, message in seen.msgs.items()} == {
        m.id: m.name for m in db.messages
    }
    for message in db.messages:
        signals = seen.msgs[message.id].sigs
        assert list(signals) == [signal.name for signal in message.signals]
        for signal in message.signals:
            its = signals[signal.name]
            assert (its.factor, its.offset, its.type) == (float(signal.factor), 0.0, 0)


# --- the same bits for all ------------------------------------------------------------------------------------------


@ON_OLDER_PYTHON
@BOTH
def test_all_readers_find_the_same_raw_values_in_any_bytes(
    file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    import cantools
    from opendbc.can.dbc import DBC
    from opendbc.can.parser import get_raw_value

    opendbc, matrix = DBC(str(file)), matrix_of(file, caplog)
    database: Any = cantools.database.load_file(file)
    choice = random.Random(1)
    for message in layout(file).messages:
        frames = [bytes(message.dlc), b"\xff" * message.dlc]
        for data in frames + [choice.randbytes(message.dlc) for _ in range(FRAMES_PER_MESSAGE)]:
            expected = {signal.name: raw_value(signal, data) for signal in message.signals}
            assert expected == database.decode_message(
                message.id, data, decode_choices=False, scaling=False
            )
            decoded = matrix.frame_by_name(message.name).decode(data)
            assert {name: seen.raw_value for name, seen in decoded.items()} == expected
            for name, its in opendbc.msgs[message.id].sigs.items():
                raw = get_raw_value(data, its)
                raw -= (raw >> (its.size - 1) << its.size) if its.is_signed else 0
                assert raw == expected[name], name


# --- asammdf --------------------------------------------------------------------------------------------------------

CODES = ("NotAvailable", "Error")


def recorded(path: Path, file: Path, moments: list[dict[str, int]]) -> Any:
    """An MF4 of raw CAN frames, one of each message per moment and 0.1 s, decoded by asammdf with the DBC."""
    import can
    from asammdf import MDF

    with can.MF4Writer(path) as writer:
        for number, moment in enumerate(moments):
            for message in layout(file).messages:
                at, data = 1_700_000_000 + number / 10, frame(message, moment)
                writer.on_message_received(
                    can.Message(at, arbitration_id=message.id, is_extended_id=False, data=data)
                )
    with MDF(path) as measurement:
        return measurement.extract_bus_logging({"CAN": [(str(file), 0)]})


@BOTH
def test_asammdf_gives_numbers_nan_and_names(tmp_path: Path, file: Path) -> None:
    """Of values that the gateway may send: within the limits, of an enum one with a name, and the two codes."""
    import numpy as np

    choice = random.Random(2)
    db = layout(file)
    raw: list[dict[str, int]] = [{} for _ in range(30)]
    for signal in db.signals:
        table = db.tables.get(signal.key, {})
        low, high = int(signal.minimum / signal.factor), int(signal.maximum / signal.factor)
        named = [number for number in table if low <= number <= high]
        codes = {text: number for number, text in table.items()}
        for moment, values in enumerate(raw):
            ends = named or [low, high, choice.randint(low, high)]
            code = CODES[moment] if moment < len(CODES) else ""
            values[signal.name] = codes.get(code, choice.choice(ends))
    decoded = recorded(tmp_path / "raw.mf4", file, raw)
    for signal in db.signals:
        seen, table = decoded.get(signal.name), db.tables.get(signal.key, {})
        sent = [moment[signal.name] for moment in raw]
        assert list(decoded.get(signal.name, raw=True).samples) == sent, signal.name
        assert seen.unit == signal.unit
        if db.named(signal):
            assert [text.decode() for text in seen.samples] == [table[number] for number in sent]
            continue
        expected = [math.nan if n in table else float(n * signal.factor) for n in sent]
        samples = seen.samples.astype(float)
        np.testing.assert_allclose(samples, expected, rtol=1e-12, err_msg=signal.name)
        assert (seen.samples.dtype.kind == "f") == bool(table), signal.name
    decoded.close()
