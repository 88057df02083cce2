"""Decides which requests are answered, and adds security headers to all answers.

1. Only GET and HEAD.
2. The Host header is a numeric address or a name of this machine, so that a page of another site
   cannot read this one by DNS rebinding.
3. With a token, the request has it in a cookie. An address with the token sets the cookie and leads
   to the page without the token in its address.
4. A request that changes something has a header of our own. A browser sends such a header for the
   page of another site only with permission, which is never given.
"""

import contextlib
import fcntl
import hmac
import ipaddress
import json
import os
import secrets
import socket
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection, Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.runtime.files.disk import write_new

_COMMAND_HEADER = "X-Kontronik-Page"
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "Content-Security-Policy": POLICY,
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
}
"""Headers of all answers. An answer may set another policy."""
_MAX_AGE_S = 400 * 86_400
"""Life of the cookie: the longest that browsers allow."""
_FILE = "address.json"
_INTERFACES = Path("/sys/class/net")
_SIOCGIFADDR = 0x8915
"""The request of Linux for the address of a network interface."""
_ASK_FOR_IT = (
    "This page needs the address that contains its token. "
    "On the machine of the gateway type: kontronik-can-gw web --address\n"
)
_ENTER = """<!doctype html><html lang="en"><meta charset="utf-8"><title>KONTRONIK ESCs</title>
<meta http-equiv="refresh" content="0;url=/"><p><a href="/">To the page</a></p></html>
"""


class AccessGuard:
    """An ASGI application that passes permitted requests to another one."""

    def __init__(self, app: ASGIApp, token: str | None, port: int, names: Iterable[str]) -> None:
        self._app = app
        self._token = token
        self._cookie = f"kontronik-{port}"  # browsers send cookies to all ports of a machine
        self._names = {name.lower() for name in names}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, text in _HEADERS.items():
                    headers.setdefault(name, text)
            await send(message)

        answer = self._refusal(scope) or self._entry(scope)
        await (answer or self._app)(scope, receive, send_with_headers)

    def _refusal(self, scope: Scope) -> Response | None:
        if scope["method"] not in ("GET", "HEAD"):
            return PlainTextResponse("Only GET and HEAD.\n", 405, {"Allow": "GET, HEAD"})
        if not self._is_known_host(Headers(scope=scope).get("host", "")):
            return PlainTextResponse("Unknown name in the Host header.\n", 421)
        return None

    def _is_known_host(self, host: str) -> bool:
        name = host.rpartition(":")[0] if host[-1:] != "]" and ":" in host else host
        with contextlib.suppress(ValueError):
            ipaddress.ip_address(name.removeprefix("[").removesuffix("]"))
            return True
        return name.lower() in self._names

    def _entry(self, scope: Scope) -> Response | None:
        """Return the answer to a request without the right cookie. None if it may pass."""
        if self._token is None:
            return None
        request = HTTPConnection(scope)
        given = request.query_params.get("token")
        if given is not None and _is_same(given, self._token):
            # not a redirection, which browsers follow without the new cookie after a foreign link
            entered = HTMLResponse(_ENTER)
            entered.set_cookie(
                self._cookie, self._token, max_age=_MAX_AGE_S, httponly=True, samesite="strict"
            )
            return entered
        if _is_same(request.cookies.get(self._cookie, ""), self._token):
            return None
        return PlainTextResponse(_ASK_FOR_IT, 403)


def _is_same(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode(errors="replace"), token.encode())


def is_command(request: Request) -> bool:
    """Return True for a GET request that changes something, False for a HEAD request.

    Raises HTTPException if the page's own script has not sent it.
    """
    if _COMMAND_HEADER not in request.headers:
        raise HTTPException(403)
    return request.method == "GET"


def own_names() -> list[str]:
    """Return this machine's names for browsers."""
    name = socket.gethostname()
    return ["localhost", name, f"{name.partition('.')[0]}.local"]


# --- token and address


def cache_folder(given: Path | None) -> Path:
    """Create and return the folder for the token and for reports. Raises RunError if it fails.

    It is ``given``, the folder that systemd provides, or one in the user's cache folder.
    """
    caches = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    provided = os.environ.get("CACHE_DIRECTORY") or f"{caches}/kontronik-can-gw"
    folder = given or Path(provided)
    try:
        folder = folder.expanduser()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError(0, "no permission to write")
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise RunError(f"{folder}: cannot be used: {reason}. Give another --cache.") from None
    return folder


class Address(NamedTuple):
    """The stored address of a page, with its token."""

    host: str
    port: int
    token: str
    is_open: bool = False
    """True if the page asks for no token."""

    def urls(self) -> list[str]:
        """Return the page's addresses for browsers, with the token if it is asked for."""
        hosts = [self.host]
        if ipaddress.ip_address(self.host).is_unspecified:
            hosts = _ipv4_addresses() or ["127.0.0.1"]
        ending = "" if self.is_open else f"?token={self.token}"
        found = []
        for host in hosts:
            shown = f"[{host}]" if ":" in host else host
            found.append(f"http://{shown}:{self.port}/{ending}")
        return found

    @classmethod
    def stored_in(cls, folder: Path) -> "Address | None":
        """Return the address of the last page with this cache folder. None without any.

        Raises OSError if it exists and cannot be read.
        """
        try:
            content = json.loads((folder / _FILE).read_text(encoding="utf-8"))
            token = str(content["token"])
            ipaddress.ip_address(content["host"])
            return cls(
                content["host"],
                int(content["port"]),
                token,
                bool(content["is_open"]),
            )
        except (FileNotFoundError, ValueError, LookupError, TypeError):
            return None

    @classmethod
    def stored(cls, folder: Path, host: str, port: int, is_open: bool) -> "Address":
        """Store host and port with the token of the folder, or with a new one.

        Raises RunError if they cannot be stored.
        """
        try:
            before = cls.stored_in(folder)
            token = before.token if before else secrets.token_urlsafe(16)
            address = cls(
                host,
                port,
                token,
                is_open,
            )
            part = folder / f"{_FILE}.part"
            content = json.dumps(address._asdict())
            write_new(part, content.encode(), 0o600)
            part.replace(folder / _FILE)
        except OSError as error:
            raise RunError(
                f"{folder / _FILE}: cannot be written: {error.strerror}. Give another --cache."
            ) from None
        return address


def _ipv4_addresses() -> list[str]:
    """Return the first IPv4 address of each network interface, except loopback.

    Reads their names from sysfs, because the service's sandbox permits no netlink.
    """
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        for interface in sorted(_INTERFACES.glob("*")):
            request = struct.pack("256s", os.fsencode(interface.name))
            try:
                answer = fcntl.ioctl(sock.fileno(), _SIOCGIFADDR, request)
            except OSError:  # the interface has no address
                continue
            address = ipaddress.ip_address(answer[20:24])
            if not address.is_loopback:
                found.append(str(address))
    return found
