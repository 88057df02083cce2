"""The shipped DBCs are read alike by cantools, canmatrix, opendbc and asammdf, without an error or a warning."""

import logging
import random
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


def not_available(message: Message) -> dict[str, int]:
    return {
        s.name: 0 if s.is_flag or s.is_alive_counter else s.not_available for s in message.signals
    }


def error(message: Message) -> dict[str, int]:
    return {s.name: 0 if s.is_flag or s.is_alive_counter else s.error for s in message.signals}


def valid(message: Message, choice: random.Random, file: Path) -> dict[str, int]:
    """Raw values that the gateway may send: within the limits, of an enum one with a name."""
    tables = layout(file).tables
    raw = {}
    for signal in message.signals:
        low, high = int(signal.minimum / signal.factor), int(signal.maximum / signal.factor)
        named = [number for number in tables.get(signal.key, {}) if low <= number <= high]
        raw[signal.name] = (
            choice.choice(named) if named else choice.choice([low, high, choice.randint(low, high)])
        )
    return raw


def random_frames(message: Message) -> list[bytes]:
    """Any bytes whatever, and the two extremes; the same on each run."""
    choice = random.Random(message.id)
    size = message.dlc
    return [
        bytes(size),
        b"\xff" * size,
        *(choice.randbytes(size) for _ in range(FRAMES_PER_MESSAGE)),
    ]


# --- cantools -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cantools_database() -> Any:
    import cantools

    return cantools.database.load_file(SHIPPED, database_format="dbc", strict=True)


@BOTH
@pytest.mark.filterwarnings("error")
def test_cantools_loads_the_file_strictly_and_silently(
    file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    import cantools

    with caplog.at_level(logging.INFO):
        cantools.database.load_file(file, database_format="dbc", encoding="ascii", strict=True)
    assert caplog.records == []


@pytest.mark.parametrize(("text", "raw_of"), [("NotAvailable", not_available), ("Error", error)])
def test_cantools_names_the_two_codes(cantools_database: Any, text: str, raw_of: Any) -> None:
    for message in layout().messages:
        decoded = cantools_database.decode_message(message.id, frame(message, raw_of(message)))
        for signal in message.signals:
            expected = 0 if signal.is_flag or signal.is_alive_counter else text
            assert decoded[signal.name] == expected, signal.name


def test_cantools_starts_every_signal_not_available(cantools_database: Any) -> None:
    """The start value is raw: an initial value of 655.35 V would be a number, not a missing one."""
    for message in layout().messages:
        seen = cantools_database.get_message_by_frame_id(message.id)
        assert {signal.name: signal.raw_initial for signal in seen.signals} == not_available(
            message
        )
        initial = {signal.name: signal.initial for signal in seen.signals}
        assert seen.encode(initial, strict=False) == frame(message, not_available(message))


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
    canmatrix_matrix, db = matrix_of(file, caplog), layout(file)
    comments = dict(db.comments)
    assert [ecu.name for ecu in canmatrix_matrix.ecus] == db.nodes
    assert canmatrix_matrix.attributes == {
        "LayoutVersion": db.attribute("LayoutVersion"),
        "BusType": "CAN",
    }
    assert len(canmatrix_matrix.frames) == len(db.messages)
    for message, seen in zip(db.messages, canmatrix_matrix.frames, strict=True):
        assert (seen.name, seen.arbitration_id.id, seen.size) == (
            message.name,
            message.id,
            message.dlc,
        )
        assert (seen.arbitration_id.extended, seen.is_fd, seen.is_j1939, seen.is_multiplexed) == (
            False,
        ) * 4
        assert (seen.transmitters, seen.comment) == (
            [message.sender],
            comments[("BO_", message.id)],
        )
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


# --- opendbc --------------------------------------------------------------------------------------------------------


@BOTH
def test_opendbc_reads_every_signal_from_the_path_of_the_file(file: Path) -> None:
    """It takes a path where one exists, else the name of a packaged file. What it does not understand it skips."""
    from opendbc.can.dbc import DBC  # type: ignore[import-untyped]

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


@BOTH
def test_opendbc_reads_every_value_text(file: Path) -> None:
    """It splits texts at blanks and shouts: `Bus Off` would raise, `Ok` and `OK` would meet."""
    from opendbc.can import CANDefine  # type: ignore[import-untyped]

    db = layout(file)
    names = {message.id: message.name for message in db.messages}
    defined = CANDefine(str(file)).dv
    for (message_id, name), table in db.tables.items():
        assert defined[names[message_id]][name] == {
            number: text.upper() for number, text in table.items()
        }


# --- the same bits for all ------------------------------------------------------------------------------------------


@BOTH
def test_all_readers_find_the_same_raw_values_in_any_bytes(
    file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    import cantools
    from opendbc.can.dbc import DBC
    from opendbc.can.parser import get_raw_value  # type: ignore[import-untyped]

    opendbc, matrix = DBC(str(file)), matrix_of(file, caplog)
    database: Any = cantools.database.load_file(file)
    for message in layout(file).messages:
        matrix_frame = matrix.frame_by_name(message.name)
        for data in random_frames(message):
            expected = {signal.name: raw_value(signal, data) for signal in message.signals}
            assert (
                database.decode_message(message.id, data, decode_choices=False, scaling=False)
                == expected
            )
            assert {
                name: seen.raw_value for name, seen in matrix_frame.decode(data).items()
            } == expected
            for name, its in opendbc.msgs[message.id].sigs.items():
                raw = get_raw_value(data, its)
                raw -= (raw >> (its.size - 1) << its.size) if its.is_signed else 0
                assert raw == expected[name], name


# --- asammdf --------------------------------------------------------------------------------------------------------

CODES = ("NotAvailable", "Error")


def recorded(path: Path, file: Path, moments: list[dict[str, dict[str, int]]]) -> Any:
    """An MF4 of raw CAN frames, one of each message per moment and 0.1 s, decoded by asammdf with the DBC."""
    import can
    from asammdf import MDF

    with can.MF4Writer(path) as writer:
        for number, moment in enumerate(moments):
            for message in layout(file).messages:
                writer.on_message_received(
                    can.Message(
                        timestamp=1_700_000_000 + number / 10,
                        arbitration_id=message.id,
                        is_extended_id=False,
                        data=frame(message, moment[message.name]),
                    )
                )
    with MDF(path) as measurement:
        return measurement.extract_bus_logging({"CAN": [(str(file), 0)]})


@BOTH
def test_asammdf_gives_numbers_nan_and_names(tmp_path: Path, file: Path) -> None:
    import numpy as np

    choice = random.Random(2)
    db = layout(file)
    raw: list[dict[str, dict[str, int]]] = []
    for moment in range(30):
        raw.append({message.name: valid(message, choice, file) for message in db.messages})
        for (message_id, name), table in db.tables.items():
            codes = {text: number for number, text in table.items()}
            if moment < len(CODES) and CODES[moment] in codes:
                (owner,) = (message.name for message in db.messages if message.id == message_id)
                raw[moment][owner][name] = codes[CODES[moment]]
    decoded = recorded(tmp_path / "raw.mf4", file, raw)
    for message in db.messages:
        for signal in message.signals:
            seen = decoded.get(signal.name)
            sent = [moment[message.name][signal.name] for moment in raw]
            assert list(decoded.get(signal.name, raw=True).samples) == sent, signal.name
            assert seen.unit == signal.unit
            table = db.tables.get(signal.key, {})
            if set(table.values()) - set(CODES):
                assert [text.decode() for text in seen.samples] == [
                    table[number] for number in sent
                ]
            else:
                expected = [
                    float("nan") if number in table else float(number * signal.factor)
                    for number in sent
                ]
                np.testing.assert_allclose(
                    seen.samples.astype(float), expected, rtol=1e-12, err_msg=signal.name
                )
                assert (seen.samples.dtype.kind == "f") == bool(table), signal.name
    decoded.close()
