"""``metrics``: serves a gateway's statistics for Prometheus.

They are read from the status file, which the gateway replaces each second.
"""

import argparse
import ipaddress
import threading
from functools import partial
from pathlib import Path

from kontronik_can_gw.cli.arguments import CONFIG, option
from kontronik_can_gw.cli.common import announced_config, say, stopping_on_signals
from kontronik_can_gw.desk.libraries import missing_library
from kontronik_can_gw.desk.monitor.status import look_at_first, possible_files


def _loopback(text: str) -> tuple[str, int]:
    """Return a loopback address and a port. A type for argparse."""
    host, _, port = text.rpartition(":")
    host = "127.0.0.1" if host == "localhost" else host.strip("[]")
    try:
        if ipaddress.ip_address(host).is_loopback and 0 <= int(port) <= 65535:
            return host, int(port)
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(
        f"{text!r} is not an address and port of this machine, for example 127.0.0.1:9123 or "
        "[::1]:9123"
    )


OPTIONS = (
    (
        *CONFIG,
        option(
            "--file FILE",
            "status file of the gateway (default: the file of the gateway with this configuration)",
            type=Path,
        ),
    ),
    option(
        "--listen HOST:PORT",
        "where Prometheus may fetch /metrics, on this machine (default 127.0.0.1:9123)",
        type=_loopback,
        default=("127.0.0.1", 9123),
    ),
)
EPILOG = "If the gateway does not run, the answer is 503, and Prometheus's up is 0."


def main(args: argparse.Namespace) -> int:
    try:
        from kontronik_can_gw.desk.metrics import server_of
    except ImportError:
        raise missing_library("metrics", "metrics") from None
    if args.file:
        config = None
        files = [args.file]
    else:
        config = args.config or announced_config()
        files = possible_files(config)
    if len(files) == 1:  # the file of another gateway is not possible
        config = None
    look = partial(look_at_first, files, config=config)
    host, port = args.listen
    stopped = threading.Event()
    server = server_of(look, host, port)
    with server, stopping_on_signals(stopped.set):
        threading.Thread(target=server.serve_forever, daemon=True).start()
        shown = f"[{host}]" if ":" in host else host
        say(f"http://{shown}:{server.server_port}/metrics serves {config or files[0]}")
        stopped.wait()
    return 0
