"""The CAN frames of plain UART bytes: those of ``DumpInput.frames``, in columns where nothing but intact frames comes.

Everything else goes through the core, frame by frame: the beginning, damaged bytes and the frames behind them up to where the gateway is
steady again, another device. Memory does not grow with the recording.
"""

from collections.abc import Callable, Iterator

from kontronik_can_gw.dbc_output.layout import Layout
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.offline.bulk.feed import Feed
from kontronik_can_gw.offline.bulk.scan import Stretch, pieces
from kontronik_can_gw.offline.bulk.sending import MOST_PERIOD_NS, CanFrames, Sender
from kontronik_can_gw.offline.bulk.state import Quiet, Steady, Stretched, is_steady
from kontronik_can_gw.offline.replay import BytesFollower, TimedFrame

BLOCK = 8192
"""UART frames at a time, so that columns stay in the processor's cache."""
LEAST = 48
"""Of fewer frames, the streaming way is as quick."""
_LATEST_NS = 1 << 61
Found = CanFrames | list[TimedFrame]


def can_follow(gateway: Gateway, layout: Layout, period_ns: int, size: int) -> bool:
    """True where ``follow`` can be quicker than the streaming way."""
    return (
        len(gateway.escs) == 1
        and gateway.nodes is None
        and period_ns <= MOST_PERIOD_NS
        and period_ns * size < _LATEST_NS
        and Sender(layout, gateway._output).possible
    )


def follow(
    gateway: Gateway,
    layout: Layout,
    read: Callable[[int], bytes],
    feed: Feed,
    period_ns: int,
    block: int = BLOCK,
    least: int = LEAST,
) -> Iterator[Found]:
    """The frames in order, single ones and whole blocks; ``gateway`` is a new one of this layout, for which ``can_follow``."""
    follower = BytesFollower(gateway)
    sender = Sender(layout, gateway._output)
    for piece in pieces(read, least):
        if isinstance(piece, Stretch):
            yield from _follow_stretch(
                gateway, sender, follower, feed, Stretched(piece, feed.lives, period_ns), block, least
            )
        else:
            for now, data in feed.feed(piece):
                yield follower.follow(now, data)
    for now, data in feed.finish():
        yield follower.follow(now, data)


def _follow_stretch(
    gateway: Gateway,
    sender: Sender,
    follower: BytesFollower,
    feed: Feed,
    stretched: Stretched,
    block: int,
    least: int,
) -> Iterator[Found]:
    at, end, data = 0, len(stretched), stretched.stretch.data
    while at < end:
        if end - at >= least and feed.is_between and sender.is_ready and is_steady(gateway, stretched.layout):
            follow = Steady if sender.tells else Quiet
            steady = follow(gateway, stretched, at, min(end - at, block), feed.now)
            if steady.count:
                frames = sender.send(steady)
                steady.leave()
                feed.pass_over(stretched, at, steady.count)
                at += steady.count
                yield frames
                continue
        for now, part in feed.feed(data[stretched.offset(at) : stretched.offset(at + 1)]):
            yield follower.follow(now, part)
        at += 1
