"""pty with simulated ESC -> gateway process -> vcan -> candump, decoded by cantools, equal to what was sent."""

import time
from collections.abc import Callable
from pathlib import Path

import can
import pytest
from vcan_tools import SNA, Bench, Candump, GatewayProcess, agrees, bench, configuration, database_of, wait_for

from kontronik_can_gw.config import shipped
from kontronik_can_gw.protocol.codec import Layout
from kontronik_can_gw.protocol.fields import LiveData
from kontronik_can_gw.protocol.states import Device
from kontronik_can_gw.simulator import FLIGHT, EscOptions, Faults

Start = Callable[..., GatewayProcess]
QUICK = tuple(
    phase._replace(duration_s=max(0.3, phase.duration_s * 0.1), ramp_s=phase.ramp_s * 0.1) for phase in FLIGHT
)
FOLLOWS_EACH_FRAME = ("Speed", "Current")
LIVE = ("Status", "Bec", "Energy")
INFO = ("Info", "ExtremesA", "ExtremesB", "ExtremesC")


def compare(run: Bench, index: int, prefix: str, dump: Candump, config: Path) -> dict[str, int]:
    """Every recorded frame of an ESC against what it sent; returns how many of each message were compared."""
    database = database_of(config)
    signal_prefix = "" if prefix == "Esc" else prefix  # with one ESC signals have no prefix
    live, info = run.live(index), run.info(index)
    counts: dict[str, int] = {}
    for stem in (*FOLLOWS_EACH_FRAME, *LIVE, *INFO):
        message = database.get_message_by_name(prefix + stem)
        source = info if stem in INFO else live
        position = compared = 0
        for frame in dump.of(message.frame_id):
            decoded = dict(message.decode_simple(frame.data))
            if any(str(value) == SNA for name, value in decoded.items() if not name.endswith(("BecCurrent", "Losses"))):
                assert not compared or stem in INFO, f"{message.name}: not available amid good telemetry"
                continue
            not_supplied = [name for name, value in decoded.items() if str(value) == SNA]
            numbers = message.decode_simple(frame.data, decode_choices=False)
            numbers = {name: value for name, value in numbers.items() if name not in not_supplied}
            # what was sent not later than this frame; it is noted behind the write, on a busy machine well behind it
            known = [i for i in range(position, len(source)) if source[i][0] <= frame.time + 0.3]
            hits = [i for i in known if agrees(numbers, source[i][1], signal_prefix)]
            assert hits, f"{message.name}: {decoded} was never sent"
            if stem not in INFO:
                assert frame.time - source[hits[-1]][0] < 0.15, f"{message.name}: an old value"
            position = hits[0] if stem in LIVE + INFO else hits[0] + 1
            compared += 1
        counts[stem] = compared
    return counts


def run_and_compare(
    vcan: str, start: Start, tmp_path: Path, escs: list[EscOptions], seconds: float
) -> list[dict[str, int]]:
    with bench(*escs) as run, Candump(vcan) as dump:
        gateway = start(configuration(vcan, [port.path for port in run.ports]))
        gateway.wait_for_line(f"esc{len(escs)}: /dev/pts")
        run.start()
        time.sleep(seconds)
        run.stop()
        time.sleep(0.1)
        assert gateway.end() == 0, gateway.log
        config = tmp_path / "gateway0.toml"
        time.sleep(0.2)
        found = [compare(run, i, "Esc" if len(escs) == 1 else f"Esc{i + 1}", dump, config) for i in range(len(escs))]
        for i, counts in enumerate(found):
            sent = len(run.live(i))
            # frames that are read in one go may be closer than GenMsgDelayTime: then the newest wins
            assert counts["Speed"] >= 0.95 * sent, (i, counts, sent)
            assert counts["Current"] >= 0.95 * sent, (i, counts, sent)
            assert all(counts[stem] >= seconds for stem in LIVE), counts
            assert all(counts[stem] >= 1 for stem in INFO), counts
        return found


@pytest.mark.parametrize("device", [Device.KOSMIK, Device.JIVEPRO])
def test_one_esc_is_on_the_bus_as_it_was_sent(vcan: str, start_gateway: Start, tmp_path: Path, device: Device) -> None:
    run_and_compare(vcan, start_gateway, tmp_path, [EscOptions(device=device, profile=QUICK)], 5)


def test_eight_escs_of_both_layouts_are_on_the_bus_as_they_were_sent(
    vcan: str, start_gateway: Start, tmp_path: Path
) -> None:
    layouts = [Layout.V4, Layout.LEGACY]
    escs = [EscOptions(layout=layouts[i % 2], cell_count=6 + i, profile=QUICK) for i in range(8)]
    run_and_compare(vcan, start_gateway, tmp_path, escs, 5)


def test_values_are_right_on_a_noisy_line_too(vcan: str, start_gateway: Start, tmp_path: Path) -> None:
    noisy = EscOptions(profile=QUICK, faults=Faults(noise=5, lost_bytes=0.002))
    with bench(noisy) as run, Candump(vcan) as dump:
        gateway = start_gateway(configuration(vcan, [run.ports[0].path]))
        gateway.wait_for_line("esc1: /dev/pts")
        run.start()
        time.sleep(4)
        run.stop()
        time.sleep(0.1)
        gateway.end()
        intact = sum(sent.intact for _, sent in run.sent[0] if isinstance(sent.data, LiveData))
        assert intact < len(run.live(0))
        counts = compare(run, 0, "Esc", dump, tmp_path / "gateway0.toml")
        assert 0.95 * intact <= counts["Speed"] <= intact
        link = database_of(tmp_path / "gateway0.toml").get_message_by_name("EscLink")
        last = link.decode_simple(dump.of(link.frame_id)[-1].data)
        crc_errors = last["CrcErrors"]
        assert isinstance(crc_errors, (int, float))
        assert crc_errors > 0


def test_loss_and_return_of_telemetry_are_on_the_bus(vcan: str, start_gateway: Start) -> None:
    with bench(EscOptions(profile=QUICK)) as run, Candump(vcan) as dump:
        gateway = start_gateway(configuration(vcan, [run.ports[0].path]))
        gateway.wait_for_line("esc1: /dev/pts")
        run.start()
        wait_for(lambda: len(dump.of(0x688)) > 50, 5, "EscSpeed")
        run.stop()
        lost = time.time()
        gateway.wait_for_line("telemetry lost")
        time.sleep(0.5)
        silent = [frame for frame in dump.of(0x688) if frame.time > lost + 0.05]
        assert [frame.data[:7].hex() for frame in silent] == ["ffffffffff80ff"], "event messages say so once"
        states = [frame for frame in dump.of(0x680) if frame.time > lost + 0.35]
        assert len(states) >= 2, "cyclic messages go on"
        assert all(frame.data[3] == 0xFF for frame in states), "with NotAvailable"
        assert dump.of(0x6B0)[-1].data[0] & 15 == 4, "the link status goes on and says lost"
        back = time.time()
        run.start()
        wait_for(lambda: dump.of(0x688)[-1].data[:3] != b"\xff\xff\xff", 2, "EscSpeed again")
        first = next(frame for frame in dump.of(0x688) if frame.time > back)
        assert first.time - back < 0.3
        assert gateway.end() == 0


def test_silent_on_loss_stops_values_but_not_the_link_status(vcan: str, start_gateway: Start) -> None:
    with bench(EscOptions(profile=QUICK)) as run, Candump(vcan) as dump:
        gateway = start_gateway(configuration(vcan, [run.ports[0].path], dbc='[dbc]\non_loss = "silent"'))
        gateway.wait_for_line("esc1: /dev/pts")
        run.start()
        wait_for(lambda: len(dump.of(0x688)) > 50, 5, "EscSpeed")
        run.stop()
        lost = time.time()
        time.sleep(2)
        late = {frame.can_id for frame in list(dump.frames) if frame.time > lost + 0.4}
        assert late == {0x680, 0x6B0, 0x6D8, 0x6D9}, "both messages with link status go on"
        assert gateway.end() == 0


def test_sigterm_and_sigint_end_it_within_half_a_second_with_a_last_word(vcan: str, start_gateway: Start) -> None:
    for number in (15, 2):
        with bench(EscOptions()) as run, Candump(vcan) as dump:
            gateway = start_gateway(configuration(vcan, [run.ports[0].path]))
            gateway.wait_for_line("esc1: /dev/pts")
            run.start()
            wait_for(lambda: len(dump.of(0x688)) > 20, 5, "EscSpeed")
            begin = time.monotonic()
            assert gateway.end(number) == 0
            took = time.monotonic() - begin
            time.sleep(0.2)
            assert dump.of(0x6D8)[-1].data[0] & 15 == 2, "GatewayState Stopping"
            assert took < 0.5 + 0.3, f"{took:.2f} s, of which a Python's end here takes up to 0.3"


def test_python_can_and_cantools_read_it_live(vcan: str, start_gateway: Start) -> None:
    import cantools.database

    with bench(EscOptions(profile=QUICK)) as run, can.Bus(interface="socketcan", channel=vcan) as bus:
        gateway = start_gateway(configuration(vcan, [run.ports[0].path]))
        gateway.wait_for_line("esc1: /dev/pts")
        run.start()
        database = cantools.database.load_file(shipped("dbc/kontronik_esc.dbc"))
        assert isinstance(database, cantools.database.Database)
        deadline = time.monotonic() + 5
        seen: set[int] = set()
        while time.monotonic() < deadline and len(seen) < len(database.messages):
            message = bus.recv(1)
            assert message is not None
            database.decode_message(message.arbitration_id, bytes(message.data))
            seen.add(message.arbitration_id)
        assert seen == {message.frame_id for message in database.messages}
        assert gateway.end() == 0
