"""Runs the live gateway: one loop over serial ports, CAN interface and time.

Only the thread that calls ``run`` may use this module, except ``stop``, which a signal handler or
another thread may call. No thread is started here. These parts have their own threads (worker.py):
the parameter store (store.py), the status document (statistics.py), captures (recorder.py), the log
(fault_log.py), and opening (can_opener.py) and reception (open_can.py) of python-can's drivers.
"""

import logging
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, cast

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.printable import counted
from kontronik_can_gw.runtime.can.can_link import CanLink
from kontronik_can_gw.runtime.files.parameter_saver import ParameterSaver
from kontronik_can_gw.runtime.housekeeping import Housekeeping
from kontronik_can_gw.runtime.poller import Handler, Poller, Work
from kontronik_can_gw.runtime.ports.esc_port import CHECK_EACH_NS, EscPort
from kontronik_can_gw.runtime.ports.usb_adapters import UsbIdentity
from kontronik_can_gw.runtime.status.facts import ProgramFacts
from kontronik_can_gw.runtime.status.statistics import Statistics
from kontronik_can_gw.runtime.system.fault_log import FaultLog, duration
from kontronik_can_gw.runtime.system.sd_notify import Notifier
from kontronik_can_gw.runtime.system.worker import Handover
from kontronik_can_gw.times import SECOND

if TYPE_CHECKING:
    from kontronik_can_gw.runtime.files.recorder import Recorder
    from kontronik_can_gw.runtime.files.store import ParameterStore
    from kontronik_can_gw.runtime.native_poller import NativePoller
    from kontronik_can_gw.runtime.system.clock import ClockWatch

_QUIET_PERIOD_NS = SECOND
"""Longest wait in quiet mode. Without telemetry, no value can expire."""
_LAST_SAVE_S = 0.2


class Loop:
    """Owns the ports, the interface and the gateway while it runs."""

    def __init__(
        self,
        gateway: Gateway,
        ports: Sequence[str],
        can_config: CanConfig,
        wait_for_devices: bool = False,
        store: "ParameterStore | None" = None,
        clock: Callable[[], int] = time.monotonic_ns,
        notifier: Notifier | None = None,
        statistics: Statistics | None = None,
        program: ProgramFacts | None = None,
        recorder: "Recorder | None" = None,
        poller: Poller | None = None,
    ) -> None:
        self.gateway = gateway
        self.conditions = FaultLog()
        self._clock = clock
        self._is_patient = wait_for_devices
        self._store = store
        self._statistics = statistics
        self._recorder = recorder
        self._revision = 0
        self._is_stopping = False
        self._reason = "stopped"
        self._poller = poller or Poller(clock)
        self._native = cast("NativePoller", poller) if self._poller.is_native else None
        self._lost: set[EscPort] = set()
        self.escs = [
            EscPort(i, path, gateway, self._poller, self.conditions, self._lost, clock)
            for i, path in enumerate(ports)
        ]
        self.can = CanLink(can_config, gateway, self._poller, self.conditions, self._esc_at, clock)
        self._saver = ParameterSaver(gateway, self.escs, store)
        self._housekeeping = Housekeeping(
            gateway,
            self.escs,
            self.can,
            self.conditions,
            self._saver,
            notifier=notifier or Notifier({}),
            statistics=self._statistics,
            recorder=recorder,
            program=program or ProgramFacts(""),
        )
        self._wake: Handover[None] = Handover()
        self._poller.register(self._wake.fileno(), self._woken)
        if store is not None:
            self._poller.register(store.fileno(), self._saver.take_results)

    def follow_clock(self, watch: "ClockWatch") -> None:
        """Watch the wall clock. Call it before ``open``. The watch is closed with the loop."""
        self._housekeeping.clock_watch = watch

    def stop(self, reason: str = "stopped") -> None:
        """End ``run`` soon, and log ``reason``. A signal handler or another thread may call it."""
        self._reason = reason
        self._is_stopping = True
        self._wake.wake()

    def open(self) -> None:
        """Open ports and interface.

        Raises RunError if one cannot be opened, and closes the others, unless the configuration
        permits waiting for devices.
        """
        now = self._clock()
        # If the opening fails, the error is the only line of the log.
        self.conditions.keep_back()
        try:
            # The ports are opened and locked first, so that no CAN adapter's driver opens them.
            for esc in self.escs:
                esc.open(now, self._is_patient, self._others(esc))
            self.can.open(now, self._is_patient)
            if self._recorder is not None:
                self._housekeeping.note_clock()  # first, so that the first header has it
                self._recorder.start(self._is_patient)
                self.conditions.log(logging.INFO, f"recording to {self._recorder.words}")
        except UserError:
            self.close()
            raise
        if self.can.port is not None:
            self.can.port.discard()  # a node must not receive frames from before its boot-up
        self.conditions.log_kept()
        self._housekeeping.publish(now)  # now, because the first call takes the longest

    def run(self) -> None:
        """Run until ``stop`` is called. Then send a final status and close everything."""
        self.begin()
        try:
            while not self._is_stopping:
                self.turn()
        except UserError as error:
            self._reason = f"ended ({error})"
            raise
        except BaseException as error:
            self._reason = f"ended by an internal error ({error!r})"
            raise
        finally:
            self.end()

    def begin(self) -> None:
        """Start the gateway."""
        self._poller.begin()
        now = self._clock()
        self._poller.times.now = now
        self.gateway.start(now, self.can.is_open)
        self.can.follow_ids()  # first, because a master may send requests after the boot-up message
        self.can.transmit(now)
        self._housekeeping.report_ready()

    def turn(self) -> None:
        """Wait until a descriptor is ready or work is due, and do the work."""
        ready, is_due = self._wait()
        times = self._poller.times
        now = times.polled
        late = self._poller.late
        is_late = late > self.can.transmitter.max_turn_ns
        if is_late:
            self._follow_hold_up(late, now)
        if is_late or ready or is_due:
            now = self._serve(ready, now)
        elif now >= self.can.controller.due:
            self.can.ask(now)
        times.now = now
        if now - times.settings_checked >= CHECK_EACH_NS:
            times.settings_checked = now
            for esc in self.escs:
                esc.restore_settings()
        if now >= self._housekeeping.due:
            self._housekeeping.run(now)

    def _wait(self) -> Work:
        """Wait for work, and meanwhile let C run iterations if possible.

        The loop wakes at least four times within the shortest telemetry timeout. A value may expire
        early by this quarter of the timeout.
        """
        gateway = self.gateway
        own_due = min(
            self.can.due, self._housekeeping.wake_due, *[esc.retry.due for esc in self._lost]
        )
        period = self.can.transmitter.max_wait_ns()
        if gateway.status.is_quiet:
            period = _QUIET_PERIOD_NS
        if self._native is not None and self._native.can_run(self.can):
            leave = self._housekeeping.due  # what the controller says is asked for with it
            return self._native.run(self.can, own_due, leave, period)
        # A change during sending can have produced frames.
        due = 0 if gateway.frames_wait else min(own_due, gateway.next_deadline())
        times = self._poller.times
        ready = self._poller.wait(min(times.now + period, due))
        return Work(ready, times.polled >= due)

    def _serve(self, ready: list[tuple[Handler, int]], now: int) -> int:
        """Call the handlers, do the due work, and send the resulting frames. Returns the time."""
        gateway = self.gateway
        can = self.can
        for handler, events in ready:
            handler(now, events)
        if self._lost or can.port is None or now >= can.controller.due:
            now = self._reopen(now)
        if gateway.outputs:
            # First, so that its answers are sent in this iteration, as in a replay.
            self._saver.save(now)
        can.look(now)
        gateway.advance(now)
        if gateway.outputs:
            self._follow_outputs(now)
        can.transmit(now)
        if not self._housekeeping.is_ready:
            self._housekeeping.report_ready()
        if gateway.core.link_changes:
            for index in dict.fromkeys(gateway.take_link_changes()):
                self.escs[index].log.follow_link(now)
        return now

    def _follow_outputs(self, now: int) -> None:
        """Follow changes of the outputs: ids to receive, states of nodes."""
        revision = self.gateway.revision
        if revision != self._revision:
            self._revision = revision
            self.can.follow_ids()
            self._housekeeping.report_outputs(now)

    def end(self) -> None:
        """Send a final status, log the totals, and close everything."""
        now = self._clock()
        self._housekeeping.follow_recorder(now)  # records the devices
        self.gateway.stop(now)
        self.can.gate.stop(now)
        self.can.transmit(now)
        self.conditions.log(logging.INFO, f"{self._reason} {totals(self.gateway, now)}")
        self.close()

    def close(self) -> None:
        """Close everything."""
        for esc in self.escs:
            esc.close()
        self.can.close()
        self._poller.close()
        self._housekeeping.close()
        if self._statistics is not None:
            self._statistics.close()
        if self._recorder is not None:
            self._recorder.close()
            self._housekeeping.follow_recorder(self._clock())  # logs its last faults
        if self._store is not None:
            self._store.close(_LAST_SAVE_S)
        self._wake.close()  # later calls of ``stop`` have no effect

    def _woken(self, _now: int, _events: int) -> None:
        self._wake.take()

    def _others(self, esc: EscPort) -> tuple[UsbIdentity | None, ...]:
        return tuple(other.identity for other in self.escs if other is not esc)

    def _esc_at(self, path: str) -> str | None:
        """Return the name of the ESC to which a path leads, or None."""
        return next((esc.name for esc in self.escs if esc.is_at(path)), None)

    def _follow_hold_up(self, late: int, now: int) -> None:
        """Discard the waiting measurements, which are too old after a hold-up.

        Commands and answers are kept. The age of received bytes is known from ``since``.
        """
        text = (
            f"the process was suspended for {late / SECOND:.1f} s: "
            "measurements that waited to be sent are discarded and replaced by current ones"
        )
        self.conditions.event("suspended", text, now)
        self.gateway.held_up(now, self.can.transmitter.suspended(now))

    def _reopen(self, now: int) -> int:
        """Open lost ports and the interface if that is due.

        Returns the time, because opening may take long on a slow machine.
        """
        for esc in tuple(self._lost):
            esc.reopen(now, self._others(esc))
        self.can.reopen(now)
        if now >= self.can.controller.due:
            self.can.ask(now)
        return max(now, self._clock())


def totals(gateway: Gateway, now: int) -> str:
    """Return the totals of the gateway in one line."""
    status = gateway.status
    escs = gateway.escs
    live = sum(esc.counters.live for esc in escs)
    crc_errors = sum(esc.counters.crc_errors for esc in escs)
    losses = sum(esc.losses for esc in escs)
    return (
        f"after {duration(now - status.started_ns)}: {counted(live, 'live frame')} received, "
        f"{counted(crc_errors, 'CRC error')}, telemetry lost {counted(losses, 'time')}; "
        f"{counted(status.sent_frames, 'CAN frame')} sent, {status.dropped_frames} dropped, "
        f"bus-off {counted(status.bus_off_count, 'time')}"
    )
