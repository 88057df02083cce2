"""Serves the page with uvicorn and Starlette, and its data as server-sent events.

One thread receives frames and makes the content. The event loop of the server sends the newest
content to all clients. A client that is too slow gets fewer updates and delays no other.
"""

import asyncio
import contextlib
import socket
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar

import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, Response, StreamingResponse
from starlette.routing import BaseRoute, Mount, Route
from starlette.staticfiles import StaticFiles
from uvicorn.protocols.http.h11_impl import H11Protocol

from kontronik_can_gw.desk import look
from kontronik_can_gw.desk.live.access import AccessGuard, is_command, own_names
from kontronik_can_gw.desk.live.content import STEPS, Content
from kontronik_can_gw.desk.live.flights import Flights
from kontronik_can_gw.desk.sources import Source
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.frames import CanFrame

UPDATE_S = 0.15
"""Time between two updates."""
_REST_S = 0.02
"""Pause after a batch of frames, so that a busy bus does not wake the process for each frame."""
_MAX_PAGES = 20
"""Number of pages that get updates at the same time."""
_MAX_CONNECTIONS = 80
_REQUEST_S = 10.0
"""Longest time until a connection has sent its first whole request."""
_STALLED_S = 20.0
"""A client that accepts no data for this time is disconnected."""
_UNSENT = 16 * 1024
"""Number of bytes that may wait to be sent to one client."""
_MAX_HEAD = 16 * 1024
"""Maximum size of the head of a request, in bytes."""
_PAGES = Path(__file__).parent / "page"


class Hub:
    """Passes the newest content from the thread that makes it to all clients."""

    def __init__(self, content: Content) -> None:
        self.content = content
        self.clients = 0
        self.is_closed = False
        self._loop: asyncio.AbstractEventLoop | None = None
        self._layout = content.layout()
        self._update = ""
        self._updates = 0
        """Number of updates so far."""
        self._steps: deque[str] = deque(maxlen=STEPS)
        self._step_count = 0
        self._changed = asyncio.Event()
        self._is_reset = threading.Event()
        self._due = 0.0

    # --- called by the thread that makes the content

    def take(self, frame: CanFrame, now: int) -> None:
        self.content.take(frame, now)

    def tick(self) -> float:
        """Publish steps, and an update if it is due. Return the time of the next update."""
        if self._is_reset.is_set():
            self._is_reset.clear()
            self.content.monitor.restart_extremes()
        now = time.monotonic()
        if now < self._due:
            return self._due
        self._due = max(self._due + UPDATE_S, now + UPDATE_S / 2)
        time_ns = self.content.source.now()
        steps = self.content.steps(time_ns)
        update = self.content.update(time_ns, now) if self.clients else ""
        if self._loop is not None and (steps or update):
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._publish, steps, update)
        return self._due

    # --- called by the event loop

    def reset(self) -> None:
        """Let minimum and maximum begin again."""
        self._is_reset.set()

    def attach(self) -> None:
        """Publish to the clients of the running event loop."""
        self._loop = asyncio.get_running_loop()

    def close(self) -> None:
        """End all streams."""
        self.is_closed = True
        self._wake()

    def _publish(self, steps: Sequence[str], update: str) -> None:
        self._steps += steps
        self._step_count += len(steps)
        if update:
            self._update = update
            self._updates += 1
        self._wake()

    def _wake(self) -> None:
        self._changed.set()
        self._changed = asyncio.Event()

    async def stream(self) -> AsyncIterator[str]:
        """Yield the events for one client: the layout, the steps that it has not had, updates."""
        self.clients += 1
        try:
            yield _event("layout", self._layout)
            sent_updates = self._updates  # the last update may be old
            sent_steps = 0
            while not self.is_closed:
                changed = self._changed
                text = ""
                missing = min(self._step_count - sent_steps, len(self._steps))
                if missing:
                    steps = list(self._steps)[-missing:]
                    text += _event("steps", f"[{','.join(steps)}]")
                sent_steps = self._step_count
                if self._updates != sent_updates:
                    sent_updates = self._updates
                    text += _event("update", self._update)
                if text:
                    yield text
                if changed is self._changed:
                    await changed.wait()
        finally:
            self.clients -= 1


def _event(name: str, text: str) -> str:
    return f"event: {name}\ndata: {text}\n\n"


# --- answers


def application(hub: Hub, flights: Flights) -> Starlette:
    """Return the application with both pages."""

    async def page(_: Request) -> Response:
        return FileResponse(_PAGES / "live.html")

    async def list_page(_: Request) -> Response:
        return FileResponse(_PAGES / "flights.html")

    async def events(request: Request) -> Response:
        headers = {"Content-Type": "text/event-stream"}
        if request.method == "HEAD":
            return Response(headers=headers)
        if hub.clients >= _MAX_PAGES:
            raise HTTPException(503)
        return StreamingResponse(hub.stream(), headers=headers)

    async def reset(request: Request) -> Response:
        if is_command(request):
            hub.reset()
        return Response(status_code=204)

    routes: list[BaseRoute] = [
        Route("/", page),
        Route("/flights", list_page),
        Mount("/static", StaticFiles(directory=_PAGES)),
        Mount("/look", StaticFiles(directory=look.HERE)),
        Route("/events", events),
        Route("/reset", reset),
    ]
    return Starlette(routes=[*routes, *flights.routes()])


# --- connections


class _Limited(H11Protocol):
    """A connection of uvicorn with limits of number and time."""

    _all: ClassVar[set["_Limited"]] = set()
    _timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        # data that wait in buffers become old, so only little may wait
        transport.set_write_buffer_limits(high=_UNSENT)
        sock = transport.get_extra_info("socket")
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, _UNSENT)
        if len(self._all) >= _MAX_CONNECTIONS:
            # the oldest connection without a request makes room, or this one does
            idle = [each for each in self._all if not each.cycle or each.cycle.response_complete]
            oldest = min(idle, key=lambda each: each.made, default=self)
            oldest.transport.abort()
            self._all.discard(oldest)
            if oldest is self:
                return
        self._all.add(self)
        self.made = self.loop.time()
        self._timer = self.loop.call_later(_REQUEST_S, self._check)

    def _check(self) -> None:
        if self.cycle is None:
            self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._all.discard(self)
        self._end_timer()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._end_timer()
        self._timer = self.loop.call_later(_STALLED_S, self.transport.abort)

    def resume_writing(self) -> None:
        super().resume_writing()
        self._end_timer()

    def _end_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()


class _Server(uvicorn.Server):
    """uvicorn, which leaves the signals to the command, and ends the streams when it ends."""

    def __init__(self, config: uvicorn.Config, hub: Hub) -> None:
        super().__init__(config)
        self._hub = hub

    def capture_signals(self) -> contextlib.AbstractContextManager[None]:  # type: ignore[override]
        return contextlib.nullcontext()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._hub.close()
        await super().shutdown(sockets)


def listen(host: str, port: int) -> socket.socket:
    """Return a listening socket. Raises RunError if the address cannot be used."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_STREAM)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind((host, port))
        sock.listen(128)
    except OSError as error:
        sock.close()
        where = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        raise RunError(
            f"--listen {where}: cannot be used: {error.strerror}. Choose another address or port."
        ) from None
    return sock


class LiveServer:
    """The server of one source.

    ``serve`` runs until ``stop`` is called, which another thread or a signal handler may do.
    """

    def __init__(
        self,
        hub: Hub,
        sock: socket.socket,
        token: str | None,
        flights: Flights,
    ) -> None:
        self._hub = hub
        self._sock = sock
        self._flights = flights
        app = AccessGuard(
            application(hub, flights),
            token,
            sock.getsockname()[1],
            own_names(),
        )
        self._server = _Server(
            uvicorn.Config(
                app,
                http=_Limited,
                loop="asyncio",
                ws="none",
                lifespan="off",
                log_config=None,
                log_level=100,
                access_log=False,
                server_header=False,
                proxy_headers=False,
                timeout_keep_alive=30,
                timeout_graceful_shutdown=1,
                h11_max_incomplete_event_size=_MAX_HEAD,
            ),
            hub,
        )

    def stop(self) -> None:
        self._server.should_exit = True

    def serve(self) -> None:
        """Serve until ``stop``."""
        asyncio.run(self._serve())

    async def _serve(self) -> None:
        self._hub.attach()
        async with self._flights.running():
            await self._server.serve([self._sock])


def feed(source: Source, hub: Hub, stopped: Callable[[], bool]) -> None:
    """Receive frames and publish their content until ``stopped`` returns True.

    An input that cannot be read any further becomes the source's problem.
    """
    while not stopped():
        due = hub.tick()
        try:
            if source.problem and source.is_file:
                time.sleep(UPDATE_S)
            else:
                source.pump(hub.take, due)
        except UserError as error:
            source.problem = error.problems[0]
        time.sleep(min(_REST_S, max(0.0, due - time.monotonic())))
