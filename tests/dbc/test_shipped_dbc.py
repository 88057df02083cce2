"""The shipped DBCs follow rules so that every tool reads them in the same way.

They are read by cantools, canmatrix, opendbc and asammdf.
"""

import logging
import math
import random
import sys
from decimal import Decimal
from functools import cache
from pathlib import Path
from typing import Any

import cantools.database
import pytest
import specification
from cantools.database.can import Database, Signal
from dbc_bench import check_comments
from packer_oracle import get, pascal, put
from specification.quantities import CAN_STATES, GATEWAY_STATES, LAYOUTS, LINKS

pytestmark = pytest.mark.promise("shipped-dbc")

FILES = sorted((Path(__file__).parents[2] / "dbc").glob("*.dbc"))
SHIPPED = next(file for file in FILES if file.stem == "kontronik_esc")
FRAMES_PER_MESSAGE = 100
BOTH = pytest.mark.parametrize("file", FILES, ids=lambda path: path.stem)
CODES = ("NotAvailable", "Error")
ENUMS = {
    "OperatingState": {
        number: text.replace("_", "").replace("RPM", "Rpm")
        for number, text in specification.OPERATING_STATES.items()
    },
    "Device": {1: "Kosmik", 2: "Kolibri", 3: "JivePro", 4: "KontrolX", 5: "Uhv"},
    "Layout": LAYOUTS,
    "LinkState": LINKS,
    "GatewayState": GATEWAY_STATES,
    "CanState": CAN_STATES,
}


@cache
def database_of(file: Path) -> Database:
    found = cantools.database.load_file(file, "dbc", "ascii", strict=True, sort_signals=None)
    assert isinstance(found, Database)
    return found


def signals_of(file: Path) -> list[Signal]:
    return [signal for message in database_of(file).messages for signal in message.signals]


def table_of(signal: Signal) -> dict[int, str]:
    found = {}
    for number, text in (signal.choices or {}).items():
        found[int(number)] = str(text)
    return found


def names_of(signal: Signal) -> dict[int, str]:
    """Return the texts of a signal's values, without the codes."""
    table = table_of(signal)
    return {number: text for number, text in table.items() if text not in CODES}


def exact(*numbers: Any) -> list[Decimal]:
    return [Decimal(str(number)) for number in numbers]


# --- the rules, and the protocol specification


def test_limits_leave_out_the_codes_and_contain_0() -> None:
    """Test [min|max] of all signals.

    It is the range of the type without the two codes. For an enumeration it is 0 to the greatest
    value that has a name. canmatrix checks the default start value, which is 0, against it.
    """
    for signal in signals_of(SHIPPED):
        if signal.length == 1 or signal.name.endswith("Alive"):  # flags and counters have no codes
            continue
        most = (1 << signal.length - signal.is_signed) - 1
        named = names_of(signal)
        if named:
            raw = (0, max(named))
        elif signal.is_signed:
            raw = (1 - most, most)
        else:
            raw = (0, most - 2)
        low, high = exact(signal.minimum, signal.maximum)
        factor, offset = exact(signal.scale, signal.offset)
        assert [low, high] == [number * factor + offset for number in raw], signal.name
        assert low <= 0 <= high, signal.name


def test_exactly_the_values_of_enumerations_have_names() -> None:
    """If a single sample has no name, asammdf shows the names of no sample."""
    named = [signal for signal in signals_of(SHIPPED) if names_of(signal)]
    assert {signal.name: names_of(signal) for signal in named} == ENUMS
    assert not any(s.is_signed or s.unit or s.scale != 1 for s in named)


@BOTH
def test_everything_has_a_comment(file: Path) -> None:
    check_comments(database_of(file))


FIELDS = [
    field
    for field in (*specification.LIVE_FIELDS, *specification.INFO_FIELDS)
    if not field.name.endswith(("_errors", "_state", "_variant", "_word"))
]


@pytest.mark.parametrize("field", FIELDS, ids=lambda field: field.name)
def test_signal_holds_every_step_of_its_field_in_the_sheet(field: specification.Field) -> None:
    name = pascal(field.name) + ("Percent" if field.unit == "%" else "")
    signals = {signal.name: signal for signal in signals_of(SHIPPED)}
    assert name in signals, f"add a signal to dbc/{SHIPPED.name}"
    found = signals[name]
    step = Decimal(1) / field.steps
    assert (found.unit or "") == field.unit.replace("µ", "u").replace("°", "deg")
    assert exact(found.scale, found.offset) == [step, Decimal(0)]
    codes = 2 if found.is_signed else 0
    low, high = specification.TYPE_RANGES[field.code]
    if field.code == "I":
        high = 1_000_000  # no motor turns faster
    without_codes = (low + codes, high - 2 + codes)
    low, high = specification.STATED_RANGES.get(field.name, without_codes)
    least, most = exact(found.minimum, found.maximum)
    assert least <= low * step
    assert high * step <= most


# --- other tools


@BOTH
@pytest.mark.filterwarnings("error")
def test_cantools_loads_the_file_strictly_and_silently(
    file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO):
        database_of.__wrapped__(file)
    assert caplog.records == []


def matrix_of(file: Path, caplog: pytest.LogCaptureFixture) -> Any:
    import canmatrix.formats  # type: ignore[import-untyped]

    with caplog.at_level(logging.WARNING):
        matrix = canmatrix.formats.loadp_flat(str(file))
    assert [record.getMessage() for record in caplog.records] == []
    assert matrix.load_errors == []
    return matrix


@BOTH
def test_canmatrix_and_cantools_read_the_same_content(
    file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    matrix = matrix_of(file, caplog)
    database = database_of(file)
    assert [ecu.name for ecu in matrix.ecus] == [node.name for node in database.nodes]
    attributes: Any = database.dbc
    version = attributes.attributes["LayoutVersion"].value
    assert matrix.attributes == {"LayoutVersion": version, "BusType": "CAN"}
    for message, seen in zip(database.messages, matrix.frames, strict=True):
        assert seen.name == message.name
        assert seen.arbitration_id.id == message.frame_id
        assert seen.size == message.length
        assert seen.transmitters == message.senders
        assert seen.comment == message.comment
        kinds = (seen.arbitration_id.extended, seen.is_fd, seen.is_j1939, seen.is_multiplexed)
        assert not any(kinds)
        assert seen.attributes["GenMsgSendType"] == message.send_type
        assert seen.cycle_time == (message.cycle_time or 0)
        for signal in message.signals:
            its = seen.signal_by_name(signal.name)
            assert not its.is_float
            assert [its.min, its.max] == exact(signal.minimum, signal.maximum)
            assert its.unit == (signal.unit or "")
            assert its.receivers == signal.receivers
            assert its.comment == signal.comment
            assert its.values == table_of(signal)
            assert its.initial_value == int(signal.raw_initial or 0) * exact(signal.scale)[0]


@pytest.mark.skipif(
    sys.version_info >= (3, 13), reason="opendbc refuses Python 3.13: run it by an older one"
)
@BOTH
def test_all_readers_decode_the_same_raw_values_from_any_bytes(
    file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Compare opendbc, canmatrix, cantools and our own code.

    opendbc skips all lines that it does not understand. If the path does not exist, it reads a
    packaged file of that name.
    """
    from opendbc.can.dbc import DBC
    from opendbc.can.parser import get_raw_value

    opendbc = DBC(str(file)).msgs
    matrix = matrix_of(file, caplog)
    database = database_of(file)
    choice = random.Random(1)
    names = {message.frame_id: message.name for message in database.messages}
    assert {number: found.name for number, found in opendbc.items()} == names
    for message in database.messages:
        theirs = opendbc[message.frame_id].sigs
        assert len(theirs) == len(message.signals)
        for signal in message.signals:
            its = theirs[signal.name]
            assert its.factor == float(signal.scale)
            assert its.offset == 0
            assert its.type == 0
        size = message.length
        fills = [choice.randbytes(size) for _ in range(FRAMES_PER_MESSAGE)]
        for data in (bytes(size), b"\xff" * size, *fills):
            expected = {}
            for signal in message.signals:
                raw = get(data, signal.start, signal.length, True, signal.is_signed)
                expected[signal.name] = raw
            assert expected == message.decode(data, decode_choices=False, scaling=False)
            decoded = matrix.frame_by_name(message.name).decode(data)
            assert {name: seen.raw_value for name, seen in decoded.items()} == expected
            for name, its in theirs.items():
                raw = get_raw_value(data, its)
                if its.is_signed:
                    sign = raw >> (its.size - 1)
                    raw -= sign << its.size
                assert raw == expected[name], name


def recorded(path: Path, file: Path, moments: list[dict[str, int]]) -> Any:
    """Write raw CAN frames into an MF4 file and return it decoded by asammdf with the DBC.

    The file has a frame of each message for each moment. A moment lasts 0.1 s.
    """
    import can
    from asammdf import MDF

    with can.MF4Writer(path) as writer:
        for number, moment in enumerate(moments):
            for message in database_of(file).messages:
                data = bytearray(message.length)
                for signal in message.signals:
                    put(data, moment[signal.name], signal.start, signal.length, True)
                frame = can.Message(
                    1_700_000_000 + number / 10,
                    arbitration_id=message.frame_id,
                    is_extended_id=False,
                    data=data,
                )
                writer.on_message_received(frame)
    with MDF(path) as measurement:
        return measurement.extract_bus_logging({"CAN": [(str(file), 0)]})


@BOTH
def test_asammdf_gives_numbers_nan_and_names(tmp_path: Path, file: Path) -> None:
    """Decode values that the gateway may send.

    These are values within the limits, values of enumerations that have a name, and the two codes.
    """
    import numpy as np

    choice = random.Random(2)
    raw: list[dict[str, int]] = [{} for _ in range(30)]
    for signal in signals_of(file):
        table = table_of(signal)
        low, high, factor = exact(signal.minimum, signal.maximum, signal.scale)
        least = int(low / factor)
        most = int(high / factor)
        named = [number for number in table if least <= number <= most]
        codes = {text: number for number, text in table.items()}
        for moment, values in enumerate(raw):
            ends = named or [least, most, choice.randint(least, most)]
            code = CODES[moment] if moment < len(CODES) else ""
            values[signal.name] = codes.get(code, choice.choice(ends))
    decoded = recorded(tmp_path / "raw.mf4", file, raw)
    for signal in signals_of(file):
        seen = decoded.get(signal.name)
        table = table_of(signal)
        sent = [moment[signal.name] for moment in raw]
        assert list(decoded.get(signal.name, raw=True).samples) == sent, signal.name
        assert seen.unit == (signal.unit or "")
        if names_of(signal):
            assert [text.decode() for text in seen.samples] == [table[number] for number in sent]
            continue
        expected = [math.nan if n in table else n * float(signal.scale) for n in sent]
        samples = seen.samples.astype(float)
        np.testing.assert_allclose(samples, expected, rtol=1e-12, err_msg=signal.name)
        assert (seen.samples.dtype.kind == "f") == bool(table), signal.name
    decoded.close()
