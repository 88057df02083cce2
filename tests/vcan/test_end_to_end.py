"""A gateway process with ESCs on pseudo terminals, on a vcan.

Each value on the bus was sent by an ESC, in the same order. Frames are decoded by the DBC alone.
"""

import signal
from pathlib import Path

import pytest
from feeder import Identity
from vcan_tools import chain, wait_for

from kontronik_can_gw.esc.kontronik.codec import WireLayout
from kontronik_can_gw.esc.kontronik.states import Device

pytestmark = pytest.mark.promise("true")

LINK_THERE = (2, 3)
"""States Ok and Degraded. A link is Degraded if its ESC waits for the bus to show each frame."""
LINK_LOST = 4
STOPPING = 2
LAYOUTS = (WireLayout.V4, WireLayout.LEGACY)
EIGHT = [Identity(i + 1, LAYOUTS[i % 2], cells=6 + i, alarms=i > 5) for i in range(8)]


@pytest.mark.parametrize(
    ("identities", "times", "number"),
    [
        ([Identity(1)], 150, signal.SIGTERM),
        ([Identity(2, WireLayout.LEGACY, Device.JIVEPRO, 12, alarms=True)], 300, signal.SIGINT),
        (EIGHT, 40, signal.SIGTERM),
    ],
    ids=["KOSMIK", "JIVEPRO", "eight"],
)
def test_every_frame_is_on_the_bus_and_the_last_status_is_stopping(
    vcan: str,
    tmp_path: Path,
    identities: list[Identity],
    times: int,
    number: int,
) -> None:
    with chain(vcan, tmp_path, *identities) as run, run.running() as gateway:
        run.feed(times=times)
        every = {can_id for can_id, message in run.watch.table.items()}

        def are_all_sent() -> bool:
            return {frame.can_id for frame in run.watch.recorded} == every

        def are_devices_known() -> bool:
            devices = [run.watch.info_device(index) for index in range(len(identities))]
            return devices == [identity.device for identity in identities]

        def are_links_there() -> bool:
            names = [f"Esc{number}Link" for number in range(1, len(identities) + 1)]
            return all(run.watch.value(name, "link_state") in LINK_THERE for name in names)

        def are_newest_shown() -> bool:
            return [fresh[-1].n for fresh in run.watch.fresh] == newest

        wait_for(are_all_sent, "all messages of the DBC")
        wait_for(are_devices_known, "the devices")
        wait_for(are_links_there, "the links are there")
        newest = [len(fed.sent) - 1 for fed in run.escs]
        assert run.watch.values > 2 * times * len(identities)
        wait_for(are_newest_shown, "the newest values")
        assert gateway.end(number) == 0, gateway.log
        run.watch.wait_for_mark()
        assert run.watch.value("GatewayStatus", "gateway_state") == STOPPING


NOT_AVAILABLE = bytes.fromhex("ffffffffff80ff")
"""Data of EscCurrent without telemetry."""


def test_loss_and_return_of_telemetry_are_shown_on_the_bus(vcan: str, tmp_path: Path) -> None:
    with chain(vcan, tmp_path, Identity(1), esc="") as run, run.running() as gateway:
        for times in (1, 2):
            run.feed(times=5)
            count = len(run.watch.of(0x680))

            def is_marked(count: int = count) -> bool:
                later = run.watch.of(0x680)[count:]
                return [frame.data[3] for frame in later].count(0xFF) >= 3

            def is_logged(times: int = times) -> bool:
                return gateway.log.count("telemetry lost") >= times

            wait_for(lambda: run.watch.value("Esc1Link", "link_state") == LINK_LOST, "it is lost")
            wait_for(is_marked, "cyclic messages go on with NotAvailable")
            lost = [frame.data[:7] == NOT_AVAILABLE for frame in run.watch.of(0x688)]
            assert lost[-2:] == [False, True], "event messages show it once"
            wait_for(is_logged, "the log says so")
        run.feed()

        def is_there() -> bool:
            return run.watch.value("Esc1Link", "link_state") in LINK_THERE

        wait_for(is_there, "it is there again")
