"""The played adapter's wire: what a UART makes of the levels on it, and which bytes from the host count as sent."""

import pytest
from qemu_adapter import (
    ESC_LINE,
    STATUS_BREAK,
    STATUS_FRAMING,
    STATUS_PARITY,
    Line,
    SerialAdapter,
    levels,
    sampled,
)

DATA = bytes(range(256))


@pytest.mark.parametrize("parity", ["N", "E", "O"])
@pytest.mark.parametrize("baud", [9600, 115_200])
def test_what_is_read_as_it_was_sent_has_no_errors(baud: int, parity: str) -> None:
    line = Line(baud, parity)
    assert list(sampled(levels(DATA, line), baud, line)) == [(byte, 0) for byte in DATA]


def errors(wire: list[int], sent_at: int = ESC_LINE.baud) -> set[int]:
    return {error for _, error in sampled(wire, sent_at, ESC_LINE)}


def test_each_error_is_told_by_the_levels() -> None:
    wire = levels(b"\x55", ESC_LINE)
    bit_hit, stop_bit_hit = wire.copy(), wire.copy()
    bit_hit[4] ^= 1
    stop_bit_hit[ESC_LINE.bits] ^= 1
    assert errors(bit_hit) == {STATUS_PARITY}
    assert errors(stop_bit_hit) == {STATUS_FRAMING}
    assert errors([1] + [0] * 100 + [1] * 12) == {STATUS_BREAK}
    assert errors(levels(DATA, Line(parity="O"))) == {STATUS_PARITY}
    assert errors(levels(DATA, Line(parity="N"))) & {STATUS_PARITY, STATUS_FRAMING}
    assert errors(levels(DATA, Line(9600, "N")), 9600) & {STATUS_FRAMING, STATUS_BREAK}


def test_bytes_to_an_esc_are_the_kernels_echo_until_the_port_is_set_and_the_gateways_from_then_on() -> (
    None
):
    adapter = SerialAdapter("x")

    def set_line(divisor: int, parity_and_bits: int) -> None:
        adapter.vendor(3, divisor, 0, 0)
        adapter.vendor(4, parity_and_bits, 0, 0)

    set_line(312, 0x0008)  # 9600 8N1, at the opening
    adapter.take(b"echo")
    set_line(26, 0x0208)  # 115200 8E1
    adapter.take(b"A")
    set_line(312, 0x0008)  # by another program
    adapter.take(b"B")
    assert adapter.received == 2
