"""ESCs on pseudo terminals -> gateway process -> vcan: each value on the bus is one that was sent, in order, decoded by the DBC alone."""

import signal
from pathlib import Path

import pytest
from feeder import Identity
from vcan_tools import chain, wait_for

from kontronik_can_gw.esc.kontronik.codec import Layout
from kontronik_can_gw.esc.kontronik.states import Device

LINK_THERE = (2, 3)
LINK_LOST = 4
STOPPING = 2
"""A link is Degraded rather than Ok when its ESC waits for the bus to show each frame."""
EIGHT = [
    Identity(i + 1, (Layout.V4, Layout.LEGACY)[i % 2], cells=6 + i, alarms=i > 5) for i in range(8)
]


@pytest.mark.parametrize(
    ("identities", "times", "number"),
    [
        ([Identity(1)], 150, signal.SIGTERM),
        ([Identity(2, Layout.LEGACY, Device.JIVEPRO, 12, alarms=True)], 300, signal.SIGINT),
        (EIGHT, 40, signal.SIGTERM),
    ],
    ids=["KOSMIK", "JIVEPRO", "eight"],
)
def test_every_frame_is_on_the_bus_as_it_was_sent_and_the_last_word_is_that_it_ends(
    vcan: str, tmp_path: Path, identities: list[Identity], times: int, number: int
) -> None:
    with chain(vcan, tmp_path, *identities) as run, run.running() as gateway:
        run.feed(times=times)
        every = {can_id for can_id, message in run.watch.table.items()}
        wait_for(
            lambda: {frame.can_id for frame in run.watch.recorded} == every,
            "all messages of the DBC",
        )
        for index, identity in enumerate(identities):
            link = f"Esc{index + 1}Link"
            wait_for(lambda i=index, d=identity.device: run.watch.info_device(i) == d, "the device")  # type: ignore[misc]
            wait_for(
                lambda name=link: run.watch.value(name, "link_state") in LINK_THERE,  # type: ignore[misc]
                "the link is there",
            )
        newest = [len(fed.sent) - 1 for fed in run.escs]
        assert run.watch.values > 2 * times * len(identities)
        wait_for(
            lambda: all(fresh[-1].n == n for fresh, n in zip(run.watch.fresh, newest, strict=True)),
            "the newest values",
        )
        assert gateway.end(number) == 0, gateway.log
        run.watch.wait_for_mark()
        assert run.watch.value("GatewayStatus", "gateway_state") == STOPPING


NOT_AVAILABLE = bytes.fromhex("ffffffffff80ff")
"""What EscCurrent says without telemetry."""


def test_loss_and_return_of_telemetry_are_on_the_bus(vcan: str, tmp_path: Path) -> None:
    with chain(vcan, tmp_path, Identity(1), esc="") as run, run.running() as gateway:
        for times in (1, 2):
            run.feed(times=5)
            count = len(run.watch.of(0x680))
            wait_for(lambda: run.watch.value("Esc1Link", "link_state") == LINK_LOST, "it is lost")
            wait_for(
                lambda count=count: (  # type: ignore[misc]
                    [f.data[3] for f in run.watch.of(0x680)[count:]].count(0xFF) >= 3
                ),
                "cyclic messages go on with NotAvailable",
            )
            lost = [frame.data[:7] == NOT_AVAILABLE for frame in run.watch.of(0x688)]
            assert lost[-2:] == [False, True], "event messages say so once"
            wait_for(
                lambda times=times: gateway.log.count("telemetry lost") >= times,  # type: ignore[misc]
                "the log says so",
            )
        run.feed()
        wait_for(
            lambda: run.watch.value("Esc1Link", "link_state") in LINK_THERE, "it is there again"
        )
