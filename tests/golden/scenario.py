"""Scenarios: what is given to a gateway and what it sends, as text with times (README.md). ``play`` writes what is sent anew."""

import re
import struct
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from drive import CanFrame, Drive, frame, replayed, shipped_eds
from esc import reference, sheet

SECOND = 10**9
INPUTS = Path(__file__).parent / "inputs"


def seconds(ns: int) -> str:
    """Seconds with three decimals, or as many as it takes."""
    text = f"{ns // SECOND}.{ns % SECOND:09d}"
    return text[:-6] + text[-6:].rstrip("0")


def nanoseconds(text: str) -> int:
    whole, _, part = text.partition(".")
    return int(whole) * SECOND + int(part.ljust(9, "0"))


def frame_text(of: CanFrame) -> str:
    """As in a candump log: 8 digits for 29 bits, ## and flags for CAN FD, R for a remote frame."""
    can_id = f"{of.can_id:08X}" if of.extended else f"{of.can_id:03X}"
    if of.remote:
        return f"{can_id}#R"
    return f"{can_id}{'##1' if of.fd else '#'}{of.data.hex().upper()}"


def read_frame(text: str) -> CanFrame:
    can_id, _, data = text.partition("#")
    fd, remote = data.startswith("#"), data.startswith("R")
    content = b"" if remote else bytes.fromhex(data[2 if fd else 0 :])
    return frame(int(can_id, 16), content, len(can_id) > 3, fd, remote)


def uart_bytes(words: list[str]) -> bytes:
    """Bytes in hexadecimal, or a frame: ``live`` or ``info`` (``.legacy``), then fields in steps of the wire; others are 0."""
    kind, _, layout = words[0].partition(".")
    if kind not in ("live", "info"):
        return bytes.fromhex("".join(words))
    given = {name: int(value, 0) for name, value in (word.split("=") for word in words[1:])}
    fields = sheet.LIVE_FIELDS if kind == "live" else sheet.INFO_FIELDS
    assert set(given) <= {field.name for field in fields}, f"no field of the sheet: {given}"
    body = struct.pack(
        sheet.LIVE_STRUCT if kind == "live" else sheet.INFO_STRUCT,
        *(given.get(f.name, 0) for f in fields),
    )
    row = reference.form_row(kind, layout or "v4")
    return reference.seal(row, body.ljust(row.crc_at - 4, b"\0"))


def split(text: str) -> tuple[str, list[str]]:
    """The configuration in front, and the lines from the first one with a time on."""
    lines = text.splitlines()
    first = next((n for n, line in enumerate(lines) if re.match(r"\d+\.\d+ ", line)), len(lines))
    while first and lines[first - 1].startswith(";"):
        first -= 1
    return "\n".join(lines[:first]) + "\n", lines[first:]


class Player:
    """A gateway and the time. ``out``: the lines so far."""

    def __init__(self, drive: Drive) -> None:
        self.drive = drive
        self.now = 0
        self.out: list[str] = []
        self._heard: list[CanFrame] = []

    def pass_time(self, until: int) -> None:
        """Advance at each deadline before ``until``."""
        while (due := max(self.now, self.drive.deadline)) < until:
            self.now = due
            self.drive.advance(due)
            assert self.drive.deadline > due, "a deadline that does not move on"
            self._collect()
            self.write_down()

    def input(self, time: int, verb: str, words: list[str]) -> str:
        """One line that is given; what is to be written after it: what an SDO transfer gave."""
        self.now = time
        drive = self.drive
        found = ""
        if verb == "<-":
            drive.put(read_frame(words[0]), time)
        elif verb == "uart":
            drive.uart(int(words[0]) - 1, uart_bytes(words[1:]), time)
        elif verb in ("read", "write"):
            found = self._sdo(verb, int(words[0]), words[1], bytes.fromhex("".join(words[2:])))
        elif verb not in ("-", "held"):
            drive.happen(verb, words, time)
        if verb != "held":
            drive.advance(time)
        self._collect()
        return found

    def write_down(self) -> None:
        self.out += [f"{seconds(self.now)} -> {frame_text(sent)}" for sent in self._heard]
        self._heard = []
        self.out += [f"{seconds(self.now)} => {news}" for news in self.drive.news()]

    def _collect(self) -> None:
        self._heard += self.drive.take()

    def _ask(self, node: int, request: bytes) -> bytes | None:
        """One SDO request; its answer, taken out of what was heard."""
        self.drive.put(frame(0x600 + node, request), self.now)
        self._collect()
        answers = [f.data for f in self._heard if f.can_id == 0x580 + node]
        self._heard = [f for f in self._heard if f.can_id != 0x580 + node]
        assert len(answers) < 2, "several answers"
        return answers[0] if answers else None

    def _sdo(self, verb: str, node: int, entry: str, data: bytes) -> str:
        """A transfer, expedited or in segments: ``= data`` of a read, ``! abort code``, nothing without an answer."""
        index, _, sub = entry.partition(":")
        multiplexer = int(index, 16).to_bytes(2, "little") + bytes((int(sub, 16),))
        size = len(data)
        parts: list[bytes] = []
        if verb == "read":
            request = b"\x40" + multiplexer + bytes(4)
        elif 1 <= size <= 4:
            head = bytes((0x23 | 4 - size << 2,))
            request = head + multiplexer + data.ljust(4, b"\0")
        else:
            request = b"\x21" + multiplexer + size.to_bytes(4, "little")
            parts = [data[at : at + 7] for at in range(0, size, 7)]
        if (answer := self._ask(node, request)) is None:
            return ""
        if verb == "read" and answer[0] & 0xE2 == 0x42:
            return f" = {answer[4 : 8 - (answer[0] >> 2 & 3)].hex().upper()}"
        found, toggle = b"", 0
        while answer[0] != 0x80 and (parts or verb == "read"):
            request = bytes((0x60 | toggle,)) + bytes(7)
            if verb == "write":
                part = parts.pop(0)
                head = bytes((toggle | (7 - len(part)) << 1 | (not parts),))
                request = head + part.ljust(7, b"\0")
            answer = self._ask(node, request) or b"\x80" + bytes(7)
            found += answer[1 : 8 - (answer[0] >> 1 & 7)]
            toggle ^= 0x10
            if verb == "read" and answer[0] & 1:
                break
        if answer[0] == 0x80:
            return f" ! {int.from_bytes(answer[4:], 'little'):08X}"
        return f" = {found.hex().upper()}" if verb == "read" else ""


def changed_eds(changes: Mapping[str, Mapping[str, str]]) -> str:
    """The shipped EDS with other keys in some sections; a key with an empty text goes, a section without keys too."""
    text = shipped_eds()
    for section, keys in changes.items():
        found = re.search(
            rf"^\[{section}\]\r?\n(?:(?!\[).*\r?\n)*", text, re.MULTILINE | re.IGNORECASE
        )
        assert found is not None, f"no section {section}"
        body = found[0]
        for key, value in keys.items():
            body = re.sub(rf"^{key}=.*\r?\n", "", body, flags=re.MULTILINE)
            if value:
                head, _, rest = body.partition("\n")
                body = f"{head}\n{key}={value}\r\n{rest}"
        text = text.replace(found[0], body if keys else "")
    return text


def play(text: str) -> str:
    """The scenario with what is sent now in place of what was."""
    header, lines = split(text)
    tables: dict[str, Any] = tomllib.loads(header)
    golden = tables.pop("golden", {})
    with TemporaryDirectory() as folder:
        if "eds" in golden:
            (Path(folder) / "changed.eds").write_bytes(changed_eds(golden["eds"]).encode("latin-1"))
            tables["canopen"]["eds"] = f"{folder}/changed.eds"
        player = Player(Drive(tables, INPUTS / "scenario.toml"))
    player.out = header.splitlines() + [
        f"; warning: {warning}" for warning in player.drive.warnings
    ]
    if golden.get("start", True):
        for esc in range(len(tables["esc"])):
            player.drive.happen("port_opened", [str(esc + 1)], 0)
        player.input(0, "start", [])
        player.write_down()
    comments = dict(line.split(";", 1) for line in lines if re.match(r"[\d.]+ ->.*;", line))
    comments = {sent.strip(): comment for sent, comment in comments.items()}
    held = False
    for line in lines:
        body = line.partition(";")[0].strip()
        if not body:
            if not line.startswith("; warning: "):
                player.out.append(line)
            continue
        time, verb, *words = body.split()
        if verb in ("->", "=>"):
            continue
        at = nanoseconds(time)
        assert at >= player.now, f"lines in the order of time: {line}"
        if not held:
            player.pass_time(at)
        held = verb == "held"
        if verb in ("read", "write"):
            for mark in ("=", "!"):
                words = words[: words.index(mark)] if mark in words else words
        found = player.input(at, verb, words)
        given = line
        if verb in ("read", "write"):
            comment = line.partition(";")[2]
            given = " ".join((time, verb, *words)) + found + (f"  ;{comment}" if comment else "")
        player.out.append(given)
        player.write_down()
    player.out = [f"{line}  ;{comments[line]}" if line in comments else line for line in player.out]
    return "\n".join(player.out) + "\n"


def replay(capture: Path) -> str:
    """What a capture's gateway received and sent; times from the first frame on."""
    return "\n".join(_replay(capture)) + "\n"


def _replay(capture: Path) -> Iterator[str]:
    start = None
    for time, item, received in replayed(capture):
        if start is None:
            start = time
            yield f"; capture {capture.name}, time 0 is {time} ns of its clock"
        yield f"{seconds(time - start)} {'<-' if received else '->'} {frame_text(item)}"
