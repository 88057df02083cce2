"""The shipped DBCs are read alike by cantools, canmatrix, opendbc and asammdf, without an error or a warning."""

import logging
import math
import random
import sys
from pathlib import Path
from typing import Any

import pytest
from dbc_rules import parse
from packer_oracle import get, put, read

FILES = sorted((Path(__file__).parents[2] / "dbc").glob("*.dbc"))
FRAMES_PER_MESSAGE = 100
BOTH = pytest.mark.parametrize("file", FILES, ids=lambda path: path.stem)


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
    matrix, db = matrix_of(file, caplog), parse(file.read_bytes())
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


# --- the same bits for all ------------------------------------------------------------------------------------------


@pytest.mark.skipif(
    sys.version_info >= (3, 13), reason="opendbc refuses Python 3.13: run it by an older one"
)
@BOTH
def test_all_readers_find_the_same_raw_values_in_any_bytes(
    file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """opendbc takes a path where one exists, else the name of a packaged file, and skips what it does not understand."""
    from opendbc.can.dbc import DBC
    from opendbc.can.parser import get_raw_value

    opendbc, matrix = DBC(str(file)).msgs, matrix_of(file, caplog)
    database = read(file.read_text())
    choice = random.Random(1)
    messages = parse(file.read_bytes()).messages
    assert {number: found.name for number, found in opendbc.items()} == {
        message.id: message.name for message in messages
    }
    for message in messages:
        theirs = opendbc[message.id].sigs
        scales = {s.name: (float(s.factor), 0.0, 0) for s in message.signals}
        assert {name: (s.factor, s.offset, s.type) for name, s in theirs.items()} == scales
        frames = [bytes(message.dlc), b"\xff" * message.dlc]
        for data in frames + [choice.randbytes(message.dlc) for _ in range(FRAMES_PER_MESSAGE)]:
            expected = {
                s.name: get(data, s.start, s.length, True, s.signed) for s in message.signals
            }
            assert expected == database.decode_message(
                message.id, data, decode_choices=False, scaling=False
            )
            decoded = matrix.frame_by_name(message.name).decode(data)
            assert {name: seen.raw_value for name, seen in decoded.items()} == expected
            for name, its in theirs.items():
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
            for message in parse(file.read_bytes()).messages:
                at, data = 1_700_000_000 + number / 10, bytearray(message.dlc)
                for signal in message.signals:
                    put(data, moment[signal.name], signal.start, signal.length, True)
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
    db = parse(file.read_bytes())
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
