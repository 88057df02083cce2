"""``check``: what a configuration means and will send, without opening anything."""

import argparse
from pathlib import Path

from kontronik_can_gw.cli.common import load_all
from kontronik_can_gw.config import as_toml
from kontronik_can_gw.dbc_output.layout import Layout, MessagePlan, Role, SendType, SignalPlan
from kontronik_can_gw.telemetry import MS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-c", "--config", type=Path, required=True, metavar="FILE", help="TOML configuration")
    parser.epilog = (
        "Prints the effective configuration, each message and signal with its source, what is lost, and the bus load."
    )


def main(args: argparse.Namespace) -> int:
    config, _, layout = load_all(args.config)
    print(f"# effective configuration of {args.config}")
    print(as_toml(config))
    print(f"# messages of {layout.node} by {layout.file}")
    names = [esc.name for esc in config.escs]
    for line in table(layout, names):
        print(line)
    load = layout.bus_load(config.can.bitrate, config.can.data_bitrate)
    frames = sum(message.rate_hz for message in layout.messages)
    print()
    print(
        f"# bus load {load:.1%} of {config.can.bitrate // 1000} kbit/s: {frames:.0f} frames/s with each ESC at 100 Hz, "
        "worst stuffing; messages sent on change counted by their cycle"
    )
    return 0


def table(layout: Layout, esc_names: list[str]) -> list[str]:
    """Message, id, cycle, signal, source and losses in columns."""
    head = ("message", "id", "sent", "signal", "source", "lost")
    rows: list[tuple[str, ...]] = []
    for message in layout.messages:
        first = (message.name, can_id(message), timing(message))
        for signal in message.signals:
            rows.append((*first, signal.name, _source(signal, esc_names), "; ".join(signal.notes)))
            first = ("", "", "")
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in (head, *rows)
    ]


def can_id(message: MessagePlan) -> str:
    """The id in hexadecimal as people write it: 3 digits for 11 bits, 8 for 29."""
    return f"{message.can_id:08X}h" if message.extended else f"{message.can_id:03X}h"


def timing(message: MessagePlan) -> str:
    """How a message is sent, in words."""
    words = []
    if message.cycle_ns:
        words.append(f"every {message.cycle_ns // MS} ms")
    if SendType.EVENT in message.send_type:
        words.append("with each frame")
    if SendType.ON_CHANGE in message.send_type:
        words.append("on change")
    if message.delay_ns:
        words.append(f">= {message.delay_ns // MS} ms")
    return ", ".join(words)


def _source(signal: SignalPlan, esc_names: list[str]) -> str:
    if signal.source is None:
        text = str(signal.constant) if signal.role is Role.CONSTANT else ""
        return f"({signal.role.value}{' ' + text if text else ''})"
    unit = f" {signal.source.unit}" if signal.source.unit else ""
    prefix = f"{esc_names[signal.esc]}." if signal.esc is not None and len(esc_names) > 1 else ""
    page = f" page {signal.page}" if signal.page is not None else ""
    return f"{prefix}{signal.source.name}{unit}{page}"
