"""Collects the parts of a support bundle.

A part that cannot be made is a line in ``Contents.missing``, and the others are made nevertheless.
"""

import errno
import hashlib
import os
import platform
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib import metadata
from io import FileIO
from pathlib import Path
from typing import Any, NamedTuple

from kontronik_can_gw import __version__
from kontronik_can_gw.capture.format import SUFFIX
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.config.output_keys import SHIPPED
from kontronik_can_gw.desk.bundle.captures import clean_capture
from kontronik_can_gw.desk.bundle.files import OPTIONS, clean_dbc, clean_eds, clean_toml, tables_of
from kontronik_can_gw.desk.bundle.secrets import Cleaner, values_of_secrets
from kontronik_can_gw.desk.doctor.machine import Machine
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.native.objects import shared_object
from kontronik_can_gw.printable import printable, printable_json
from kontronik_can_gw.runtime.files.disk import reason_of

JOURNAL = "journal.txt"
_JOURNAL = ("journalctl", "--no-pager", "--since=-1day", "-o", "short-iso", "-u")
_UNITS = "kontronik-can-gw*"
_JOURNAL_PATIENCE_S = 60.0
_LARGEST_JOURNAL = 1 << 25
_LARGEST_FILE = 1 << 25
_LARGEST_PASSWORD = 1 << 16
_CAPTURES = 2
_CHUNK = 1 << 18
_OUR_WORDS = frozenset({"kontronik", "kontronik-can-gw", "kontronik_can_gw", "gateway", "mqtt"})
"""User names that are everywhere in our texts, and reveal nothing."""
_LIBRARIES = (
    "python-can",
    "canopen",
    "pyserial",
    "cantools",
    "rich",
    "shtab",
    "numpy",
    "asammdf",
    "pyarrow",
    "paho-mqtt",
    "prometheus-client",
)


class BundlePart(NamedTuple):
    """A file of the bundle."""

    name: str
    size: int
    """Approximate number of bytes."""
    chunks: Callable[[], Iterable[bytes]]
    """Makes the content, each time it is called."""


class Contents:
    """The parts that were made, and a line for each one that is missing."""

    def __init__(self, cleaner: Cleaner) -> None:
        self.cleaner = cleaner
        self.parts: list[BundlePart] = []
        self.missing: list[str] = []
        self.digests: dict[str, str] = {}
        """SHA-256 of each part, and of original files from which nothing was removed."""

    @contextmanager
    def noting(self, name: str) -> Iterator[None]:
        """Turn an error into a line about the part that is missing."""
        try:
            yield
        except UserError as error:
            self.missing.append(f"{name}: {'; '.join(error.problems)}")
        except OSError as error:
            advice = ". Run doctor with sudo." if isinstance(error, PermissionError) else ""
            self.missing.append(f"{name}: {error.filename or ''}: {error.strerror}{advice}")
        except Exception as error:  # a bug in one part must not prevent the others
            self.missing.append(f"{name}: fault of the program: {error!r}")

    def add(self, name: str, data: bytes) -> None:
        """Add a part whose content has no secrets."""
        self.parts.append(BundlePart(name, len(data), lambda: [data]))
        self.digests[name] = hashlib.sha256(data).hexdigest()

    def add_text(self, name: str, text: str) -> None:
        """Add a text of the program after removing secrets."""
        cleaned = self.cleaner.text(printable(text, keep="\n\t"), name)
        self.add(name, cleaned.encode("utf-8", "replace"))

    def add_document(self, name: str, document: Any) -> None:
        """Add a JSON document after removing secrets."""
        cleaned = self.cleaner.document(document, name)
        self.add(name, printable_json(cleaned, indent=1).encode("utf-8", "replace"))

    def add_file(self, name: str, path: Path, clean: Callable[[str, str, Cleaner], str]) -> None:
        """Add a file of the user. It is read as Latin-1, so that no byte of it is lost."""
        with self.noting(name):
            original = _read(path, _LARGEST_FILE)
            data = clean(original.decode("latin-1"), name, self.cleaner).encode("latin-1")
            self.add(name, data)
            if data == original:
                self.digests[str(path)] = self.digests[name]


def _read(path: Path, limit: int) -> bytes:
    """Return the content of a plain file. OSError or UserError if that is not possible."""
    if path.exists() and not path.is_file():
        raise UserError(f"{path} is not a file")
    with path.open("rb") as file:
        data = file.read(limit + 1)
    if len(data) > limit:
        raise UserError(f"{path} has more than {limit >> 20} MB")
    return data


# --- the configuration and its files


def known_secrets(config: Path) -> dict[str, str]:
    """Return the secrets that a configuration and its password file contain, with their names."""
    try:
        text = _read(config, _LARGEST_FILE).decode("utf-8", "replace")
    except (OSError, UserError):
        return {}
    found: dict[str, str] = {}
    tables = tables_of(text)
    for value, name in (*values_of_secrets(tables), *_values_of_options(tables)):
        if name.endswith("_file") and _is_file(config.parent / value):
            if "password" in name:
                found |= _first_line(config.parent / value, name)
        elif not (name.endswith("username") and value.lower() in _OUR_WORDS):
            found[value] = name
            found[Path(value).name] = name
    return found


def _values_of_options(tables: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the texts of the interface's options that may be secrets, each with its name."""
    table, key = OPTIONS
    options = tables.get(table)
    options = options.get(key) if isinstance(options, dict) else None
    for name, value in options.items() if isinstance(options, dict) else ():
        if isinstance(value, str):
            yield value, f"{table}.{key}.{name}"


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def _first_line(path: Path, name: str) -> dict[str, str]:
    """Return the password in a file. Empty if the file cannot be read."""
    try:
        with path.open("rb") as file:
            line = file.read(_LARGEST_PASSWORD).split(b"\n")[0].rstrip(b"\r")
    except OSError:
        return {}
    return {line.decode("utf-8", "replace"): f"the file of {name}"}


def add_configuration(contents: Contents, config: Path, *, with_dbc: bool) -> None:
    """Add the configuration, and the DBC and EDS that it uses, also if it has mistakes."""
    contents.add_file(f"configuration/{_file_name(config)}", config, _clean_utf_8)
    tables: Mapping[str, Any] = {}
    try:
        tables = tables_of(_read(config, _LARGEST_FILE).decode("utf-8-sig", "replace"))
    except (OSError, UserError):
        return  # reported above
    dbc = tables.get("dbc", {})
    if with_dbc and isinstance(dbc, dict) and dbc.get("enabled", True) is True:
        path = _path(config, dbc.get("file", SHIPPED), "dbc/kontronik_esc.dbc")
        contents.add_file(f"dbc/{_file_name(path)}", path, clean_dbc)
    canopen = tables.get("canopen", {})
    if isinstance(canopen, dict) and canopen.get("enabled") is True:
        path = _path(config, canopen.get("eds", SHIPPED), "eds/kontronik_esc.eds")
        contents.add_file(f"eds/{_file_name(path)}", path, clean_eds)


def _clean_utf_8(text: str, part: str, cleaner: Cleaner) -> str:
    """Clean a configuration, which is UTF-8 but is given and returned as Latin-1."""
    decoded = text.encode("latin-1").decode("utf-8", "replace")
    return clean_toml(decoded, part, cleaner).encode().decode("latin-1")


def _path(config: Path, name: Any, shipped_name: str) -> Path:
    return shipped(shipped_name) if name == SHIPPED else config.parent / str(name)


def _file_name(path: Path) -> str:
    """Return the name of a file so that it is safe in a zip file."""
    return printable(path.name).replace("\\", "?")[-100:] or "file"


# --- the journal


def add_journal(contents: Contents, machine: Machine) -> None:
    """Add the last day of the journal of all our services."""
    out, err = machine.outputs(*_JOURNAL, _UNITS, patience_s=_JOURNAL_PATIENCE_S)
    lines = [line for line in out[-_LARGEST_JOURNAL:].splitlines() if not line.startswith("-- ")]
    if lines:
        contents.add_text(JOURNAL, "\n".join(lines) + "\n")
        return
    reason = "there is no journalctl on this machine"
    if err is not None:
        reason = f"the services {_UNITS} have written nothing in the last day"
        if "permission" in err.lower() or "not seeing messages" in err:
            reason = f"{machine.user} may not read it. Run doctor with sudo."
    contents.missing.append(f"{JOURNAL}: {reason}")


# --- captures


def add_captures(
    contents: Contents,
    folders: Iterable[Path],
    *,
    with_dbc: bool,
    watch: Callable[[Iterator[bytes], str], Iterator[bytes]] = lambda data, _: data,
) -> None:
    """Add the two newest captures in these folders.

    The bytes that are read from a capture pass through ``watch`` together with its name.
    """
    found: dict[tuple[int, str], Path] = {}
    places = list(dict.fromkeys(folders))
    before = len(contents.missing)
    for folder in places:
        with contents.noting("captures"):
            for path in folder.iterdir():
                if path.suffix == SUFFIX and path.is_file():
                    found[path.stat().st_mtime_ns, str(path)] = path
    for _, path in sorted(found.items(), reverse=True)[:_CAPTURES]:
        with contents.noting("captures"), path.open("rb"):
            contents.parts.append(_capture(contents, path, with_dbc, watch))
    if not found and len(contents.missing) == before:
        where = ", ".join(map(str, places))
        reason = f"there is none in {where}" if where else "this configuration records none"
        contents.missing.append(f"captures: {reason}")


def _capture(
    contents: Contents,
    path: Path,
    with_dbc: bool,
    watch: Callable[[Iterator[bytes], str], Iterator[bytes]],
) -> BundlePart:
    name = f"captures/{_file_name(path)}"

    def chunks() -> Iterator[bytes]:
        contents.cleaner.begin(name)
        with path.open("rb", buffering=0) as file:
            data = watch(_without_holes(file), name)
            yield from clean_capture(data, name, contents.cleaner, with_dbc=with_dbc)

    return BundlePart(name, path.stat().st_size, chunks)


def _without_holes(file: FileIO) -> Iterator[bytes]:
    """Yield the content of a file. Of a hole in a sparse file, at most two chunks of zeros."""
    was_zeros = False
    while data := file.read(_CHUNK):
        is_zeros = data == bytes(len(data))
        if is_zeros and was_zeros:
            file.seek(_next_data(file))
        was_zeros = is_zeros
        yield data


def _next_data(file: FileIO) -> int:
    """Return the position of the next data of a file, which is its end behind its last data."""
    here = file.tell()
    try:
        return os.lseek(file.fileno(), here, os.SEEK_DATA)
    except OSError as error:
        return max(here, os.fstat(file.fileno()).st_size) if error.errno == errno.ENXIO else here


# --- versions


def add_versions(contents: Contents, machine: Machine, made: str) -> None:
    """Add the versions of all programs, and the digests of the parts so far."""
    release = machine.text("/etc/os-release")
    system = next(
        (line for line in release.splitlines() if line.startswith("PRETTY_NAME=")), "PRETTY_NAME=?"
    )
    try:
        core = hashlib.sha256(shared_object().read_bytes()).hexdigest()
    except OSError as error:
        core = reason_of(error)
    versions = {
        "made": made,
        "kontronik-can-gw": __version__,
        "program": _program_digest(),
        "core": core,
        "python": sys.version,
        "system": system.partition("=")[2].strip('"'),
        "kernel": f"{platform.release()} {platform.machine()}",
        "libraries": {name: _version_of(name) for name in _LIBRARIES},
        "sha256": contents.digests,
    }
    name = "versions.json"  # not cleaned, because digests look like keys
    contents.add(name, printable_json(versions, indent=1).encode("utf-8", "replace"))


def _version_of(library: str) -> str | None:
    try:
        return metadata.version(library)
    except metadata.PackageNotFoundError:
        return None


def _program_digest() -> str:
    """Return the SHA-256 of the program's modules and tables, so that changes are noticed."""
    package = Path(__file__).resolve().parents[2]
    found = hashlib.sha256()
    for path in sorted((*package.rglob("*.py"), *package.rglob("*.toml"), *package.rglob("*.tsv"))):
        found.update(os.fsencode(path.relative_to(package)) + b"\0" + path.read_bytes())
    return found.hexdigest()
