"""The recordings in the folder of captures, and the files that are made from them.

A summary, report or table is made by a child process with low priority and limits, one at a time.
It is kept in the cache folder until its capture changes. Requests name a recording by an id from
the list, never by a path.
"""

import asyncio
import contextlib
import hashlib
import importlib.util
import json
import os
import re
import resource
import stat
import sys
import time
from collections.abc import AsyncIterator
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import BaseRoute, Route

from kontronik_can_gw import __version__
from kontronik_can_gw.capture.format import SUFFIX
from kontronik_can_gw.desk.live.access import is_command
from kontronik_can_gw.desk.report.page import policy
from kontronik_can_gw.runtime.files.disk import is_locked

_PACKAGE = "kontronik_can_gw"
_SUMMARY = "summary"
_COMMANDS = {
    _SUMMARY: (f"{_PACKAGE}.desk.live.summary", "{source}", "{output}"),
    "report": (_PACKAGE, "report", "{source}", "-o", "{output}", "--force"),
    "csv": (_PACKAGE, "convert", "{source}", "{output}", "--force"),
    "parquet": (_PACKAGE, "convert", "{source}", "{output}", "--force"),
}
"""Module and arguments of the child process for each kind of file."""
_PART = re.compile(r"(.+)-[0-9]+$")
"""Name of a part of a run without its suffix."""
_LIMIT_S = 1800
"""Longest time that a child process may take."""
_LIMIT_BYTES = 768 << 20
"""Most memory that a child process may allocate."""
_CACHE_BYTES = 512 << 20
"""Most memory on the disk that made files may have. The oldest are removed."""
_POLL_S = 0.5
_LOOKED_AT_S = 10.0
"""Summaries are made until this time after the last request for the list."""
_NICE = 19
_OOM_ADJUSTMENT = "900"


class Recording(NamedTuple):
    """The captures of one run."""

    name: str
    paths: tuple[Path, ...]
    size: int
    changed_ns: int

    @property
    def id(self) -> str:
        return _digest(self.name)

    @property
    def is_written(self) -> bool:
        """True while a gateway writes the last capture."""
        return is_locked(self.paths[-1])

    @property
    def key(self) -> str:
        """Name of files that are made of this content by this version."""
        return _digest(f"{self.name} {self.size} {self.changed_ns} {__version__} {policy()}")


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()[:24]


def recordings_in(folder: Path) -> list[Recording]:
    """Return the recordings of a folder, newest first. Raises OSError if it cannot be read."""
    runs: dict[str, list[tuple[Path, os.stat_result]]] = {}
    for path in sorted(folder.iterdir()):
        with contextlib.suppress(FileNotFoundError):
            status = path.lstat()
            if path.suffix == SUFFIX and stat.S_ISREG(status.st_mode):
                run = _PART.sub(r"\1", path.stem)
                runs.setdefault(run, []).append((path, status))
    found = []
    for name, parts in runs.items():
        paths = tuple(path for path, _ in parts)
        size = sum(status.st_size for _, status in parts)
        changed_ns = max(status.st_mtime_ns for _, status in parts)
        found.append(Recording(name, paths, size, changed_ns))
    return sorted(found, key=attrgetter("changed_ns", "name"), reverse=True)


class Flights:
    """The list of flights, and the worker that makes their files."""

    def __init__(
        self, folder: Path | None = None, min_free_mb: int = 0, cache: Path = Path()
    ) -> None:
        self._folder = folder
        self._cache = cache / "flights"
        self._min_free_mb = min_free_mb
        self._recordings: dict[str, Recording] = {}
        self._jobs: dict[tuple[str, str], Recording] = {}
        """The requested files in their order, by id and kind."""
        self._failed: dict[tuple[str, str], str] = {}
        """Reason why a file could not be made, by key and kind."""
        self._current: tuple[Recording, str] | None = None
        """The recording and the kind of the file that is being made."""
        self._progress = 0.0
        self._process: asyncio.subprocess.Process | None = None
        self._looked_at = float("-inf")
        self._awake = asyncio.Event()

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Make files while the context is open."""
        task = asyncio.create_task(self._work())
        try:
            yield
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    def routes(self) -> list[BaseRoute]:
        return [
            Route("/flights.json", self._list),
            Route("/flights/{id}/capture/{part:int}", self._capture),
            Route("/flights/{id}/{kind}", self._file),
            Route("/make/{id}/{kind}", self._request),
        ]

    # --- answers

    async def _list(self, _: Request) -> Response:
        self._looked_at = time.monotonic()
        content = await asyncio.to_thread(self._content)
        self._awake.set()
        return JSONResponse(content)

    def _recording(self, request: Request) -> Recording:
        """Return the recording of a request. Raises HTTPException if there is none."""
        recording = self._recordings.get(request.path_params["id"])
        if recording is None or request.path_params.get("kind", _SUMMARY) not in _COMMANDS:
            raise HTTPException(404)
        return recording

    async def _request(self, request: Request) -> Response:
        """Order a file. Only the page itself may do it."""
        is_wanted = is_command(request)
        recording = self._recording(request)
        kind = request.path_params["kind"]
        if is_wanted and not self._made(recording, kind).exists():
            self._failed.pop((recording.key, kind), None)
            self._jobs[recording.id, kind] = recording
            self._awake.set()
            if self._current is not None and self._current[1] == _SUMMARY:
                self._kill()  # it is made again later
        return Response(status_code=202)

    async def _file(self, request: Request) -> Response:
        recording = self._recording(request)
        kind = request.path_params["kind"]
        path = self._made(recording, kind)
        if not path.exists():
            raise HTTPException(404)
        if kind == "report":
            headers = {"Content-Security-Policy": f"{policy()}; frame-ancestors 'none'"}
            return FileResponse(path, headers=headers, media_type="text/html")
        return FileResponse(path, filename=f"{recording.name}{path.suffix}")

    async def _capture(self, request: Request) -> Response:
        paths = self._recording(request).paths
        part = request.path_params["part"]
        if part >= len(paths) or not paths[part].is_file():
            raise HTTPException(404)
        media = "application/octet-stream"
        return FileResponse(paths[part], filename=paths[part].name, media_type=media)

    # --- list

    def scan(self) -> str:
        """Read the folder. Return a line about its fault, or ""."""
        if self._folder is None:
            return (
                "There is no folder of captures. Set record.directory in the configuration, or "
                "give --captures."
            )
        try:
            found = recordings_in(self._folder)
        except OSError as error:
            self._recordings = {}
            return f"{self._folder}: cannot be read: {error.strerror}."
        self._recordings = {recording.id: recording for recording in found}
        return ""

    def _content(self) -> dict[str, Any]:
        """Read the folder. Return the list of flights."""
        problem = self.scan()
        kinds = [kind for kind in _COMMANDS if kind != _SUMMARY]
        if importlib.util.find_spec("pyarrow") is None:
            kinds.remove("parquet")
        flights = []
        for recording in self._recordings.values():
            summary = None
            with contextlib.suppress(OSError, ValueError):
                summary = json.loads(self._made(recording, _SUMMARY).read_text(encoding="utf-8"))
            flights.append(
                {
                    "id": recording.id,
                    "name": recording.name,
                    "size": recording.size,
                    "parts": len(recording.paths),
                    "isWritten": recording.is_written,
                    "summary": summary,
                    "states": {kind: self._state(recording, kind) for kind in _COMMANDS},
                }
            )
        return {"problem": problem, "kinds": kinds, "flights": flights}

    def _state(self, recording: Recording, kind: str) -> Any:
        """Return "made", "waiting", a progress from 0 to 1, {"failed": reason}, or None."""
        failed = self._failed.get((recording.key, kind))
        if failed is not None:
            return {"failed": failed}
        if self._current is not None and self._current == (recording, kind):
            return round(self._progress, 2)
        if (recording.id, kind) in self._jobs:
            return "waiting"
        if self._made(recording, kind).exists():
            return "made"
        return None

    def _made(self, recording: Recording, kind: str) -> Path:
        return self._cache / f"{recording.key}.{kind}"

    # --- worker

    async def _work(self) -> None:
        while True:
            self._current = self._next()
            if self._current is None:
                self._awake.clear()
                await self._awake.wait()
                continue
            recording, kind = self._current
            self._progress = 0.0
            try:
                await self._make(recording, kind)
            except OSError as error:
                self._failed[recording.key, kind] = error.strerror or ""
            await asyncio.to_thread(self._prune)

    def _next(self) -> tuple[Recording, str] | None:
        """Return the next file to make: a requested one, or a missing summary."""
        for (flight_id, kind), recording in self._jobs.items():
            del self._jobs[flight_id, kind]
            return recording, kind
        if time.monotonic() - self._looked_at > _LOOKED_AT_S:
            return None
        for recording in self._recordings.values():
            if self._state(recording, _SUMMARY) is None and not recording.is_written:
                return recording, _SUMMARY
        return None

    async def _make(self, recording: Recording, kind: str) -> None:
        self._cache.mkdir(mode=0o700, parents=True, exist_ok=True)
        source = recording.paths[0].name
        if len(recording.paths) > 1:
            source = f"{recording.name}-"
        words = {"source": f"./{source}", "output": str(self._made(recording, kind))}
        command = [word.format(**words) for word in _COMMANDS[kind]]
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            *command,
            cwd=recording.paths[0].parent,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            start_new_session=True,
        )
        self._process = process
        _restrict(process.pid)
        talk = asyncio.create_task(process.communicate())
        end = time.monotonic() + _LIMIT_S
        try:
            while not talk.done() and time.monotonic() < end:
                await asyncio.wait([talk], timeout=_POLL_S)
                self._progress = max(self._progress, _progress_of(process.pid, recording))
        finally:
            self._kill()
            _, said = await talk
        if process.returncode == 0 or (kind == _SUMMARY and self._jobs):
            return
        _, _, reason = said.decode(errors="replace").strip().rpartition("\n")
        self._failed[recording.key, kind] = reason[:300] or "it needed too much memory or time"

    def _kill(self) -> None:
        process = self._process
        if process is not None and process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()

    def _prune(self) -> None:
        """Remove files of changed and removed captures, and the oldest if there are too many."""
        keys = {recording.key for recording in self._recordings.values()}
        total = 0
        with contextlib.suppress(OSError):
            newest = sorted(self._cache.iterdir(), key=os.path.getmtime, reverse=True)
            for path in newest:
                size = path.stat().st_size
                is_current = path.stem in keys or not keys
                if is_current and total + size <= _CACHE_BYTES:
                    total += size
                else:
                    path.unlink()

    def disk(self) -> str:
        """Return a line about the disk of the captures if its space is short, or ""."""
        if self._folder is None:
            return ""
        try:
            status = os.statvfs(self._folder)
        except OSError:
            return ""
        free_mb = status.f_bavail * status.f_frsize // 1_000_000
        limit_mb = self._min_free_mb
        if free_mb >= 2 * limit_mb:
            return ""
        return f"disk of the captures: {free_mb} MB free. Recording pauses below {limit_mb} MB."


def _restrict(pid: int) -> None:
    """Limit a child process's memory and priority. Ignores refusals of the system."""
    with contextlib.suppress(OSError, ValueError):
        resource.prlimit(pid, resource.RLIMIT_DATA, (_LIMIT_BYTES, _LIMIT_BYTES))
        resource.prlimit(pid, resource.RLIMIT_CPU, (_LIMIT_S, _LIMIT_S))
    with contextlib.suppress(OSError):
        Path(f"/proc/{pid}/oom_score_adj").write_text(_OOM_ADJUSTMENT)
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, pid, _NICE)


def _progress_of(pid: int, recording: Recording) -> float:
    """Return the share of a recording that a process has read, by its positions in the files."""
    begins = {}
    size = 0
    for path in recording.paths:
        begins[str(path.resolve())] = size
        with contextlib.suppress(OSError):
            size += path.stat().st_size
    read = 0
    with contextlib.suppress(OSError, ValueError):
        for descriptor in Path(f"/proc/{pid}/fd").iterdir():
            begin = begins.get(str(descriptor.readlink()))
            if begin is not None:
                lines = Path(f"/proc/{pid}/fdinfo", descriptor.name).read_text(encoding="ascii")
                read = max(read, begin + int(lines.split()[1]))
    return min(1.0, read / max(1, size))
