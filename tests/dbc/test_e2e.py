"""AUTOSAR end-to-end protection: profiles, their statement in configuration and DBC, sent frames.

The oracles are the packages autosar-e2e (profiles 1, 2, 5 and 11) and cantools (2 and 5), and the
protocol examples of AUTOSAR_PRS_E2EProtocol.
"""

import json
import random
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import pytest
from cantools import autosar
from dbc_bench import compiled, refused
from e2e import p02
from e2e_oracle import COUNTER_BITS, DATA_IDS, IDS_OF_2, SINGLE_ID, counter_of, is_right
from hypothesis import given
from hypothesis import strategies as st
from packer_oracle import Msg, Sig, dbc_text, get, read

from kontronik_can_gw.assembly.capture_setup import CaptureSetup
from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.dbc import e2e_attributes
from kontronik_can_gw.dbc.expand import copies_of
from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.desk.dbc.writer import copies_text
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.gateway.transmit_queue import TransmitQueue
from kontronik_can_gw.signals.e2e import PROFILES, DataIdMode, Profile, Protection
from kontronik_can_gw.signals.plan import MessageLayout, Role
from kontronik_can_gw.times import MS

pytestmark = pytest.mark.promise("e2e")

FIRST_16 = tuple(range(1, 17))
"""The list of data IDs in the examples of the specification."""


def protection(name: str, *data_ids: int) -> Protection:
    return Protection(PROFILES[name], data_ids)


# --- CRCs


@pytest.mark.parametrize(
    ("protected", "at", "frames"),
    [
        (protection("11A", 0x123), 0, ["cc00000000000000", "9101000000000000"]),
        (protection("11C", 0x123), 0, ["2a10000000000000", "7711000000000000"]),
        (protection("11C", 0x123), 8, ["00000000000000007d10000000000000"]),
        (protection("5", 0x1234), 0, ["1cca000000000000"]),
        (protection("5", 0x1234), 8, ["00000000000000002891000000000000"]),
        (protection("22", *FIRST_16), 8, ["00000000000000001401000000000000"]),
        (
            protection("22", *FIRST_16),
            0,
            [
                f"{crc:02x}{(number + 1) % 16:02x}000000000000"
                for number, crc in enumerate(bytes.fromhex("1b98310d189b65081d9e370b1e9dcd0e"))
            ],
        ),
    ],
)
def test_examples_of_the_specification_are_reproduced(
    protected: Protection, at: int, frames: Sequence[str]
) -> None:
    for text in frames:
        frame = bytes.fromhex(text)
        counter = frame[at + protected.profile.crc_bytes] & 0xF
        assert protected.insert_crc(frame, at, counter) == frame


@given(st.binary(min_size=3, max_size=64), st.integers(0, 0xFFFF), st.data())
@pytest.mark.parametrize("name", SINGLE_ID)
def test_crc_equals_the_one_of_the_autosar_package_at_every_place(
    name: str, data: bytes, data_id: int, draw: st.DataObject
) -> None:
    profile = PROFILES[name]
    at = draw.draw(st.integers(0, len(data) - profile.crc_bytes - 1))
    data_id &= profile.largest_id
    counter = draw.draw(st.integers(0, profile.counters - 1))
    frame = bytearray(data)
    frame[at + profile.crc_bytes] = counter
    expected = bytearray(frame)
    SINGLE_ID[name](expected, data_id, offset=at, increment_counter=False)
    if name.endswith("C"):
        frame[at + 1] |= protection(name, data_id).nibble << 4
    assert protection(name, data_id).insert_crc(bytes(frame), at, counter) == expected
    if name == "5" and at == 0 and len(data) >= 4:
        assert autosar.apply_profile5_crc(bytes(frame), data_id) == expected


@given(st.binary(min_size=2, max_size=64), st.binary(min_size=16, max_size=16))
@pytest.mark.parametrize("name", ["2", "22"])
def test_crc_with_a_list_of_data_ids_equals_the_one_of_both_packages(
    name: str, data: bytes, data_ids: bytes
) -> None:
    expected = bytearray(data)
    p02.e2e_p02_protect(expected, data_ids, increment_counter=False)
    counter = data[1] & 0xF
    assert protection(name, *data_ids).insert_crc(data, 0, counter) == expected
    assert autosar.apply_profile2_crc(data, data_ids[counter]) == expected


# --- sent frames

LIVE = LiveData(electrical_speed=70_000, battery_voltage=4442)


def layout_of(name: str, bytes_: int = 8, **settings: Any) -> MessageLayout:
    """Return a layout with a message M that a profile protects. It is sent by event."""
    profile = PROFILES[name]
    counter_at = profile.crc_bits
    signals = [
        Sig("M_CRC", 0, profile.crc_bits),
        Sig("M_BZ", counter_at, COUNTER_BITS.get(name, 4)),
        Sig("BatteryVoltage", 24, 16, unit="V", factor="0.01"),
    ]
    if name.endswith("C"):
        signals.append(Sig("M_DataIDNibble", counter_at + 4, 4))
    settings |= {"e2e": {"M": name}, "e2e_data_ids": {"M": DATA_IDS[name]}}
    return compiled(dbc_text([Msg("M", 0x123, bytes_, signals)]), **settings)


class Sender:
    """A gateway with one ESC, and all frames that it has sent."""

    def __init__(self, layout: MessageLayout, start: int = 0) -> None:
        self.gateway = Gateway(CoreSettings([EscSettings("esc1", 7)], layout), start)
        self.gateway.start(start)
        self.now = start
        self.sent: list[CanFrame] = self.gateway.take_frames(start)

    def send(self, voltage: int) -> list[CanFrame]:
        """Receive telemetry 10 ms later, and return the frames that it causes."""
        self.now += 10 * MS
        self.gateway.advance(self.now)
        frames = self.gateway.take_frames(self.now)
        wire = encode(LIVE._replace(battery_voltage=voltage), WireLayout.V4)
        self.gateway.receive_bytes(0, wire, self.now, self.now)
        frames += self.gateway.take_frames(self.now)
        self.sent += frames
        return frames


@pytest.mark.parametrize("core_language", ["C", "Python"], indirect=True)
@pytest.mark.parametrize("bytes_", [8, 64])
@pytest.mark.parametrize("name", PROFILES)
def test_sent_frames_are_right_over_losses_of_telemetry(
    core_language: str, name: str, bytes_: int
) -> None:
    sender = Sender(layout_of(name, bytes_))
    assert sender.gateway.core.language == core_language
    for number in range(600):
        if number % 100 == 50:
            sender.now += 700 * MS  # the telemetry is lost
        sender.send(number)
    frames = [frame.data for frame in sender.sent]
    assert len(frames) >= 600
    assert all(is_right(name, data) for data in frames)
    counters = [counter_of(name, data) for data in frames]
    assert counters == [number % PROFILES[name].counters for number in range(len(frames))]


@pytest.mark.parametrize("core_language", ["C", "Python"], indirect=True)
def test_counters_and_crcs_of_100_000_frames_are_right(core_language: str) -> None:
    """Each profile, over four restarts of the gateway and losses of telemetry."""
    total = 0
    for name, profile in PROFILES.items():
        layout = layout_of(name)
        now = 0
        for _start in range(5):
            sender = Sender(layout, now)
            for number in range(2_500):
                if number % 500 == 250:
                    sender.now += 700 * MS  # the telemetry is lost
                sender.send(number)
            now = sender.now
            total += len(sender.sent)
            for number, frame in enumerate(sender.sent):
                assert counter_of(name, frame.data) == number % profile.counters
                assert is_right(name, frame.data)
    assert total >= 100_000


@pytest.mark.parametrize("core_language", ["C", "Python"], indirect=True)
@pytest.mark.parametrize("name", ["2", "5", "11C", "22"])
def test_busy_bus_loses_frames_but_never_changes_their_order(core_language: str, name: str) -> None:
    chance = random.Random(name + core_language)
    sender = Sender(layout_of(name))
    queue = TransmitQueue()
    queue.put_all(sender.sent)
    on_bus: list[CanFrame] = []
    for number in range(3_000):
        queue.put_all(sender.send(number))
        if chance.random() < 0.7:
            on_bus += queue.take_all()
    on_bus += queue.take_all()
    counters = PROFILES[name].counters
    assert all(is_right(name, frame.data) for frame in on_bus)
    steps = [
        (counter_of(name, frame.data) - counter_of(name, before.data)) % counters
        for before, frame in pairwise(on_bus)
    ]
    assert min(steps) == 1
    skipped_first = counter_of(name, on_bus[0].data)
    assert skipped_first + sum(steps) == len(on_bus) - 1 + queue.counters.replaced_frames
    assert queue.counters.replaced_frames > 500


def multiplexed() -> MessageLayout:
    """Return a layout with a message of three groups that profile 2 protects."""
    signals = [
        Sig("M_CRC", 0, 8),
        Sig("M_BZ", 8, 4),
        Sig("Page", 16, 8, mux="M"),
        Sig("BatteryVoltage", 24, 16, unit="V", factor="0.01", mux="m0"),
        Sig("ElectricalSpeed", 24, 32, unit="1/min", mux="m1"),
        Sig("Throttle", 24, 8, signed=True, unit="%", mux="m2"),
    ]
    text = dbc_text([Msg("M", 0x123, 8, signals)])
    return compiled(text, e2e={"M": "2"}, e2e_data_ids={"M": IDS_OF_2})


def test_frames_of_a_multiplexed_message_share_one_counter() -> None:
    sender = Sender(multiplexed())
    for number in range(100):
        sender.send(number)
    assert {frame.data[2] for frame in sender.sent} == {0, 1, 2}
    for number, frame in enumerate(sender.sent):
        assert counter_of("2", frame.data) == number % 16
        assert is_right("2", frame.data)


def test_counter_of_a_multiplexed_message_never_runs_backward_on_a_busy_bus() -> None:
    chance = random.Random(0)
    sender = Sender(multiplexed())
    queue = TransmitQueue()
    queue.put_all(sender.sent)
    on_bus: list[CanFrame] = []
    for number in range(3_000):
        queue.put_all(sender.send(number))
        frames = queue.in_order()
        count = chance.choice((0, 0, 0, 1, len(frames)))
        on_bus += frames[:count]
        queue.remove(frames, min(count, len(frames)))
    made = {id(frame): number for number, frame in enumerate(sender.sent)}
    numbers = [made[id(frame)] for frame in on_bus]
    assert queue.counters.replaced_frames > 100
    assert numbers == sorted(numbers)
    assert [counter_of("2", frame.data) for frame in on_bus] == [n % 16 for n in numbers]


# --- statements of the configuration

MESSAGES = [
    Msg(name, 0x100 + number, 8, [Sig("M_CRC", 0, 8), Sig("M_BZ", 8, 4)])
    for number, name in enumerate(("Motor_1", "Motor_2", "Other"))
]


NO_PROFILE = Profile("", 0, 8, 0, 0, 0, DataIdMode.BOTH)


def profiles_of(layout: MessageLayout) -> list[str]:
    return [getattr(plan.e2e, "profile", NO_PROFILE).name for plan in layout.messages]


def test_profile_is_named_by_message_or_pattern_and_an_exact_name_wins() -> None:
    ids = {"Motor_1": FIRST_16, "Motor_2": 7, "Other": FIRST_16}
    e2e = {"Motor_*": "2", "Motor_2": "11A", "O*": "22"}
    layout = compiled(dbc_text(MESSAGES), e2e=e2e, e2e_data_ids=ids)
    assert profiles_of(layout) == ["2", "11A", "22"]
    e2e = {"*": "22", "Motor_*": "2", "Motor_2": "11A"}  # the first pattern that matches applies
    others = compiled(dbc_text(MESSAGES), e2e=e2e, e2e_data_ids=ids)
    assert profiles_of(others) == ["22", "11A", "22"]
    assert not [line for line in layout.warnings if "E2E" in line]


def test_data_id_alone_means_profile_1_and_a_pattern_needs_no_data_id_for_it() -> None:
    layout = compiled(
        dbc_text(MESSAGES), e2e={"O*": "1A"}, e2e_data_ids=dict.fromkeys(("Motor_1", "Motor_2"), 5)
    )
    assert profiles_of(layout) == ["1A", "1A", "1A"]
    assert [plan.e2e.data_ids for plan in layout.messages if plan.e2e] == [(5,), (5,), (0x102,)]


@pytest.mark.parametrize(
    ("name", "data_ids", "text"),
    [
        ("2", None, "needs 16 data IDs, one for each counter; it has none"),
        ("2", 5, "needs 16 data IDs, one for each counter; it has 1"),
        ("2", (256, *range(15)), "data ID 0x100 is too large for E2E profile 2, at most 0xFF"),
        ("5", None, "needs one data ID; it has none"),
        ("5", FIRST_16, "needs one data ID; it has 16"),
        ("11C", 0x1000, "data ID 0x1000 is too large for E2E profile 11C, at most 0xFFF"),
        ("1B", None, "needs one data ID; it has none"),
    ],
)
def test_missing_or_unfit_data_id_is_refused(
    name: str, data_ids: int | tuple[int, ...] | None, text: str
) -> None:
    ids = {} if data_ids is None else {"M": data_ids}
    lines = refused(layout_text(name), e2e={"M": name}, e2e_data_ids=ids)
    assert text in lines[0]
    assert "dbc.e2e_data_ids.M = " in lines[0]


def layout_text(name: str, **changes: Sig | None) -> str:
    """Return a DBC with a message M for a profile. None leaves a signal out."""
    bits = PROFILES[name].crc_bits
    signals: dict[str, Sig | None] = {
        "crc": Sig("M_CRC", 0, bits),
        "counter": Sig("M_BZ", bits, COUNTER_BITS.get(name, 4)),
    }
    if name.endswith("C"):
        signals["nibble"] = Sig("M_DataIDNibble", bits + 4, 4)
    chosen = [signal for signal in (signals | changes).values() if signal is not None]
    return dbc_text([Msg("M", 0x123, 8, chosen)])


@pytest.mark.parametrize(
    ("name", "changes", "text"),
    [
        ("2", {"crc": Sig("M_CRC", 16, 8)}, "is in byte 0, not in byte 2. Profile 22 allows any"),
        (
            "2",
            {"counter": Sig("M_BZ", 12, 4)},
            "bits 0 to 3 of the byte after the CRC, here byte 1",
        ),
        ("2", {"counter": Sig("M_BZ", 8, 8)}, "bits 0 to 3 of the byte after the CRC"),
        ("2", {"counter": Sig("M_BZ", 8, 4, maximum="14")}, "one alive counter, 0 to 15"),
        ("2", {"counter": None}, "one alive counter, 0 to 15"),
        ("22", {"crc": Sig("M_CRC", 16, 8)}, "here byte 3"),
        ("5", {"crc": Sig("M_CRC", 0, 8)}, "needs 16 bits on a byte border, the low byte first"),
        ("5", {"crc": Sig("M_CRC", 7, 16, little=False)}, "the low byte first"),
        ("5", {"counter": Sig("M_BZ", 16, 4)}, "one alive counter, 0 to 255"),
        (
            "5",
            {"counter": Sig("M_BZ", 24, 8)},
            "bits 0 to 7 of the byte after the CRC, here byte 2",
        ),
        ("11A", {"counter": Sig("M_BZ", 8, 3)}, "one alive counter, 0 to 14"),
        ("11A", {"crc": Sig("M_CRC", 20, 8)}, "needs 8 bits on a byte border"),
        ("11C", {"nibble": None}, 'dbc.bind.SIGNAL = "data_id"'),
        ("11C", {"nibble": Sig("M_DataIDNibble", 16, 8)}, "has to be 4 bits of every frame"),
    ],
)
def test_message_whose_signals_do_not_fit_the_profile_is_refused(
    name: str, changes: dict[str, Sig | None], text: str
) -> None:
    settings: dict[str, Any] = {"e2e": {"M": name}, "e2e_data_ids": {"M": DATA_IDS[name]}}
    assert compiled(layout_text(name), **settings)
    lines = refused(layout_text(name, **changes), **settings)
    assert any(text in line for line in lines), lines


def test_profile_22_may_be_anywhere_and_the_nibble_is_bound_by_any_name() -> None:
    moved = {"crc": Sig("M_CRC", 40, 8), "counter": Sig("M_BZ", 48, 4)}
    text = layout_text("22", **moved)
    assert compiled(text, e2e={"M": "22"}, e2e_data_ids={"M": FIRST_16})
    odd = layout_text("11C", nibble=Sig("Res", 12, 4))
    settings: dict[str, Any] = {"e2e": {"M": "11C"}, "e2e_data_ids": {"M": 0x523}}
    layout = compiled(odd, bind={"Res": "data_id"}, **settings)
    signal = layout.messages[0].signals[-1]
    assert signal.role is Role.DATA_ID
    assert signal.constant == 5


def test_profile_of_no_protected_message_is_refused_with_the_nearest_name() -> None:
    text = dbc_text([*MESSAGES, Msg("Plain", 0x200, 8, [Sig("BatteryVoltage", 0, 16, unit="V")])])
    ids = dict.fromkeys(("Motor_1", "Motor_2", "Other"), 1)
    lines = refused(text, e2e={"Plain": "1A", "Othr": "5"}, e2e_data_ids=ids)
    assert [line.split(":")[0] for line in lines] == ["dbc.e2e.Othr", "dbc.e2e.Plain"]
    assert "Did you mean Other?" in lines[0]


def test_checksum_of_an_unstated_kind_is_refused_and_names_the_keys() -> None:
    lines = refused(dbc_text(MESSAGES))
    assert len(lines) == 3
    assert 'dbc.e2e.Motor_1 = "2"' in lines[0]
    assert "dbc.e2e_data_ids.Motor_1 = 0x100" in lines[0]


def test_capture_keeps_profiles_and_data_ids() -> None:
    settings = DbcConfig(e2e={"M": "2"}, e2e_data_ids={"M": IDS_OF_2})
    setup = CaptureSetup((EscSettings(),), ("-",), ("my.dbc", b""), settings, False)
    header = json.loads(json.dumps(setup.header()))
    assert CaptureSetup.of(header).dbc_settings == settings


# --- statements of the DBC


@pytest.mark.parametrize(
    ("name", "profile", "data_id", "e2e", "sent_now", "sent_by_0_5_0"),
    [
        ("DataID", "P01", 7, {}, 7, 0x123),
        ("E2EIdentifier", "P01", 7, {}, 0x123, 0x123),
        ("E2EDataId", "P01", 7, {}, 7, 7),
        ("E2EDataId", None, 7, {}, 7, 0x123),
        ("E2EDataId", None, 7, {"M": "1A"}, 7, 7),
        ("DataId", None, 7, {"*": "1A"}, 7, 0x123),
    ],
)
@pytest.mark.parametrize("owner", ["BO_ 291", "SG_ 291 M_CRC"])
def test_capture_replays_with_the_data_id_that_was_sent(
    name: str,
    profile: str | None,
    data_id: int,
    e2e: dict[str, str],
    sent_now: int,
    sent_by_0_5_0: int,
    owner: str,
) -> None:
    """0.5.0 ignored data IDs of unusual attributes, and of messages without a profile."""
    text = layout_text("1A") + attributes(profile, data_id, owner).replace("E2EDataId", name)
    dbc = ("my.dbc", text.encode())
    settings = DbcConfig(e2e=e2e, bind={"M_CRC": "crc"})
    setup = CaptureSetup((EscSettings(),), ("-",), dbc, settings, False)

    def sent(header: dict[str, Any]) -> tuple[int, ...]:
        found = CaptureSetup.of(header).database()
        assert found is not None
        (plan,) = found[1].messages
        assert plan.e2e is not None
        return plan.e2e.data_ids

    def written(setup: CaptureSetup) -> dict[str, Any]:
        header: dict[str, Any] = json.loads(json.dumps(setup.header()))
        return header

    header = written(setup)
    assert sent(header) == (sent_now,)
    assert sent(written(CaptureSetup.of(header))) == (sent_now,)
    del header["dbc"]["likely_data_ids"]
    assert sent(header) == (sent_by_0_5_0,)
    assert sent(written(CaptureSetup.of(header))) == (sent_by_0_5_0,)


def attributes(profile: str | None, data_id: object, owner: str = "BO_ 291") -> str:
    """Return attributes as OEMs write them, of a message or of a signal."""
    kind = owner.split()[0]
    id_type, default = "STRING", '""'
    if isinstance(data_id, int):
        id_type, default = "INT 0 65535", "0"
    text = f'BA_DEF_ {kind} "E2EProfile" STRING;\nBA_DEF_ {kind} "E2EDataId" {id_type};\n'
    text += f'BA_DEF_DEF_ "E2EProfile" "none";\nBA_DEF_DEF_ "E2EDataId" {default};\n'
    if profile is not None:
        text += f'BA_ "E2EProfile" {owner} "{profile}";\n'
    if data_id is not None:
        value = data_id if isinstance(data_id, int) else f'"{data_id}"'
        text += f'BA_ "E2EDataId" {owner} {value};\n'
    return text


LIST = "1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 0xB, 0x0C, 13, 14, 15, 16"


@pytest.mark.parametrize(
    ("spelling", "name"),
    [
        ("P01", "1A"),
        ("PROFILE_01", "1A"),
        ("autosar_p01", "1A"),
        ("PROFILE_AR_01A", "1A"),
        ("E2E_P01B", "1B"),
        ("P02", "2"),
        ("PROFILE_02", "2"),
        ("E2E Profile 2", "2"),
        ("2", "2"),
        ("Profile05", "5"),
        ("E2EP11A", "11A"),
        ("P11C", "11C"),
        ("PROFILE_22", "22"),
    ],
)
@pytest.mark.parametrize("owner", ["BO_ 291", "SG_ 291 M_CRC"])
def test_profile_is_recognised_by_the_attributes_of_oems(
    spelling: str, name: str, owner: str
) -> None:
    data_id: object = LIST if name in ("2", "22") else 0x123
    layout = compiled(layout_text(name) + attributes(spelling, data_id, owner))
    (plan,) = layout.messages
    assert plan.e2e is not None
    assert plan.e2e.profile.name == name
    assert plan.e2e.data_ids == (FIRST_16 if data_id == LIST else (0x123,))
    assert not [line for line in layout.warnings if "E2E" in line]


@pytest.mark.parametrize("text", [f"[{LIST}]", LIST.replace(",", ";"), LIST.replace(",", "")])
def test_list_of_data_ids_is_read_in_its_usual_forms(text: str) -> None:
    named = attributes("P02", text).replace("E2EDataId", "DataIds")
    (plan,) = compiled(layout_text("2") + named).messages
    assert plan.e2e is not None
    assert plan.e2e.data_ids == FIRST_16


@pytest.mark.parametrize(
    ("profile", "data_id", "text"),
    [
        ("P04", 5, "E2EProfile is 'P04', which is none of the profiles 1A, 1B"),
        ("P11", 5, "E2EProfile is 'P11', which is none of the profiles"),
        ("crc8_j1850", 5, "E2EProfile is 'crc8_j1850', which is none"),
        ("P02", 5, "needs 16 data IDs, one for each counter; it has 1"),
        ("P02", "1, 2, x", "E2EDataId is '1, 2, x', which is no list of numbers"),
        ("P05", None, "needs one data ID; it has none"),
    ],
)
def test_unclear_attribute_is_refused(profile: str, data_id: object, text: str) -> None:
    lines = refused(layout_text("2") + attributes(profile, data_id))
    assert any(text in line for line in lines), lines


def test_configuration_has_priority_over_the_attributes() -> None:
    text = layout_text("2") + attributes("P04", 5)
    layout = compiled(text, e2e={"M": "2"}, e2e_data_ids={"M": FIRST_16})
    assert profiles_of(layout) == ["2"]
    of_dbc = layout_text("2") + attributes("P02", LIST)
    (plan,) = compiled(of_dbc, e2e_data_ids={"M": IDS_OF_2}).messages
    assert plan.e2e == protection("2", *IDS_OF_2)


def test_default_profile_needs_a_data_id_of_the_message() -> None:
    text = layout_text("2").replace("M_CRC", "M_Check").replace("M_BZ", "M_Number")
    bind: dict[str, str | float] = {"M_Check": "crc", "M_Number": "alive"}
    default = attributes(None, LIST).replace('"none"', '"P02"')
    assert profiles_of(compiled(text + default, bind=bind)) == ["2"]
    without = attributes(None, None).replace('"none"', '"P02"')
    assert profiles_of(compiled(text + without, bind=bind)) == ["1A"]  # bound to "crc"


@pytest.mark.parametrize("bits", [0, 64, 56])
def test_only_a_message_that_is_protected_as_a_whole_is_sent(bits: int) -> None:
    text = layout_text("2") + attributes("P02", LIST)
    text += f'BA_DEF_ BO_ "E2EDataLength" INT 0 65535;\nBA_ "E2EDataLength" BO_ 291 {bits};\n'
    if bits != 56:
        assert profiles_of(compiled(text)) == ["2"]
        return
    (line,) = [line for line in refused(text) if "E2EDataLength" in line]
    assert "is 56 bits of 64" in line


def test_protected_message_without_a_known_crc_is_refused_unless_it_is_a_constant() -> None:
    text = layout_text("2").replace("M_CRC", "M_Check") + attributes("P02", LIST)
    lines = refused(text, unbound="start_value")
    assert any('dbc.bind.SIGNAL = "crc"' in line for line in lines)
    assert profiles_of(compiled(text, bind={"M_Check": "crc"})) == ["2"]
    assert profiles_of(compiled(text, bind={"M_Check": 0})) == [""]


def test_data_id_of_the_dbc_is_not_used_for_copies_for_several_escs() -> None:
    text = layout_text("5", value=Sig("BatteryVoltage", 32, 16, unit="V"))
    text += attributes("P05", 0x123)
    lines = refused(text, ("left", "right"))
    assert "dbc.e2e_data_ids.LeftM = 0x123" in lines[0]
    ids = {"LeftM": 1, "RightM": 2}
    layout = compiled(text, ("left", "right"), e2e_data_ids=ids)
    assert [plan.e2e for plan in layout.messages] == [protection("5", 1), protection("5", 2)]
    both = compiled(text, ("left", "right"), e2e={"M": "5"}, e2e_data_ids=ids)
    assert [plan.e2e for plan in both.messages] == [protection("5", 1), protection("5", 2)]


@pytest.mark.parametrize("owner", ["BO_ 291", "SG_ 291 M_CRC"])
@pytest.mark.parametrize(
    ("name", "stated", "ids"),
    [
        ("5", 0x123, (1, 2)),
        ("5", "0x123", (1, 2)),
        ("2", LIST, (IDS_OF_2, FIRST_16)),
    ],
)
def test_dbc_for_several_escs_states_the_data_ids_that_are_sent(
    name: str,
    stated: object,
    ids: tuple[Any, Any],
    owner: str,
) -> None:
    value = Sig("BatteryVoltage", 32, 16, unit="V")
    text = layout_text(name, value=value) + attributes(f"P0{name}", stated, owner)
    settings = DbcConfig(e2e_data_ids=dict(zip(("LeftM", "RightM"), ids, strict=True)))
    plain = read(text)
    escs = [EscSettings("left"), EscSettings("right")]
    layout = prepare(plain, "my.dbc", escs, settings)
    written = read(
        copies_text(plain, copies_of(plain, "my.dbc", escs, settings), data_ids=layout.data_ids)
    )
    found = [e2e_attributes.data_ids_of(message, written) for message in written.messages]
    assert found == [plan.e2e.data_ids for plan in layout.messages if plan.e2e]
    assert found == [each if isinstance(each, tuple) else (each,) for each in ids]


FUNCTIONS = {
    'ENUM "NoFunction","SNC","CRC"': ("1", "2"),
    'ENUM "CHKSM","CNTR"': ("1", "0"),
    "INT 0 10": ("1", "2"),
    "STRING": ('"SequenceCounter"', '"Checksum"'),
}


@pytest.mark.parametrize("definition", FUNCTIONS)
def test_counter_and_crc_are_recognised_by_the_function_type_of_a_signal(definition: str) -> None:
    text = layout_text("2").replace("M_CRC", "M_Prot").replace("M_BZ", "M_Seq")
    counter, crc = FUNCTIONS[definition]
    text += f'BA_DEF_ SG_ "GenSigFuncType" {definition};\n' + attributes("P02", LIST)
    text += f'BA_ "GenSigFuncType" SG_ 291 M_Seq {counter};\n'
    text += f'BA_ "GenSigFuncType" SG_ 291 M_Prot {crc};\n'
    (plan,) = compiled(text).messages
    assert {signal.name: signal.role for signal in plan.signals} == {
        "M_Prot": Role.CRC,
        "M_Seq": Role.ALIVE,
    }
    assert get(bytes(8), 0, 8, True) == 0


# --- statements that are incomplete, unusual or contradictory


def e2e_warnings(layout: MessageLayout) -> list[str]:
    return [line for line in layout.warnings if "data ID" in line or "E2E" in line]


@pytest.mark.parametrize("name", ["DataID", "DataId", "E2EId", "E2EDataIdentifier"])
def test_data_id_with_an_unusual_name_is_used_with_a_warning(name: str) -> None:
    text = layout_text("1A") + attributes("P01", 7).replace("E2EDataId", name)
    layout = compiled(text)
    assert [plan.e2e for plan in layout.messages] == [protection("1A", 7)]
    (line,) = e2e_warnings(layout)
    assert f"the data ID of the attribute {name}, 7" in line
    assert line.endswith("dbc.e2e_data_ids.M = 0x7")
    assert not e2e_warnings(compiled(text, e2e_data_ids={"M": 7}))


@pytest.mark.parametrize("value", ["x", "70000", "1, 2"])
def test_unusual_name_with_an_unfit_data_id_changes_no_frame(value: str) -> None:
    text = layout_text("1A") + attributes("P01", value).replace("E2EDataId", "DataID")
    layout = compiled(text)
    assert [plan.e2e for plan in layout.messages] == [protection("1A", 0x123)]
    (line,) = e2e_warnings(layout)
    assert f"not with the DataID of the DBC, {value}, because it does not fit" in line


def test_copies_with_profile_1a_report_the_data_id_that_they_do_not_use() -> None:
    text = layout_text("1A", value=Sig("BatteryVoltage", 32, 16, unit="V")) + attributes("P01", 7)
    layout = compiled(text, ("left", "right"))
    assert [plan.e2e for plan in layout.messages] == [
        protection("1A", 0x123),
        protection("1A", 0x124),
    ]
    left, right = e2e_warnings(layout)
    assert "LeftM is sent with the data ID 0x123, not with the E2EDataId of the DBC, 0x7" in left
    assert right.endswith("dbc.e2e_data_ids.RightM = 0x124")
    confirmed = {"LeftM": 0x123, "RightM": 0x124}
    assert not e2e_warnings(compiled(text, ("left", "right"), e2e_data_ids=confirmed))


def test_assumed_profile_uses_the_data_id_of_the_dbc() -> None:
    text = layout_text("1A").replace("M_BZ", "M_Alive") + attributes(None, 7)
    layout = compiled(text)
    assert [plan.e2e for plan in layout.messages] == [protection("1A", 7)]
    (line,) = e2e_warnings(layout)
    assert line.endswith("dbc.e2e_data_ids.M = 0x7")


def test_equal_data_ids_of_several_messages_cause_one_warning() -> None:
    ids = {"Motor_1": 5, "Motor_2": 5, "Other": 6}
    (line,) = e2e_warnings(compiled(dbc_text(MESSAGES), e2e_data_ids=ids))
    assert "Motor_1, Motor_2 have the same data ID, 0x5" in line


@pytest.mark.parametrize(
    ("name", "length", "most"),
    [
        ("1A", 24, None),
        ("1A", 32, 30),
        ("11C", 64, 30),
        ("2", 32, None),
        ("2", 48, 32),
        ("22", 64, 32),
        ("5", 64, None),
    ],
)
def test_message_beyond_the_length_of_its_profile_causes_a_warning(
    name: str, length: int, most: int | None
) -> None:
    text = layout_text(name).replace("BO_ 291 M: 8", f"BO_ 291 M: {length}")
    lines = e2e_warnings(compiled(text, e2e={"M": name}, e2e_data_ids={"M": DATA_IDS[name]}))
    assert len(lines) == (most is not None)
    for line in lines:
        assert f"has {length} bytes, but AUTOSAR allows at most {most} for E2E profile" in line


def test_profile_that_is_stated_as_none_is_named_in_the_warning() -> None:
    text = layout_text("1A").replace("M_BZ", "M_Alive") + attributes("none", None)
    (line,) = e2e_warnings(compiled(text))
    assert "sent as AUTOSAR E2E profile 1, although its E2EProfile is 'none'" in line


def test_assumed_profile_and_a_data_id_of_an_unusual_name_cause_one_warning() -> None:
    text = layout_text("1A").replace("M_BZ", "M_Alive") + attributes("none", 7)
    (line,) = e2e_warnings(compiled(text.replace("E2EDataId", "DataID")))
    assert line.endswith("To confirm this, set dbc.e2e_data_ids.M = 0x7")


@pytest.mark.parametrize("name", ["1B", "1C", "2", "5"])
def test_message_that_lacks_only_its_data_id_gets_one_line(name: str) -> None:
    (line,) = refused(layout_text(name), e2e={"M": name})
    assert "it has none. Set dbc.e2e_data_ids.M" in line


def test_nibble_without_a_profile_names_the_profile_as_remedy() -> None:
    lines = refused(layout_text("1C"))
    (line,) = [line for line in lines if "M_DataIDNibble" in line]
    assert 'dbc.e2e.M = "1C"' in line
    assert "no such source" not in line


@pytest.mark.parametrize(
    ("name", "role"),
    [
        ("CHKS_x", "crc"),
        ("ALIV_x", "alive"),
        ("Checksum_x", "crc"),
        ("RollingCounter_x", "alive"),
        ("x_AliveCnt1", "alive"),
    ],
)
def test_name_like_a_checksum_or_counter_gets_the_binding_as_hint(name: str, role: str) -> None:
    (line,) = refused(dbc_text([Msg("M", 0x123, 8, [Sig(name, 0, 8)])]))
    assert line.endswith(f'bind it: dbc.bind.{name} = "{role}".')
    assert "Did you mean" not in line
