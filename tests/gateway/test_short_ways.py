"""The short ways of the live path do what the general ways do: every frame, in its order, and every counter."""

import random
from collections.abc import Sequence
from dataclasses import asdict, replace

import cantools.database
import pytest
from cantools.database.can import Database
from hypothesis import given
from hypothesis import strategies as st
from packer_oracle import LayoutMaker, bindings, dbc_text, random_info, random_live

from kontronik_can_gw.config import shipped
from kontronik_can_gw.dbc_output.layout import DbcSettings, Layout, load_database
from kontronik_can_gw.dbc_output.output import DbcOutput
from kontronik_can_gw.dbc_output.prepare import prepare
from kontronik_can_gw.frames import CanFrame, frame_of
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.protocol import codec
from kontronik_can_gw.protocol.deframer import Deframer
from kontronik_can_gw.protocol.fields import LiveData
from kontronik_can_gw.sources import CanState
from kontronik_can_gw.telemetry import MS, EscSettings, EscTelemetry, Event


class LongOutput(DbcOutput):
    """Takes the general way for live frames too."""

    def on_live(self, esc: int, now: int) -> None:
        self.on_event(esc, Event.LIVE, now)


class LongTelemetry(EscTelemetry):
    def receive_live(self, data: bytes, now: int, since: int) -> bool:
        return False


def long_gateway(escs: Sequence[EscSettings], layout: Layout, silent: bool) -> Gateway:
    gateway = Gateway(escs, layout, 0, silent)
    gateway.escs[:] = [LongTelemetry(settings, 0) for settings in escs]
    gateway._output = LongOutput(layout, gateway.escs, gateway.status, 0, silent)
    return gateway


def random_layout(source: random.Random, escs: Sequence[EscSettings]) -> Layout:
    maker = LayoutMaker(source, escs)
    messages = [maker.message() for _ in range(source.choice([4, 12]))]
    more = "\n".join(
        f'BA_ "GenMsgSendType" BO_ {message.dbc_id} {source.choice([0, 1, 2, 2, 2, 3, 4])};\n'
        f'BA_ "GenMsgCycleTime" BO_ {message.dbc_id} {source.choice([10, 33, 100])};\n'
        f'BA_ "GenMsgDelayTime" BO_ {message.dbc_id} {source.choice([0, 0, 5, 25])};'
        for message in messages
    )
    database = cantools.database.load_string(dbc_text(messages, more), "dbc")
    assert isinstance(database, Database)
    return prepare(database, "my.dbc", escs, DbcSettings(bindings(messages)), fd_allowed=True)[1]


def happen(source: random.Random, gateways: Sequence[Gateway], now: int) -> None:
    """Something, to each of them."""
    esc = source.randrange(len(gateways[0].escs))
    choice = source.random()
    chunks: list[bytes] = []
    if choice < 0.75:
        layout = codec.Layout.V4 if source.random() < 0.95 else codec.Layout.LEGACY
        data = codec.encode(random_live(source), layout)
        if source.random() < 0.1:
            data = codec.encode(random_info(source), layout)
        if source.random() < 0.1:
            data += codec.encode(random_live(source), layout)
        if source.random() < 0.1:
            place = source.randrange(len(data))
            data = data[:place] + bytes((data[place] ^ 1 << source.randrange(8),)) + data[place + 1 :]
        cut = source.randrange(len(data)) if source.random() < 0.1 else 0
        chunks = [chunk for chunk in (data[:cut], data[cut:]) if chunk]
    error = CanState(source.randrange(1, 5))
    poles, timeout = source.choice([1, 7]), source.choice([20, 250]) * MS
    for gateway in gateways:
        for chunk in chunks:
            gateway.receive_bytes(esc, chunk, now, now)
        if 0.75 <= choice < 0.78:
            gateway.port_lost(esc, now)
        elif choice < 0.81 and not chunks:
            gateway.port_opened(esc, now)
        elif choice < 0.83 and not chunks:
            gateway.set_can_state(error, now)
        elif choice < 0.85 and not chunks:
            gateway.can_returned(now)
        elif choice < 0.87 and not chunks:
            gateway._apply(esc, replace(gateway.escs[esc].settings, pole_pairs=poles, timeout_ns=timeout))
        elif not chunks:
            gateway.advance(now)


def known(esc: EscTelemetry) -> dict[str, object]:
    hidden = {"_deframer", "_window_counters", "_diagnosis_counters", "base"}
    plain = {name: value for name, value in vars(esc).items() if name not in hidden}
    deframer = {name: getattr(esc._deframer, name) for name in ("_base", "_need", "_pending", "_blame_until")}
    counters = (esc.counters, esc._window_counters, esc._diagnosis_counters)
    return plain | deframer | {"counters": [asdict(each) for each in counters]}


@pytest.mark.parametrize("seed", range(10))
def test_the_gateway_sends_the_same(seed: int) -> None:
    source = random.Random(seed)
    escs = [EscSettings(f"e{number}", pole_pairs=number) for number in range(1, source.choice([2, 3, 4]))]
    layout = random_layout(source, escs)
    if seed % 5 == 0:
        settings = DbcSettings()
        layout = prepare(load_database(shipped("dbc/kontronik_esc.dbc")), "shipped", escs, settings, False)[1]
    silent = source.random() < 0.3
    short, long = Gateway(escs, layout, 0, silent), long_gateway(escs, layout, silent)
    gateways = (short, long)
    images = 0
    for gateway in gateways:
        gateway.start(0)
    now = 0
    for _ in range(1500):
        now += source.choice([0, 1, 5, 10, 10, 10, 40, 300]) * MS
        happen(source, gateways, now)
        if source.random() < 0.7:
            for gateway in gateways:
                gateway.advance(now)
            ready = short.take_ready()
            images += sum(isinstance(frame, bytes) for frame in ready)
            sent = [frame_of(frame) for frame in ready]
            assert sent == long.take_frames()
            alone = [frame.can_id for frame in (f for f in ready if isinstance(f, CanFrame))]
            for image in (frame_of(frame) for frame in ready if isinstance(frame, bytes)):
                assert image.can_id not in alone
                alone.append(image.can_id)
        for one, other in zip(short.escs, long.escs, strict=True):
            assert known(one) == known(other)
        assert short.next_deadline() == long.next_deadline()
    if seed % 5 == 0 and not silent:
        assert images > 100


@given(st.data())
def test_a_frame_in_hand_is_what_the_search_finds(data: st.DataObject) -> None:
    short, long = Deframer(), Deframer()
    taken = 0
    for _ in range(data.draw(st.integers(1, 12))):
        chunk = codec.encode(LiveData(data.draw(st.integers(0, 1 << 32 - 1))), codec.Layout.V4)
        match data.draw(st.integers(0, 5)):
            case 0:
                chunk = chunk[: data.draw(st.integers(0, 40))]
            case 1:
                chunk = data.draw(st.binary(min_size=40, max_size=40))
            case 2:
                place = data.draw(st.integers(0, 39))
                chunk = chunk[:place] + bytes((chunk[place] ^ 1 << data.draw(st.integers(0, 7)),)) + chunk[place + 1 :]
        found = [frame.data for frame in long.feed(chunk)]
        if (live := short.take_live(chunk)) is not None:
            taken += 1
            assert [LiveData(*live)] == found
        else:
            assert [frame.data for frame in short.feed(chunk)] == found
        assert short.counters == long.counters
        assert (short._base, short._need, short._pending) == (long._base, long._need, long._pending)


def test_where_the_shorter_form_matches_too_it_is_the_shorter() -> None:
    """A V4 frame whose first 38 bytes are a legacy frame: its reserved bytes and the low half of its CRC are the legacy CRC."""
    from zlib import crc32

    for speed in range(1 << 20):
        head = codec.encode(LiveData(speed), codec.Layout.V4)[:34]
        first = crc32(head[:32]).to_bytes(4, "little")
        covered = head + first[:2]
        whole = covered + crc32(covered).to_bytes(4, "little")
        if whole[36:38] == first[2:]:
            break
    assert Deframer().take_live(whole) is None
    assert [frame.form.length for frame in Deframer().feed(whole)] == [38]
