"""The state of a running gateway from its statistics file: an exit code, faults in words, lines for a terminal."""

import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.text import Text

from kontronik_can_gw.desk.monitor.lines import (
    BAD,
    FAINT,
    GOOD,
    LINKS,
    POOR,
    Alarm,
    Part,
    age_text,
    alarm_lines,
    compact,
    cut,
    duration,
    line,
    number,
    table,
    wrapped,
)
from kontronik_can_gw.esc.decoder import Severity
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.native.load import in_words
from kontronik_can_gw.printable import printable
from kontronik_can_gw.runtime.process import pid_namespace, start_ticks
from kontronik_can_gw.runtime.snapshot import FORMAT, PROGRAM, STALE_NS

HEALTHY, TROUBLE, NOT_RUNNING = 0, 1, 3
_LARGEST_FILE = 1 << 22
FOREIGN = f"is not a statistics file of {PROGRAM}. Look at statistics.file."
MALFORMED = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError)
"""What a document with values of another type raises."""
_CAN_STYLES = {"error-active": GOOD, "unknown": "", "error-warning": POOR, "error-passive": POOR}
_MAX_ALARM_LINES = 6
"""On a live display."""
_COLUMNS = ("ESC", "link", "Hz", "age", "V", "A", "1/min", "°C", "CRC", "line", "lost")
_WIDTHS = (3, 10, 3, 5, 5, 6, 6, 3, 5, 4, 4)

Document = Mapping[str, Any]


@dataclass(frozen=True)
class Seen:
    """Result for one gateway: exit code, a sentence, faults, and its document or None."""

    file: Path
    code: int
    sentence: str
    troubles: tuple[str, ...] = ()
    age_s: float | None = None
    document: Document | None = None

    def as_json(self) -> dict[str, Any]:
        return {
            "file": printable(str(self.file)),
            "exit_code": self.code,
            "status": self.sentence,
            "troubles": list(self.troubles),
            "age_s": None if self.age_s is None else round(self.age_s, 3),
            "document": self.document,
        }


# --- from a file to an exit code


def look_at(file: Path, now: int) -> Seen:
    """The result of a statistics file at ``now`` (monotonic)."""

    def not_running(text: str) -> Seen:
        return Seen(file, NOT_RUNNING, f"{file}: {text}")

    try:
        if file.exists() and not file.is_file():  # reading a pipe would block
            return not_running("is no plain file. Look at statistics.file.")
        with file.open("rb") as opened:
            document = json.loads(opened.read(_LARGEST_FILE))
    except FileNotFoundError:
        return not_running(
            "not running: there is no such file. Start the gateway whose statistics.file it is."
        )
    except OSError as error:
        return not_running(f"cannot be read: {error.strerror}. Try it with sudo.")
    except (ValueError, RecursionError):
        return not_running(FOREIGN)
    if not isinstance(document, dict) or document.get("program") != PROGRAM:
        return not_running(FOREIGN)
    if document.get("format") != FORMAT:
        return not_running(f"is of another version of {PROGRAM} ({document.get('version')}).")
    return judge(file, document, now)


def judge(file: Path, document: Document, now: int) -> Seen:
    """The exit code for a document, with the faults in words."""
    try:
        seen = _judge(file, document, now)
        _lines(seen, document, None)
    except MALFORMED:
        return Seen(file, NOT_RUNNING, f"{file}: {FOREIGN}")
    return seen


def _judge(file: Path, document: Document, now: int) -> Seen:
    age = now - document["monotonic_ns"]
    age_s = age / SECOND
    if age < -STALE_NS or not _is_alive(document["process"]):  # or the machine restarted since
        return Seen(file, NOT_RUNNING, "not running", (), age_s, document)
    if age > STALE_NS:
        text = f"does not answer since {duration(age_s)} (stopped, or the disk of its file is full)"
        return Seen(file, NOT_RUNNING, text, (), age_s, document)
    troubles = tuple(map(printable, _troubles(document)))
    sentence = printable(document["gateway"]["state"])
    if troubles:
        sentence += f", {len(troubles)} fault{'s' if len(troubles) > 1 else ''}"
    return Seen(file, TROUBLE if troubles else HEALTHY, sentence, troubles, age_s, document)


def _troubles(document: Document) -> Iterator[str]:
    can = document["can"]
    channel = f"CAN {can['channel']}"
    if not can["open"] or can["state"] == "down":
        yield can["complaint"] or f"{channel} is down"
    elif can["state"] == "bus-off":
        yield can["complaint"] or f"{channel} is bus-off"
    elif can["stalled"]:
        yield can["complaint"] or f"{channel}: no frame can be sent"
    for esc in document["escs"]:
        if esc["fresh"]:
            continue
        port, reason = esc["port"], esc["diagnosis"]
        if not port["open"]:
            since = "" if port["lost_for_s"] is None else f" for {duration(port['lost_for_s'])}"
            complaint = (port["complaint"] or "").removeprefix(f"{esc['name']}: ")
            reason = f"port not open{since}: {complaint or port['path']}"
        yield f"{esc['name']}: {reason or 'no telemetry'}"
    if (store := document["store"]) and store["last_error"]:
        yield f"parameters cannot be stored: {store['last_error']}"
    if (recording := document["recording"]) and recording["problem"]:
        yield f"captures: {recording['problem']}"


def _is_alive(process: Document) -> bool:
    """True if the writing process still runs, or if that cannot be found out."""
    pid, ticks = process["pid"], process["start_ticks"]
    if pid <= 0 or process["pid_namespace"] != pid_namespace():
        return True
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # another user's
        pass
    now = start_ticks(pid)
    return now >= 0 and (now == 0 or ticks == 0 or now == ticks)


# --- lines


def screen(seen: Seen, size: tuple[int, int] | None = None) -> list[Text]:
    """Everything about one gateway, most important first; cut to ``size`` (columns, lines) if given."""
    width, height = size or (None, None)
    if seen.document is None:
        return wrapped(seen.sentence, BAD, width)
    lines, log = _lines(seen, seen.document, width)
    room = len(log) if height is None else height - len(lines) - 1
    if log and room > 0:
        lines += [line(("last events:", FAINT)), *log[-room:]]
    return cut(lines, height, "lines more: --once shows them")


def _lines(seen: Seen, document: Document, width: int | None) -> tuple[list[Text], list[Text]]:
    """What is known of a gateway, and its last events."""
    lines = list(_head(seen, document, width))
    log = [line((f"  {each}", FAINT)) for each in document["log"]]
    if seen.code == NOT_RUNNING:
        return lines, log
    lines += [*_can_lines(document), line(), *_esc_lines(document, width)]
    for trouble in seen.troubles:
        lines += wrapped(trouble, BAD, width)
    lines += alarm_lines(_alarms(document), width, None if width is None else _MAX_ALARM_LINES)
    lines += _node_lines(document, width)
    for output in document.get("outputs", {}).values():  # 0.5.0 had none
        for text in output["lines"]:
            lines += wrapped(printable(text), "", width)
    if (store := document["store"]) and store["waiting"] > 0:
        lines.append(line((f"{store['waiting']} parameters wait for the disk", POOR)))
    if (recording := document["recording"]) and recording["file"]:
        text, lost = f"recording to {recording['file']}", recording["lost"]
        lines.append(line(f"{text}, {recording['bytes'] / 1e6:.1f} MB"))
        if lost:
            lines[-1].append(f", {lost:.0f} entries lost", POOR)
    return lines, log


def _head(seen: Seen, document: Document, width: int | None) -> Iterator[Text]:
    process, gateway = document["process"], document["gateway"]
    program, where = f"{PROGRAM} {document['version']}", document["configuration"]
    if seen.code == NOT_RUNNING:
        yield from wrapped(f"{program}  {seen.sentence}", BAD, width)
        yield line((f"{where}, last heard of {document['time']}", FAINT))
        yield line((f"Why? journalctl -e -u '{PROGRAM}*'", FAINT))
        return
    style = f"bold {GOOD if seen.code == HEALTHY else POOR}"
    first = line(f"{program}  ", (seen.sentence, style))
    heard = f"  {gateway['escs_ok']} of {gateway['esc_count']} ESCs heard"
    yield line(first, f"{heard}, up {duration(process['uptime_s'])}")
    memory = f"{process['rss_bytes'] // 1_000_000} MB"
    yield line((f"process {process['pid']}, {memory}, {where}", FAINT))
    if "core" in gateway:  # 0.5.0 had but one
        yield line((in_words(gateway["core"], gateway["core_reason"]), FAINT))


def _can_lines(document: Document) -> Iterator[Text]:
    can, rates = document["can"], document.get("rates") or {}
    text = "" if not can["bitrate"] else f", {can['bitrate'] / 1000:g} kbit/s"
    for name, what in (("sent_frames", "sent"), ("received_frames", "received")):
        rate = rates.get(f"{name}_per_s")
        text += f", {what} {'-' if rate is None else f'{rate:.0f}'}/s"
    if errors := can["error_counters"]:
        text += f", error counters {errors[0]:.0f}/{errors[1]:.0f}"
    state = can["state"]
    yield line(f"CAN {can['channel']}: ", (state, _CAN_STYLES.get(state, BAD)), text)
    shown = (
        ("sent_frames", "sent"),
        ("dropped_frames", "dropped"),
        ("send_failures", "send failures"),
        ("bus_off_count", "bus-off"),
        ("id_conflicts", "id conflicts"),
    )
    counts = ", ".join(f"{compact(can['counters'][key])} {what}" for key, what in shown)
    yield line((f"     in all: {counts}", FAINT))


def _esc_lines(document: Document, width: int | None) -> list[Text]:
    """One line for each ESC, at most 80 columns wide."""
    rows: list[list[Part]] = [[(head, FAINT) for head in _COLUMNS]]
    for esc in document["escs"]:
        values, counters = esc["values"], esc["counters"]
        line_errors = sum(esc["port"]["line_errors"].values()) or counters["line_errors"]
        rows.append(
            [
                esc["name"][:12],
                (
                    esc["link"].replace("-", " ")[:10],
                    LINKS.get(esc["link"], "") if esc["fresh"] else BAD,
                ),
                number(esc["frame_rate_hz"], 0),
                age_text(esc["data_age_ms"]),
                number(values["battery_voltage"], 2),
                number(values["battery_current"], 1),
                number(values["motor_speed"], 0),
                number(values["power_stage_temperature"], 0),
                compact(counters["crc_errors"]),
                compact(line_errors),
                compact(esc["losses"]),
            ]
        )
    return table(rows, width, 2, _WIDTHS)


def _alarms(document: Document) -> list[Alarm]:
    """Errors and warnings that the ESCs report."""
    found = []
    for esc in document["escs"]:
        bits = protocol_named(esc.get("protocol")).bits
        summaries = {bit.text for bit in bits.values() if bit.is_summary}
        for key in ("errors", "selftest_errors", "warnings"):
            names = esc[key] or []
            for name in [each for each in names if each not in summaries] or names:
                bit = bits.get(name)
                severity = Severity.WARNING if key == "warnings" else Severity.ERROR
                meaning, remedy = (name, "") if bit is None else (bit.meaning, bit.remedy)
                text = f"{esc['name']} {severity.value.upper()}: {meaning}"
                found.append(Alarm(severity, text, remedy))
    return found


def _node_lines(document: Document, width: int | None) -> list[Text]:
    """The CANopen nodes with their PDOs per second, as many in a line as fit."""
    rates = (document.get("rates") or {}).get("pdos_per_s", [])
    texts = []
    for at, node in enumerate(document["nodes"]):
        state = "waits for LSS"
        if node["node_id"] is not None:
            rate = f", {rates[at]:.0f}/s" if at < len(rates) else ""
            state = f"node {node['node_id']} {node['state']}{rate}"
        texts.append(f"{node['esc']}: {state}")
    longest = max(map(len, texts), default=0) + 2
    count = max(1, ((width or 80) + 2) // longest)
    rows = [texts[first : first + count] for first in range(0, len(texts), count)]
    return [line("".join(text.ljust(longest) for text in row).rstrip()) for row in rows]
