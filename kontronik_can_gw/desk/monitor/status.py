"""Evaluates the status file of a running gateway.

The results are an exit code, texts about faults, and lines of at most 80 columns.
"""

import json
import os
import stat
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.text import Text

from kontronik_can_gw.capture.format import event_in_words
from kontronik_can_gw.config.parse import load
from kontronik_can_gw.desk.member import Alarm, Flag, alarms_of
from kontronik_can_gw.desk.monitor.lines import (
    NO_BREAK,
    STATES,
    Part,
    alarm_lines,
    line,
    number,
    table,
    wrapped,
)
from kontronik_can_gw.desk.words import words
from kontronik_can_gw.esc.decoder import Severity
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.native.load import in_words
from kontronik_can_gw.printable import printable
from kontronik_can_gw.runtime.status.snapshot import FORMAT, PROGRAM, STALE_NS
from kontronik_can_gw.runtime.system import folders
from kontronik_can_gw.runtime.system.clock import ClockFacts, step_in_words
from kontronik_can_gw.runtime.system.fault_log import duration
from kontronik_can_gw.times import SECOND

HEALTHY = 0
TROUBLE = 1
NOT_RUNNING = 3
_LARGEST_FILE = 1 << 22
FOREIGN = f"is not a statistics file of {PROGRAM}. Check statistics.file."
MALFORMED = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError)
"""Exceptions caused by a document whose values have unexpected types."""
_WIDTH = 80
_CLOCK_STYLES: Mapping[bool | None, str] = {True: "dim", None: "dim", False: "yellow"}
_WIDTHS = {
    "ESC": 3,
    "link": 10,
    "Hz": 3,
    "age": 6,
    "V": 5,
    "A": 6,
    "1/min": 6,
    "°C": 3,
    "CRC": 5,
    "line": 4,
    "lost": 4,
}
"""Heads and widths of the table's columns."""

Document = Mapping[str, Any]


@dataclass(frozen=True)
class Seen:
    """Result for one gateway: exit code, a sentence, faults, and its document or None."""

    file: Path
    code: int
    sentence: str
    faults: tuple[str, ...] = ()
    age_s: float | None = None
    document: Document | None = None
    is_missing: bool = False
    """True if the file does not exist."""
    is_service: bool = False
    """True if systemd started the gateway, so that its log is in the journal."""

    def as_json(self) -> dict[str, Any]:
        return {
            "file": printable(str(self.file)),
            "exit_code": self.code,
            "status": self.sentence,
            "faults": list(self.faults),
            "troubles": list(self.faults),  # the old name, until 2027-12-01
            "age_s": None if self.age_s is None else round(self.age_s, 3),
            "document": self.document,
        }


def published_files() -> list[Path]:
    """Return the status files of all gateways of the system and of this user, services first."""
    found = _service_files()
    for folder in folders.status_folders():
        found += sorted(folder.glob("*.json"))
    return list({os.path.realpath(file): file for file in found}.values())


def _service_files() -> list[Path]:
    return sorted(folders.RUN.glob(f"{PROGRAM}*/{folders.STATUS_FILE}"))


def is_quiet_on(channel: str, now: int) -> bool:
    """Return True if a gateway of this machine on this CAN interface is in quiet mode."""
    for file in published_files():
        seen = look_at(file, now)
        document = seen.document
        if document is None or seen.code == NOT_RUNNING:
            continue
        if document["can"]["channel"] == channel and document["gateway"]["state"] == "quiet":
            return True
    return False


def possible_files(config: Path | None) -> list[Path]:
    """Return the files that may contain the status of a configuration's gateway.

    The gateway may run as a service or may have been started by hand. Without a configuration, the
    file of the plain service is returned.
    """
    service = PROGRAM
    if config is not None:
        configured = load(config).statistics_path
        if configured is not None:
            return [configured]
        if config.stem != "gateway":
            service = f"{PROGRAM}-{config.stem}"
    files = [folders.RUN / service / folders.STATUS_FILE]
    if config is not None:
        files += [folder / folders.status_name(config) for folder in folders.status_folders()]
    return files


def look_at_first(files: Sequence[Path], now: int, config: Path | None = None) -> Seen:
    """Return the result of the first file of a running gateway.

    If no gateway runs, the result that best shows the reason is returned. ``config`` is the
    configuration that the gateway must have.
    """

    def rank(seen: Seen) -> tuple[bool, int, bool]:
        return seen.document is None, seen.code, seen.is_missing

    return min([look_at(file, now, config) for file in files], key=rank)


def look_at(file: Path, now: int, config: Path | None = None) -> Seen:
    """Return the result of a status file at ``now`` (monotonic).

    ``config`` is the configuration of the expected gateway. The file may be another gateway's.
    """
    try:
        # the file may be replaced by a pipe at any time, on which a normal open would block
        with open(
            file, "rb", opener=lambda path, flags: os.open(path, flags | os.O_NONBLOCK)
        ) as opened:
            if not stat.S_ISREG(os.fstat(opened.fileno()).st_mode):
                text = "is not a regular file. Check statistics.file."
                return Seen(file, NOT_RUNNING, f"{file}: {text}")
            document = json.loads(opened.read(_LARGEST_FILE))
    except FileNotFoundError:
        text = f"{file}: does not exist, so its gateway does not run. "
        text += "Start the gateway that has it as statistics.file."
        if config is not None:
            start = f"Start it: kontronik-can-gw run -c {config}"
            text = f"{config}: no gateway runs with this configuration. {start}"
        return Seen(
            file,
            NOT_RUNNING,
            text,
            is_missing=True,
        )
    except IsADirectoryError:
        text = "is not a regular file. Check statistics.file."
    except OSError as error:
        text = f"cannot be read: {error.strerror}. Try it with sudo."
    except (ValueError, RecursionError):
        text = FOREIGN
    else:
        services = map(os.path.realpath, _service_files())
        is_service = os.path.realpath(file) in services
        seen = replace(judge(file, document, now), is_service=is_service)
        if config is None or seen.document is None:
            return seen
        other = Path(seen.document["configuration"])
        if other.resolve() == config.resolve():
            return seen
        text = f"is from the gateway with {printable(str(other))}, not with {config}."
    return Seen(file, NOT_RUNNING, f"{file}: {text}")


def judge(file: Path, document: Any, now: int) -> Seen:
    """Return the result of a document: the exit code and the texts about faults."""
    try:
        if document["program"] != PROGRAM:
            return Seen(file, NOT_RUNNING, f"{file}: {FOREIGN}")
        if document["format"] != FORMAT:
            text = f"was written by another version of {PROGRAM} ({document['version']})."
            return Seen(file, NOT_RUNNING, f"{file}: {text}")
        seen = _judge(file, document, now)
        list(lines_of(seen))  # a document that cannot be shown is foreign
    except MALFORMED:
        return Seen(file, NOT_RUNNING, f"{file}: {FOREIGN}")
    return seen


def _judge(file: Path, document: Document, now: int) -> Seen:
    age = now - document["monotonic_ns"]
    age_s = age / SECOND
    if abs(age) > STALE_NS:
        text = "not running"  # a time in the future: the machine was restarted
        if age > 0:
            text = f"has written nothing for {duration(age)} (ended, blocked, or the disk is full)"
        return Seen(
            file,
            NOT_RUNNING,
            text,
            (),
            age_s,
            document,
        )
    faults = tuple(map(printable, _faults(document)))
    sentence = printable(document["gateway"]["state"])
    if not faults:
        return Seen(
            file,
            HEALTHY,
            sentence,
            (),
            age_s,
            document,
        )
    count = "1 fault" if len(faults) == 1 else f"{len(faults)} faults"
    return Seen(
        file,
        TROUBLE,
        f"{sentence}, {count}",
        faults,
        age_s,
        document,
    )


def _faults(document: Document) -> Iterator[str]:
    can = document["can"]
    channel = f"CAN {can['channel']}"
    conditions = {
        f"{channel} is down": not can["open"] or can["state"] == "down",
        f"{channel} is bus-off": can["state"] == "bus-off",
        f"{channel}: no frame can be sent": can["stalled"],
        f"{channel}: the bus is slow": can.get("slow"),  # earlier versions do not have it
    }
    worst = next((text for text, is_present in conditions.items() if is_present), None)
    if worst is not None:
        yield can["complaint"] or worst
    is_quiet = document["gateway"]["state"] == "quiet"
    for esc in document["escs"]:
        port = esc["port"]
        if esc["fresh"] or (is_quiet and port["open"]):
            continue  # a parked vehicle has no telemetry
        reason = esc["diagnosis"] or "no telemetry"
        if not port["open"]:
            lost = port["lost_for_s"]
            since = "" if lost is None else f" for {_duration(lost)}"
            complaint = (port["complaint"] or "").removeprefix(f"{esc['name']}: ")
            reason = f"port not open{since}: {complaint or port['path']}"
        yield f"{esc['name']}: {reason}"
    for part, key, text in (
        ("store", "last_error", "parameters cannot be stored"),
        ("recording", "problem", "captures"),
    ):
        if document[part] and document[part][key]:
            yield f"{text}: {document[part][key]}"


# --- lines


def lines_of(seen: Seen) -> Iterator[Text]:
    """Yield all lines about one gateway, the most important first."""
    document = seen.document
    if document is None:
        yield from wrapped(seen.sentence, "bold red", _WIDTH)
        return
    if seen.code == NOT_RUNNING:
        yield from wrapped(f"{PROGRAM} {document['version']}  {seen.sentence}", "bold red", _WIDTH)
        yield line((f"{document['configuration']}, last status at {document['time']}", "dim"))
        if seen.is_service:
            yield line((f"Why? journalctl -e -u '{PROGRAM}*'", "dim"))
    else:
        yield from _head(seen, document)
        yield from _can_lines(document)
        yield line()
        rows = list(_esc_rows(document))
        yield from table(rows, _WIDTH, 2, tuple(_WIDTHS.values()))
        for fault in seen.faults:
            yield from wrapped(fault, "bold red", _WIDTH)
        yield from alarm_lines(alarms(document), _WIDTH)
        yield from _further(document)
    if document["log"]:
        yield line(("last events:", "dim"))
    for event in document["log"]:
        yield from wrapped(f"  {event}", "dim", _WIDTH)


def _head(seen: Seen, document: Document) -> Iterator[Text]:
    process = document["process"]
    gateway = document["gateway"]
    style = "bold green" if seen.code == HEALTHY else "bold yellow"
    state = (seen.sentence, style)
    up = _duration(process["uptime_s"])
    heard = _heard(gateway["escs_ok"], gateway["esc_count"])
    yield line(f"{PROGRAM} {document['version']}  ", state, f"  {heard}, up {up}")
    memory = f"{process['rss_bytes'] // 1_000_000} MB"
    yield line((f"process {process['pid']}, {memory}, {document['configuration']}", "dim"))
    if "core" in gateway:  # documents of 0.5.0 do not have it
        layout = f", layout {gateway['layout']}" if gateway.get("layout") else ""
        core = in_words(gateway["core"], gateway["core_reason"])
        yield line((f"{core}{layout}", "dim"))
    clock = document.get("clock")
    if clock:  # documents of 0.5.0 do not have it
        yield from wrapped(f"clock: {_clock(clock)}", _CLOCK_STYLES[clock["synchronized"]], _WIDTH)


def _heard(heard: int, count: int) -> str:
    if count == 1:
        return "ESC heard" if heard else "ESC not heard"
    return f"{heard} of {count} ESCs heard"


def _clock(clock: Document) -> str:
    """Describe the state of the wall clock and its last step."""
    facts = ClockFacts(synchronized=clock["synchronized"], hardware=clock["hardware"])
    text = printable(facts.in_words)
    if clock["last_step"] is not None:
        step = step_in_words(round(clock["last_step_s"] * SECOND))
        text += f", set {step} at {printable(clock['last_step'])}"
    return text


def _can_lines(document: Document) -> Iterator[Text]:
    can = document["can"]
    rates = document.get("rates") or {}
    text = ""
    if can["bitrate"]:
        text = f", {can['bitrate'] / 1000:g} kbit/s"
    for name in ("sent", "received"):
        text += f", {name} {number(rates.get(f'{name}_frames_per_s'))}/s"
    errors = can["error_counters"]
    if errors:
        text += f", error counters {errors[0]:.0f}/{errors[1]:.0f}"
    state = (can["state"], STATES.get(can["state"], "bold red"))
    yield line(f"CAN {can['channel']}: ", state, text)
    labels = {
        "sent_frames": "sent",
        "dropped_frames": "dropped",
        "send_failures": "send failures",
        "bus_off_count": "bus-off",
        "can_restarts": "restarts",
        "id_conflicts": "id conflicts",
    }
    counts = ", ".join(
        f"{number(can['counters'][key])} {label}".replace(" ", NO_BREAK)
        for key, label in labels.items()
    )
    yield from wrapped(f"     total: {counts}", "dim", _WIDTH)


def _esc_rows(document: Document) -> Iterator[list[Part]]:
    yield [(head, "dim") for head in _WIDTHS]
    for esc in document["escs"]:
        values = esc["values"]
        counters = esc["counters"]
        link = esc["link"]
        style = STATES.get(link, "bold red") if esc["fresh"] else "bold red"
        yield [
            esc["name"][:12],
            (words(link)[:10], style),
            number(esc["frame_rate_hz"]),
            _age(esc["data_age_ms"]),
            number(values["battery_voltage"], 2),
            number(values["battery_current"], 1),
            number(values["motor_speed"]),
            number(values["power_stage_temperature"]),
            number(counters["crc_errors"]),
            number(sum(esc["port"]["line_errors"].values()) or counters["line_errors"]),
            number(esc["losses"]),
        ]


def _duration(seconds: float) -> str:
    """Return a duration as text.

    Raises TypeError or ValueError for other values. A text is not multiplied, because the result
    would fill the memory.
    """
    return duration(round(float(seconds) * SECOND))


def _age(age_ms: float | None) -> str:
    if age_ms is None:
        return "-"
    if age_ms < 1000:
        return f"{age_ms:.0f} ms"
    return _duration(age_ms / 1000)


def alarms(document: Document) -> list[tuple[str, Alarm]]:
    """Return the errors and warnings that the ESCs report, each with its ESC's name."""
    found = []
    for esc in document["escs"]:
        bits = protocol_named(esc.get("protocol")).bits
        flags: list[Alarm] = []
        for key in ("errors", "selftest_errors", "warnings"):
            severity = Severity.WARNING if key == "warnings" else Severity.ERROR
            for name in esc[key] or ():
                flags.append(bits[name] if name in bits else Flag(name, severity, name))
        found += [(f"{esc['name']} ", flag) for flag in alarms_of(flags)]
    return found


def _further(document: Document) -> Iterator[Text]:
    """Yield lines about CANopen nodes and their PDOs per second, stored parameters and captures."""
    rates = (document.get("rates") or {}).get("pdos_per_s", [])
    for index, node in enumerate(document["nodes"]):
        state = "waits for LSS"
        if node["node_id"] is not None:
            state = f"node {node['node_id']} {node['state']}"
            if index < len(rates):
                state += f", {rates[index]:.0f} PDOs/s"
        yield line(f"{node['esc']}: {state}")
    for output in document.get("outputs", {}).values():  # documents of 0.5.0 do not have it
        for text in output["lines"]:
            yield from wrapped(printable(text), "", _WIDTH)
    store = document["store"]
    if store and store["waiting"] > 0:
        yield line((f"{store['waiting']} parameters are waiting for the disk", "yellow"))
    recording = document["recording"]
    if recording and recording["file"]:
        lost = f", {recording['lost']:.0f} entries lost" if recording["lost"] else ""
        size = f"{recording['bytes'] / 1e6:.1f} MB"
        yield line(f"recording to {recording['file']}, {size}", (lost, "yellow"))
    if recording and recording.get("on_event"):  # documents before 0.6 do not have it
        yield from _events(recording)


def _events(recording: Document) -> Iterator[Text]:
    """Yield lines about the recording on events."""
    event = recording["event"]
    if not recording["file"]:
        is_waiting = event is not None and not event["file"]
        awaited = "the disk" if is_waiting else "an event"
        size = f"{recording['ring_bytes'] / 1e6:.1f} MB"
        yield line(f"recording waits for {awaited}, with {size} in memory")
    if event is not None:
        about = event_in_words(event["esc"], event["reason"])
        place = event["file"] or "not recorded yet"
        text = f"last event at {event['time']}: {about}, {place}"
        yield from wrapped(printable(text), "", _WIDTH)
