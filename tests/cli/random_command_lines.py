"""Runs random command lines and prints the faults.

    python random_command_lines.py FOLDER SEED FIRST COUNT

Runs COUNT command lines of a seed, from number FIRST on. Each runs in a child of this process,
which has loaded all libraries. A fault is a traceback, an exit code that docs/operation.md does not
list, or a command that does not end. FOLDER must be empty and writable for everybody.

It is safe to run on any machine. The commands run as an ordinary user with an empty home folder,
and with a systemctl that does nothing. Sockets reach this machine only, and no CAN interface. Each
command runs in a folder of its own. Outside of it, its words name only devices such as /dev/full.
"""

import argparse
import atexit
import contextlib
import errno
import gc
import os
import random
import re
import resource
import select
import shutil
import signal
import socket
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

OPERATION = Path(__file__).resolve().parents[2] / "docs" / "operation.md"
STOP_S = 0.3
"""A command that is still running after this time gets SIGINT, as by Ctrl-C."""
CPU_LIMIT_S = 5
"""Longest time of a command on the processor."""
LIMIT_S = 60.0
"""Longest time until a command ends after SIGINT. It is long because others may use the machine."""
NOBODY = 65534
NEAR = ("127.0.0.1", "::1", "localhost")
LIBRARIES = (
    *("asammdf", "can", "canopen", "cantools", "numpy", "pandas", "paho.mqtt.client", "pyarrow"),
    *("prometheus_client", "rich.console", "rich.live", "rich.table", "serial", "shtab", "z3"),
)

ODD = (
    *(
        "",
        " ",
        "-",
        "--",
        "---",
        "-=",
        "=",
        "--=x",
        "-x",
        "\n",
        "a\nb",
        "\t",
        "\x1b[31m",
        "%s",
        "{0}",
    ),
    *(
        "\udcff",
        "µ",
        "\N{SNOWMAN}",
        "x" * 300,
        "x" * 5000,
        "*",
        "~",
        "$HOME",
        "`id`",
        "\\",
        '"',
        "'",
    ),
    *("..", ".", "./", "//", "nowhere", "nowhere/x", "/dev/null", "/dev/full", "/dev/tty"),
    *("none", "true", "null", "[]", "{}", "#", "@x", "a=b", "a:b", "a,b", ",", ":", "*.csv"),
)
NUMBERS = (
    *("0", "1", "2", "-1", "+1", "00", "0.5", ".5", "1e3", "1e999", "-1e999", "nan", "inf", "-inf"),
    *("127", "128", "255", "256", "65536", "4294967296", "99999999999999999999", "0x10", "1_0"),
    *("5s", "200ms", "2min", "1h", "1d", "-5s", "٣", "1 2", "1,5"),
)
NAMES = (
    *("can0", "vcan0", "virtual", "socketcan", "slcan", "udp_multicast", "esc1", "esc2", "all"),
    *("localhost", "127.0.0.1", "::1", "localhost:1", "host.invalid", "live", "battery_voltage"),
    *("csv", "jsonl", "parquet", "asc", "blf", "trc", "mf4-log", "candump", "json", "markdown"),
)
FILES = (
    *("gateway.toml", "wrong.toml", "x.bin", "x.log", "x.asc", "x.dbc", "x.eds", "empty", "folder"),
    *("noise", "closed", "pipe", "link", "loop", "out", "out.csv", "out.html", "folder/out.zip"),
)
CONFIGURATION = """
[can]
interface = "virtual"
[[esc]]
port = "nowhere"
"""


class Grammar(NamedTuple):
    """The words that a command accepts."""

    command: list[str]
    arguments: list[Sequence[str]]
    """The choices of each argument. Without choices they are files."""
    options: dict[str, Sequence[str] | None]
    """The values of each option. None if it takes none."""


def grammars(parser: argparse.ArgumentParser) -> Iterator[Grammar]:
    """Yield the grammar of a parser and of its commands."""
    found = Grammar(parser.prog.split()[1:], [], {})
    for action in parser._actions:
        choices = [str(each) for each in action.choices or ()]
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                yield from grammars(sub)
        elif not action.option_strings:
            found.arguments.append(choices or FILES)
        for name in action.option_strings:
            takes_value = action.nargs != 0
            found.options[name] = choices or (*FILES, *NUMBERS, *NAMES) if takes_value else None
    yield found


def command_line(rng: random.Random, known: Sequence[Grammar]) -> list[str]:
    """Return a random command line. Two of three have the form that the command accepts."""
    grammar = rng.choice(known)
    words = list(map(rng.choice, grammar.arguments))
    for _ in range(rng.choice((0, 0, 1, 1, 2, 3))):
        name = rng.choice(list(grammar.options))
        values = grammar.options[name]
        value = rng.choice(values or ("",))
        if values is None:
            words.append(name)
        elif name.startswith("--") and rng.random() < 0.2:
            words.append(f"{name}={value}")
        else:
            words += [name, value]
    words[:0] = grammar.command
    while rng.random() < 0.33:
        every = list(rng.choice(known).options)
        pool = rng.choice((FILES, NUMBERS, NAMES, ODD, ODD, grammar.command or ODD, every))
        place = rng.randrange(len(words) + 1)
        words[place : place + rng.randrange(2)] = [rng.choice(pool)] * rng.randrange(2)
    return words


def accepted_codes() -> set[int]:
    """Return the exit codes that docs/operation.md lists."""
    section = OPERATION.read_text(encoding="utf-8").partition("\n## Exit codes\n")[2]
    table = section.partition("\n## ")[0]
    found = {int(code) for code in re.findall(r"^\| (\d+) \|", table, re.MULTILINE)}
    assert found
    return found


def prepare(folder: Path) -> None:
    """Write the files that commands find in their folder, by FILES, and a systemctl."""
    (folder / "home").mkdir()
    (folder / "bin").mkdir()
    (folder / "bin/systemctl").write_text("#!/bin/sh\nexit 1\n")
    (folder / "bin/systemctl").chmod(0o755)
    (folder / "samples").mkdir()
    os.chdir(folder / "samples")
    Path("gateway.toml").write_text(CONFIGURATION)
    Path("wrong.toml").write_text("cann = 1\n[[esc]]\n")
    Path("empty").touch()
    Path("folder").mkdir()
    Path("noise").write_bytes(random.Random(0).randbytes(3000))
    Path("link").symlink_to("x.bin")
    Path("loop").symlink_to("loop")
    for words in (
        "simulate --seconds 2 -o x.bin",
        *("dbc -o x.dbc", "eds -o x.eds", "convert x.bin x.log", "convert x.bin x.asc"),
    ):
        assert main(words.split()) == 0


def give_up_rights() -> None:
    """Become an ordinary user if this is root.

    The project or Python may be in a folder that only root can enter, such as root's home. Open
    descriptors of their folders keep them readable.
    """
    if os.geteuid() != 0:
        return
    packages = [module.__path__ for module in sys.modules.values() if hasattr(module, "__path__")]
    for paths in (sys.path, *packages):
        for at, name in enumerate(paths):
            if os.path.isdir(name):
                paths[at] = f"/proc/self/fd/{os.open(name, os.O_PATH)}"
    os.setgroups([])
    os.setresgid(NOBODY, NOBODY, NOBODY)
    os.setresuid(NOBODY, NOBODY, NOBODY)


class NearSocket(socket.socket):
    """A socket that reaches only this machine, and no CAN interface."""

    def __init__(self, family: int = -1, *words: Any, **more: Any) -> None:
        if family == socket.AF_CAN:
            raise OSError(errno.EAFNOSUPPORT, os.strerror(errno.EAFNOSUPPORT))
        super().__init__(family, *words, **more)

    def connect(self, address: Any) -> None:
        refuse_far(address)
        super().connect(address)

    def connect_ex(self, address: Any) -> int:
        refuse_far(address)
        return super().connect_ex(address)

    def sendto(self, *words: Any) -> int:
        refuse_far(words[-1])
        return super().sendto(*words)


def refuse_far(address: Any) -> None:
    """Raise the error of a machine without a network, if an address is not of this machine."""
    if isinstance(address, tuple) and address[0] not in NEAR:
        raise OSError(errno.ENETUNREACH, os.strerror(errno.ENETUNREACH))


def leave_network() -> None:
    """Let all sockets of this process reach only this machine."""
    look_up = socket.getaddrinfo

    def look_up_near(host: Any, *words: Any, **more: Any) -> Any:
        if host is not None and host not in NEAR:
            raise socket.gaierror(socket.EAI_AGAIN, "Temporary failure in name resolution")
        return look_up(host, *words, **more)

    socket.socket = NearSocket  # type: ignore[misc]
    socket.getaddrinfo = look_up_near


def enter(folder: Path, number: int) -> None:
    """Make a folder for a child, and give it standard streams of several kinds."""
    os.setpgid(0, 0)
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # as __main__.py does
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_LIMIT_S, CPU_LIMIT_S + 1))
    place = folder / str(number)
    shutil.copytree(folder / "samples", place / "cwd", symlinks=True)
    os.chdir(place / "cwd")
    os.mkfifo("pipe")
    Path("closed").touch(0)
    rng = random.Random(number)
    given = rng.choice((os.devnull, os.devnull, "x.bin", "x.log"))
    out = rng.choices((place / "out", "/dev/full", None), (18, 1, 1))[0]
    reader, writer = os.pipe()
    os.close(reader)
    os.dup2(os.open(given, os.O_RDONLY), 0)
    os.dup2(writer if out is None else os.open(out, os.O_WRONLY | os.O_CREAT), 1)
    os.dup2(os.open(place / "err", os.O_WRONLY | os.O_CREAT), 2)
    sys.stdin = os.fdopen(0, closefd=False)
    sys.stdout = os.fdopen(1, "w", closefd=False)
    sys.stderr = os.fdopen(2, "w", buffering=1, errors="backslashreplace", closefd=False)


def run(words: list[str]) -> NoReturn:
    """Run a command line and end this process, as Python does except for its slow cleaning."""
    code: Any = 1
    try:
        code = main(words)
    except SystemExit as end:
        code = end.code
    except BaseException:
        traceback.print_exc()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    sys.stderr.flush()
    os._exit(code or 0)


def has_ended(process: int, seconds: float) -> bool:
    """Wait for a child for some time. Return whether it has ended."""
    watched = os.pidfd_open(process)
    try:
        return bool(select.select([watched], [], [], seconds)[0])
    finally:
        os.close(watched)


def fault(process: int, err: Path) -> str:
    """Wait for the end of a command. Return its fault, or an empty text."""
    is_ended = has_ended(process, STOP_S)
    if not is_ended:
        os.kill(process, signal.SIGINT)
        is_ended = has_ended(process, LIMIT_S)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process, signal.SIGKILL)  # with its children
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    if code == -signal.SIGINT:  # before or after main
        code = 128 + signal.SIGINT
    said = err.read_text(errors="replace")
    if not is_ended:
        return f"did not end within {LIMIT_S:g} s after SIGINT"
    if code == -signal.SIGXCPU:
        return f"did not end within {CPU_LIMIT_S} s on the processor"
    if "Traceback" in said:
        return said
    return "" if code in ACCEPTED else f"exit code {code}: {said}"


def run_all(folder: Path, seed: int, first: int, count: int) -> None:
    """Run command lines of a seed, and print the faults."""
    for name in LIBRARIES:
        import_module(name)
    for name in COMMANDS:
        import_module(f"kontronik_can_gw.cli.{name}")
    leave_network()
    prepare(folder)
    os.environ["HOME"] = str(folder / "home")
    os.environ["PATH"] = f"{folder / 'bin'}:/usr/bin:/bin"
    known = list(grammars(make_parser()))
    rng = random.Random(seed)
    lines = [command_line(rng, known) for _ in range(first + count)]
    gc.freeze()
    for number, words in enumerate(lines[first:], first):
        ready, not_ready = os.pipe()
        process = os.fork()
        if process == 0:
            enter(folder, number)
            os.close(not_ready)
            run(words)
        os.close(not_ready)
        os.read(ready, 1)  # until the child has closed its end
        os.close(ready)
        if found := fault(process, folder / str(number) / "err"):
            print(f"command line {number}: {words!r}: {found}", flush=True)
        shutil.rmtree(folder / str(number))


if __name__ == "__main__":
    give_up_rights()
    from kontronik_can_gw.cli import COMMANDS, main, make_parser

    ACCEPTED = accepted_codes()
    run_all(Path(sys.argv[1]), *map(int, sys.argv[2:]))
