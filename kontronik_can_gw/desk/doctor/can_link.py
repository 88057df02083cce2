"""Reads a network interface's state from `ip`, or without `ip` from /sys and the kernel."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from kontronik_can_gw.desk.doctor.system import System

_CAN_TYPE = 280
"""ARPHRD_CAN"""
_UP = 1
_ABILITIES = ("bus_off", "error_passive", "restarts", "arbitration_lost", "bus_error")
_LOSSES = ("rx_errors", "rx_dropped", "rx_over_errors", "tx_errors", "tx_dropped", "tx_over_errors")


@dataclass(frozen=True)
class Link:
    """State of a network interface. None: not known. Bit rates in bit/s, 0 where none is set."""

    is_can: bool
    up: bool
    kind: str | None = None
    """can, vcan, vxcan ..."""
    mtu: int = 16
    queue_length: int | None = None
    bitrate: int | None = None
    data_bitrate: int | None = None
    sample_point: float | None = None
    restart_ms: int | None = None
    can_restart: bool = True
    """Restart after bus-off possible; False for slcan, whose driver has none."""
    state: str | None = None
    error_counters: tuple[int, int] | None = None
    """The controller's error counters: transmit, receive."""
    modes: tuple[str, ...] = ()
    termination: int | None = None
    events: Mapping[str, int] = field(default_factory=dict)
    """Counts of events since the interface was created: bus_off, error_passive ..."""
    statistics: Mapping[str, int] = field(default_factory=dict)
    complete: bool = True
    """False without `ip`: some fields are not known."""


def can_interfaces(system: System) -> list[str]:
    """Names of all CAN interfaces."""
    names = system.names("/sys/class/net")
    return [name for name in names if system.number(f"/sys/class/net/{name}/type") == _CAN_TYPE]


def link_of(system: System, name: str) -> Link | None:
    """The interface with this name; None where there is none."""
    folder = f"/sys/class/net/{name}"
    if not name or "/" in name or not system.exists(folder):
        return None
    shown = system.run("ip", "-json", "-details", "-statistics", "link", "show", "dev", name)
    try:
        found = json.loads(shown or "")[0]
        return _from_ip(found, has_device=system.exists(f"{folder}/device"))
    except (ValueError, LookupError, TypeError, AttributeError):
        return _from_sys(system, folder)


def _from_ip(found: Mapping[str, Any], has_device: bool) -> Link:
    info = found.get("linkinfo", {})
    data = info.get("info_data", {})
    kind = info.get("info_kind")
    timing, data_timing = data.get("bittiming", {}), data.get("data_bittiming", {})
    counters, sample_point = data.get("berr_counter"), timing.get("sample_point")
    events = {**data, **info.get("info_xstats", {})}
    numbers = {
        f"{way}_{name}": number
        for way, of_one_way in found.get("stats64", {}).items()
        for name, number in of_one_way.items()
    }
    unset = 0 if kind == "can" else None
    return Link(
        is_can=found.get("link_type") == "can",
        up="UP" in found.get("flags", ()),
        kind=kind,
        mtu=int(found.get("mtu", 16)),
        queue_length=found.get("txqlen"),
        # a driver with fixed rates only, as slcan, has no further timing
        bitrate=timing.get("bitrate", data.get("bittiming_bitrate", unset)),
        data_bitrate=data_timing.get("bitrate", data.get("data_bittiming_bitrate")),
        sample_point=float(sample_point) if sample_point else None,
        restart_ms=data.get("restart_ms", unset),
        can_restart=has_device or kind != "can",
        state=data.get("state"),
        error_counters=(int(counters["tx"]), int(counters["rx"])) if counters else None,
        modes=tuple(data.get("ctrlmode", ())),
        termination=data.get("termination"),
        events={name: int(events[name]) for name in _ABILITIES if name in events},
        statistics={name: int(numbers[name]) for name in _LOSSES if name in numbers},
    )


def _from_sys(system: System, folder: str) -> Link:
    numbers = {name: system.number(f"{folder}/statistics/{name}") for name in _LOSSES}
    return Link(
        is_can=system.number(f"{folder}/type") == _CAN_TYPE,
        up=bool((system.number(f"{folder}/flags") or 0) & _UP),
        mtu=system.number(f"{folder}/mtu") or 16,
        statistics={name: number for name, number in numbers.items() if number is not None},
        complete=False,
    )
