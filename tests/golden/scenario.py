"""Scenarios: the input and the output of a gateway, as lines of text with times (see README.md).

``play`` runs a scenario and returns it with the current output.
"""

import re
import struct
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import specification
from drive import CanFrame, Drive, frame, replayed, shipped_eds
from esc import reference

SECOND = 10**9
INPUTS = Path(__file__).parent / "inputs"


def seconds(ns: int) -> str:
    """Return a time in seconds, with three decimals or more if the time needs them."""
    text = f"{ns // SECOND}.{ns % SECOND:09d}"
    return text[:-6] + text[-6:].rstrip("0")


def nanoseconds(text: str) -> int:
    whole, _, part = text.partition(".")
    return int(whole) * SECOND + int(part.ljust(9, "0"))


def frame_text(of: CanFrame) -> str:
    """Return a frame as in a candump log.

    A 29-bit id has 8 digits, CAN FD has ## and flags, and a remote frame has R.
    """
    digits = 8 if of.extended else 3
    can_id = f"{of.can_id:0{digits}X}"
    if of.remote:
        return f"{can_id}#R"
    mark = "##1" if of.fd else "#"
    data = of.data.hex().upper()
    return f"{can_id}{mark}{data}"


def read_frame(text: str) -> CanFrame:
    can_id, _, data = text.partition("#")
    is_extended = len(can_id) > 3
    if data.startswith("R"):
        return frame(int(can_id, 16), b"", is_extended, remote=True)
    is_fd = data.startswith("#")
    digits = data[2:] if is_fd else data
    return frame(int(can_id, 16), bytes.fromhex(digits), is_extended, is_fd)


def uart_bytes(words: list[str]) -> bytes:
    """Return the bytes that the words of a ``uart`` line describe.

    The words are hexadecimal digits, or they describe a frame: ``live`` or ``info``, perhaps with
    ``.legacy``, and then fields in steps of the wire. Fields that are not given are 0.
    """
    kind, _, layout = words[0].partition(".")
    if kind not in ("live", "info"):
        return bytes.fromhex("".join(words))
    given = {}
    for word in words[1:]:
        name, value = word.split("=")
        given[name] = int(value, 0)
    if kind == "live":
        fields = specification.LIVE_FIELDS
        structure = specification.LIVE_STRUCT
    else:
        fields = specification.INFO_FIELDS
        structure = specification.INFO_STRUCT
    names = [field.name for field in fields]
    assert set(given) <= set(names), f"no field of the protocol specification: {given}"
    values = [given.get(name, 0) for name in names]
    body = struct.pack(structure, *values)
    row = reference.form_row(kind, layout or "v4")
    return reference.seal(row, body.ljust(row.crc_at - 4, b"\0"))


def split(text: str) -> tuple[str, list[str]]:
    """Return the configuration, and all lines from the first one with a time.

    Comments directly before that line are part of the lines.
    """
    lines = text.splitlines()
    timed = (n for n, line in enumerate(lines) if re.match(r"\d+\.\d+ ", line))
    first = next(timed, len(lines))
    while first and lines[first - 1].startswith(";"):
        first -= 1
    return "\n".join(lines[:first]) + "\n", lines[first:]


class Player:
    """A gateway, its clock, and in ``out`` the lines written until now."""

    def __init__(self, drive: Drive) -> None:
        self.drive = drive
        self.now = 0
        self.out: list[str] = []
        self._heard: list[CanFrame] = []

    def pass_time(self, until: int) -> None:
        """Advance the gateway at each deadline before ``until``."""
        due = max(self.now, self.drive.deadline)
        while due < until:
            self.now = due
            self.drive.advance(due)
            assert self.drive.deadline > due, "a deadline that does not move on"
            self._collect()
            self.write_down()
            due = max(self.now, self.drive.deadline)

    def input(self, time: int, verb: str, words: list[str]) -> str:
        """Give one line of input to the gateway.

        Returns the result of an SDO transfer, which is written at the end of the line, or "".
        """
        self.now = time
        drive = self.drive
        result = ""
        if verb == "<-":
            drive.put(read_frame(words[0]), time)
        elif verb == "uart":
            drive.uart(int(words[0]) - 1, uart_bytes(words[1:]), time)
        elif verb in ("read", "write"):
            data = bytes.fromhex("".join(words[2:]))
            result = self._sdo(verb, int(words[0]), words[1], data)
        elif verb not in ("-", "held"):
            drive.happen(verb, words, time)
        if verb != "held":
            drive.advance(time)
        self._collect()
        return result

    def write_down(self) -> None:
        """Append the frames and the news since the last call to the lines."""
        now = seconds(self.now)
        for sent in self._heard:
            self.out.append(f"{now} -> {frame_text(sent)}")
        self._heard = []
        for news in self.drive.news():
            self.out.append(f"{now} => {news}")

    def _collect(self) -> None:
        self._heard += self.drive.take()

    def _ask(self, node: int, request: bytes) -> bytes | None:
        """Send one SDO request. Returns its answer and removes it from the frames heard."""
        self.drive.put(frame(0x600 + node, request), self.now)
        self._collect()
        answer_id = 0x580 + node
        answers = [f.data for f in self._heard if f.can_id == answer_id]
        self._heard = [f for f in self._heard if f.can_id != answer_id]
        assert len(answers) < 2, "several answers"
        return answers[0] if answers else None

    def _sdo(
        self,
        verb: str,
        node: int,
        entry: str,
        data: bytes,
    ) -> str:
        """Make an SDO transfer, expedited or in segments.

        Returns ``= data`` for a read, ``! code`` for an abort, and "" for a write or without an
        answer.
        """
        index, _, sub = entry.partition(":")
        multiplexer = int(index, 16).to_bytes(2, "little")
        multiplexer += bytes((int(sub, 16),))
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
        answer = self._ask(node, request)
        if answer is None:
            return ""
        if verb == "read" and answer[0] & 0xE2 == 0x42:
            end = 8 - (answer[0] >> 2 & 3)
            return f" = {answer[4:end].hex().upper()}"
        found = b""
        toggle = 0
        while answer[0] != 0x80 and (parts or verb == "read"):
            request = bytes((0x60 | toggle,)) + bytes(7)
            if verb == "write":
                part = parts.pop(0)
                is_last = not parts
                unused = 7 - len(part)
                head = bytes((toggle | unused << 1 | is_last,))
                request = head + part.ljust(7, b"\0")
            answer = self._ask(node, request) or b"\x80" + bytes(7)
            end = 8 - (answer[0] >> 1 & 7)
            found += answer[1:end]
            toggle ^= 0x10
            if verb == "read" and answer[0] & 1:
                break
        if answer[0] == 0x80:
            code = int.from_bytes(answer[4:], "little")
            return f" ! {code:08X}"
        if verb == "read":
            return f" = {found.hex().upper()}"
        return ""


def changed_eds(changes: Mapping[str, Mapping[str, str]]) -> str:
    """Return the shipped EDS with other keys in some sections.

    A key with an empty text is removed. A section for which no keys are given is removed.
    """
    text = shipped_eds()
    for section, keys in changes.items():
        found = re.search(
            rf"^\[{section}\]\r?\n(?:(?!\[).*\r?\n)*",
            text,
            re.MULTILINE | re.IGNORECASE,
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
    """Return the scenario with the current output in place of the old output."""
    header, lines = split(text)
    tables: dict[str, Any] = tomllib.loads(header)
    golden = tables.pop("golden", {})
    player = _player(tables, golden)
    player.out = header.splitlines()
    for warning in player.drive.warnings:
        player.out.append(f"; warning: {warning}")
    if golden.get("start", True):
        for esc in range(len(tables["esc"])):
            player.drive.happen("port_opened", [str(esc + 1)], 0)
        player.input(0, "start", [])
        player.write_down()
    _play_lines(player, lines)
    comments = _comments_of_output(lines)
    for number, line in enumerate(player.out):
        if line in comments:
            player.out[number] = f"{line}  ;{comments[line]}"
    return "\n".join(player.out) + "\n"


def _player(tables: dict[str, Any], golden: Mapping[str, Any]) -> Player:
    with TemporaryDirectory() as folder:
        if "eds" in golden:
            eds = Path(folder) / "changed.eds"
            eds.write_bytes(changed_eds(golden["eds"]).encode("latin-1"))
            tables["canopen"]["eds"] = str(eds)
        return Player(Drive(tables, INPUTS / "scenario.toml"))


def _comments_of_output(lines: list[str]) -> dict[str, str]:
    """Return the comments after sent frames, by the text of the frame's line."""
    comments = {}
    for line in lines:
        if re.match(r"[\d.]+ ->.*;", line):
            sent, comment = line.split(";", 1)
            comments[sent.strip()] = comment
    return comments


def _play_lines(player: Player, lines: list[str]) -> None:
    """Give the lines of input to the gateway, and write all lines with the current output."""
    held = False
    for line in lines:
        body, _, comment = line.partition(";")
        if not body.strip():
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
                if mark in words:
                    words = words[: words.index(mark)]
        result = player.input(at, verb, words)
        given = line
        if verb in ("read", "write"):
            given = " ".join((time, verb, *words)) + result
            if comment:
                given += f"  ;{comment}"
        player.out.append(given)
        player.write_down()


def replay(capture: Path) -> str:
    """Return the frames that a capture's gateway received and sent, as lines of a scenario.

    Times count from the first frame.
    """
    return "\n".join(_replay(capture)) + "\n"


def _replay(capture: Path) -> Iterator[str]:
    start = None
    for time, item, received in replayed(capture):
        if start is None:
            start = time
            yield f"; capture {capture.name}, time 0 is {time} ns of its clock"
        arrow = "<-" if received else "->"
        yield f"{seconds(time - start)} {arrow} {frame_text(item)}"
