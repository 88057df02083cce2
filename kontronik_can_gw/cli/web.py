"""``web``: serves a page of the ESCs for phones and desktops, and the flights.

It only reads the bus and the folder of captures. It never sends on CAN.
"""

import argparse
import ipaddress
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from kontronik_can_gw.cli.arguments import option
from kontronik_can_gw.cli.common import say, stopping_on_signals
from kontronik_can_gw.cli.recording import record_folder
from kontronik_can_gw.cli.source import SOURCE_OPTIONS, recording_of, source_of
from kontronik_can_gw.config.keys import RecordConfig
from kontronik_can_gw.desk.libraries import missing_library
from kontronik_can_gw.desk.sources import Source
from kontronik_can_gw.errors import RunError

if TYPE_CHECKING:
    from kontronik_can_gw.desk.live.access import Address

PORT = 8044
_SERVICE_CACHE = Path("/var/cache/kontronik-can-gw-web")


def _address(text: str) -> tuple[str, int]:
    """Return a numeric address and a port. A type for argparse."""
    host, _, port = text.rpartition(":")
    host = "127.0.0.1" if host == "localhost" else host.removeprefix("[").removesuffix("]")
    try:
        if 0 <= int(port) <= 65535:
            return str(ipaddress.ip_address(host)), int(port)
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(
        f"{text!r} is not an address and port, for example 127.0.0.1:{PORT}, 0.0.0.0:{PORT} "
        f"(all IPv4 addresses of this machine) or [::]:{PORT}"
    )


OPTIONS = (
    *SOURCE_OPTIONS,
    option(
        "--listen HOST:PORT",
        f"where browsers find the page (default 127.0.0.1:{PORT}: only on this machine)",
        type=_address,
        default=("127.0.0.1", PORT),
    ),
    (
        option("--no-token", "ask for no token: everybody in the network sees the page"),
        option("--address", "print the address of the running page and its QR code, then end"),
    ),
    option(
        "--captures DIR",
        "folder of the flights (default: record.directory of the configuration)",
        type=Path,
    ),
    option(
        "--cache DIR",
        "folder for token and reports (default: the user's cache folder)",
        type=Path,
    ),
)
EPILOG = f"""\
SOURCE is that of monitor: a CAN interface, or a recording, which is played at
its own speed. Without SOURCE the interface is the one in the configuration, or
can0.

The page shows the ESCs now. /flights lists the recordings in the folder of
captures, with reports and downloads. It is for this machine only, unless
--listen names another address. Then a browser needs the token in the address
that is printed, also as a QR code. The token is stored in the cache folder and
stays the same. The connection is not encrypted: use it in a network that you
trust.

examples:
  kontronik-can-gw web can0
  kontronik-can-gw web --listen 0.0.0.0:{PORT}
  sudo kontronik-can-gw web --address

exit codes: 0 ended by a signal; 1 the address or the cache folder cannot be
used, or a library is missing; 2 wrong usage, or the recording cannot be opened
"""


def main(args: argparse.Namespace) -> int:
    try:
        from kontronik_can_gw.desk.live import access, server
        from kontronik_can_gw.desk.live.content import Content
        from kontronik_can_gw.desk.live.flights import Flights
    except ImportError:
        raise missing_library("web", "web") from None
    if args.address:
        return _show_address(args.cache)
    recording = recording_of(args)
    host, port = args.listen
    is_open = args.no_token or ipaddress.ip_address(host).is_loopback
    stopped = threading.Event()
    with source_of(args, recording, patient=True) as source:
        sock = server.listen(host, port)
        cache = access.cache_folder(args.cache)
        address = access.Address.stored(
            cache,
            host,
            sock.getsockname()[1],
            is_open,
        )
        captures, min_free_mb = _captures_of(args, source)
        flights = Flights(captures, min_free_mb, cache)
        hub = server.Hub(Content(source, flights.disk))
        page = server.LiveServer(
            hub,
            sock,
            None if is_open else address.token,
            flights,
        )

        def feed() -> None:
            try:
                server.feed(source, hub, stopped.is_set)
            finally:
                page.stop()  # a page without updates is useless; systemd starts it again

        thread = threading.Thread(target=feed, daemon=True)
        with stopping_on_signals(page.stop):
            _announce(source, address)
            if captures is not None and (problem := flights.scan()):
                say(f"warning: {problem}")
            thread.start()
            page.serve()
        stopped.set()
        thread.join(1)
    return 0


def _announce(source: Source, address: "Address") -> None:
    """Print the page's addresses. The token is printed only on a terminal, not in a log."""
    if source.problem:
        say(f"warning: {source.problem}")
    is_terminal = sys.stderr.isatty()
    shown = address if is_terminal else address._replace(is_open=True)
    for url in shown.urls():
        say(f"{url} shows {source.name}")
    if ipaddress.ip_address(address.host).is_loopback:
        return
    if address.is_open:
        say("warning: --no-token: everybody in the network can see the page")
    elif is_terminal:
        _print_code(address, sys.stderr)
    else:
        say("a browser needs the token. Type: kontronik-can-gw web --address")


def _show_address(given: Path | None) -> int:
    """Print the addresses of the running page and a QR code. The service comes first."""
    from kontronik_can_gw.desk.live.access import Address, cache_folder

    found = None
    try:
        if given is None and _SERVICE_CACHE.is_dir():
            found = Address.stored_in(_SERVICE_CACHE)
        found = found or Address.stored_in(cache_folder(given))
    except OSError as error:
        raise RunError(
            f"{error.filename}: cannot be read: {error.strerror}. "
            "Type: sudo kontronik-can-gw web --address"
        ) from None
    if found is None:
        raise RunError("no page was served yet. Start it: kontronik-can-gw web")
    for url in found.urls():
        print(url)
    if not ipaddress.ip_address(found.host).is_loopback:
        _print_code(found, sys.stdout)
    return 0


def _print_code(address: "Address", stream: TextIO) -> None:
    """Print the QR code of the first address."""
    import segno

    segno.make(address.urls()[0], micro=False).terminal(out=stream, compact=True)


def _captures_of(args: argparse.Namespace, source: Source) -> tuple[Path | None, int]:
    """Return the folder of captures, or None, and the MB that a recorder leaves free."""
    config = source.bus.config
    if source.is_file or config is None:
        return args.captures, RecordConfig().min_free_mb
    return record_folder(config, args.captures), config.record.min_free_mb
