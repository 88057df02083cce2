"""Frames of a log, marked as replay: a message with the gateway's state says Replay."""

from kontronik_can_gw.frames import EXTENDED, CanFrame
from kontronik_can_gw.gateway_status import GatewayState
from kontronik_can_gw.signals import e2e
from kontronik_can_gw.signals.packer import place
from kontronik_can_gw.signals.plan import Layout, Role


class Marker:
    """For the frames of one layout. ``can_mark`` False: no message of it has the gateway's state."""

    def __init__(self, layout: Layout) -> None:
        self._changes: dict[int, tuple[int, int, int, int | None, int]] = {}
        for plan in layout.messages:
            crc = next((s.pieces[0].at // 8 for s in plan.signals if s.role is Role.CRC), None)
            for signal in plan.signals:
                source = None if signal.source is None else signal.source.name
                if source != "gateway_state" or signal.page is not None:
                    continue
                raw = int(GatewayState.REPLAY)
                if signal.numbers is not None:
                    raw = signal.numbers.get(raw, signal.error)
                mask = place(signal.pieces, (1 << signal.length) - 1)
                key = plan.can_id | (EXTENDED if plan.extended else 0)
                bits = place(signal.pieces, raw)
                self._changes[key] = (plan.length, mask, bits, crc, plan.data_id)

    @property
    def can_mark(self) -> bool:
        return bool(self._changes)

    def mark(self, frame: CanFrame) -> CanFrame:
        """The frame as a replaying gateway would send it; others as they are."""
        change = self._changes.get(frame.key)
        if change is None or frame.remote or len(frame.data) < change[0]:
            return frame
        _, mask, bits, crc, data_id = change
        number = int.from_bytes(frame.data, "little") & ~mask | bits
        data = number.to_bytes(len(frame.data), "little")
        if crc is not None:
            data = data[:crc] + bytes((e2e.crc(data, crc, data_id),)) + data[crc + 1 :]
        return frame._replace(data=data)
