"""``make conformance``: tests the gateway's CANopen node on a vcan.

Writes conformance.md and the JUnit file conformance.xml to the folder of the argument.
"""

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2]
for _folder in ("tests", "tests/vcan", "tests/faults", "tests/dbc", "tests/signals", "tests/esc"):
    sys.path.insert(0, str(PROJECT / _folder))

from feeder import Feeder, Identity  # noqa: E402
from harness import PtyPort  # noqa: E402
from vcan_tools import PROGRAM, GatewayProcess, canopen_table, configuration, ip  # noqa: E402

PAGE = PROJECT / "docs" / "reference" / "conformance.md"


@contextmanager
def gateway_with_a_node(interface: str, folder: Path) -> Iterator[None]:
    """Run a gateway with one CANopen node and an ESC that sends telemetry."""
    port = PtyPort(folder / "port", Identity(1), rate_hz=100)
    feeder = Feeder([port]).start()
    config = folder / "gateway.toml"
    toml = canopen_table(folder / "store") + "[dbc]\nenabled = false\n"
    config.write_text(configuration(interface, [port], toml))
    gateway = GatewayProcess(config)
    try:
        gateway.wait_for_line("esc1: /")
        gateway.wait_for_line("CAN socketcan")
        yield
        assert gateway.end() == 0, gateway.log
    finally:
        gateway.kill()
        feeder.close()
        port.close()


def conformance(interface: str, *words: object) -> subprocess.CompletedProcess[str]:
    """Run the conformance test of node 1."""
    command = [*PROGRAM, "conformance", "--channel", interface]
    command += [str(word) for word in words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def main(folder: Path) -> int:
    interface = "vcan0"
    ip("link", "add", interface, "type", "vcan")
    ip("link", "set", interface, "up")
    with tempfile.TemporaryDirectory() as name, gateway_with_a_node(interface, Path(name)):
        outputs = ("-o", folder / "conformance.md", "--junit", folder / "conformance.xml")
        done = conformance(interface, *outputs, "--force")
    print(done.stdout + done.stderr, end="")
    return done.returncode


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
