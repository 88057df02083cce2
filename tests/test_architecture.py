"""The structure of docs/design.md: imports run one way, and only the edge uses time and files."""

import ast
import sys
from collections.abc import Collection, Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from kontronik_can_gw.core.output_setup import OUTPUTS

pytestmark = pytest.mark.promise("structure")

PACKAGE = Path(__file__).resolve().parents[1] / "kontronik_can_gw"
NAME = "kontronik_can_gw"
ORDER = (
    "printable",
    "errors",
    "frames",
    "entry_kinds",
    "light_imports",
    "times",
    "status",
    "esc",
    "signals",
    "core",
    "config",
    "dbc",
    "native",
    *OUTPUTS,
    "gateway",
    "capture",
    "runtime",
    "assembly",
    "desk",
    "cli",
)
"""Modules and folders of the package. Each may import itself and those before it."""
EDGE = ("native", "runtime", "config", "assembly", "desk", "cli")
BLOCKING = {
    "time",
    "asyncio",
    "threading",
    "socket",
    "selectors",
    "select",
    "subprocess",
    "os",
    "signal",
}
ONLY_IN = {
    "cantools": (
        "dbc/",
        "desk/dbc/",
        "assembly/capture_setup.py",
        "assembly/assemble.py",
        "desk/recordings/layouts.py",
        "cli",
    ),
    "serial": ("runtime",),
    "can": ("runtime", "desk"),
    "rich": ("cli", "desk/monitor"),
    "numpy": ("desk",),
    "pyarrow": ("desk",),
    "asammdf": ("desk",),
    "paho": ("desk",),
    "starlette": ("desk/live/",),
    "uvicorn": ("desk/live/",),
    "segno": ("cli",),
    "shtab": ("cli",),
}
MODULES = sorted(PACKAGE.rglob("*.py"))


def _room(path: Path) -> str:
    relative = path.relative_to(PACKAGE)
    return relative.parts[0] if len(relative.parts) > 1 else relative.stem


def _imports(path: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}: relative import"
            found.add(node.module)
    return found


def _level(module: str) -> int:
    """Return the place in ORDER of a module, given by its dotted name below the package."""
    folder = module.partition(".")[0]
    assert folder in ORDER, f"add {folder} to ORDER, and to the folders of docs/design.md"
    return ORDER.index(folder)


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_run_one_way_and_each_library_stays_in_its_folder(path: Path) -> None:
    name = str(path.relative_to(PACKAGE))
    own = name.removesuffix(".py").replace("/", ".")
    for module in _imports(path):
        library, _, inside = module.partition(".")
        if library in ONLY_IN:
            assert name.startswith(ONLY_IN[library]), f"{name} imports {library}"
        if library == NAME and inside and own not in ("__init__", "__main__"):
            assert _level(inside) <= _level(own), f"{own} imports {inside}"


def _module_name(path: Path) -> str:
    parts = (NAME, *path.relative_to(PACKAGE).with_suffix("").parts)
    return ".".join(parts).removesuffix(".__init__")


def _imported_modules(path: Path, modules: Collection[str]) -> set[str]:
    """Return the modules of the package that a file imports, also those for types only."""
    found = set(_imports(path))
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            submodules = names.intersection(modules)
            if submodules:
                found.discard(node.module)
                found |= submodules
    return found.intersection(modules) - {_module_name(path)}


def test_no_modules_import_each_other_in_a_circle() -> None:
    """Imports for types count, too: modules in a circle cannot be read one after the other."""
    files = {_module_name(path): path for path in MODULES}
    graph = {name: _imported_modules(path, files) for name, path in files.items()}
    assert graph[f"{NAME}.runtime.loop"] >= {f"{NAME}.runtime.native_poller", f"{NAME}.times"}
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the circle


NEVER_ON_THE_BOARD = {
    "__main__": "starts the command line",
    "esc.kontronik.simulator": "a part of the protocol",
    "native.compile": "compiles the core when the package is built",
}
"""Modules outside desk and cli that `run` never imports, with the reason why they are there."""


def test_everything_outside_desk_and_cli_is_imported_by_run() -> None:
    files = {_module_name(path): path for path in MODULES}
    outputs = {name for name in files if name.startswith(tuple(f"{NAME}.{o}." for o in OUTPUTS))}
    waiting = {f"{NAME}.cli.run", *outputs}
    found = set[str]()
    while waiting:
        found |= waiting
        waiting = set().union(*(_imported_modules(files[each], files) for each in waiting)) - found
    unused = [
        name.removeprefix(f"{NAME}.")
        for name, path in files.items()
        if name not in found and _room(path) not in ("desk", "cli") and path.name != "__init__.py"
    ]
    assert sorted(unused) == sorted(NEVER_ON_THE_BOARD)


def _calls(path: Path) -> set[str]:
    """Return the plain functions that are called in a file, for example ``open``."""
    tree = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    called = [node.func for node in tree if isinstance(node, ast.Call)]
    return {function.id for function in called if isinstance(function, ast.Name)}


@pytest.mark.promise("sans-io")
@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_only_the_edge_blocks_and_no_module_compiles_text(path: Path) -> None:
    assert not _calls(path) & {"exec", "eval", "compile"}
    if _room(path) not in EDGE and path.name != "__main__.py":
        assert not _imports(path) & BLOCKING
        assert "open" not in _calls(path)


def test_protocol_imports_only_the_standard_library() -> None:
    for path in (PACKAGE / "esc" / "kontronik").glob("*.py"):
        for module in _imports(path):
            top = module.split(".")[0]
            own = module.startswith((f"{NAME}.esc.kontronik", f"{NAME}.esc.decoder"))
            assert own or top in sys.stdlib_module_names, f"{path.name}: {module}"


@pytest.mark.promise("silent-to-esc")
def test_no_serial_port_is_ever_written() -> None:
    """The module that owns the port neither calls nor defines a method that writes."""
    tree = ast.parse((PACKAGE / "runtime" / "ports" / "serial_port.py").read_text(encoding="utf-8"))
    called = {
        node.func.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
    }
    assert not called & {"write", "writelines", "send_break", "sendBreak"}
    defined = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    assert not any("write" in name or "send" in name for name in defined)


@pytest.mark.promise("layout-in-files")
def test_package_contains_no_can_id_of_the_shipped_dbc() -> None:
    """Ids of the shipped DBC do not appear in the modules of the package."""
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and type(node.value) is int:
                assert not 0x680 <= node.value <= 0x6DF, f"{path}: {node.value:#x}"


@pytest.mark.promise("wire-private")
def test_only_its_own_folder_uses_the_wire_protocol() -> None:
    """Only protocols.py imports a protocol.

    The C core is compiled with a header that is generated from the fields. Modules that run a
    simulated ESC import it.
    """
    wire = f"{NAME}.esc.kontronik"
    runs_a_simulated_esc = {"cli/simulate.py", "desk/pty.py", "desk/sources.py"}
    for path in MODULES:
        name = path.relative_to(PACKAGE).as_posix()
        known = {module for module in _imports(path) if module.startswith(wire)}
        if name in runs_a_simulated_esc:
            known.discard(f"{wire}.simulator")
        if name == "esc/protocols.py":
            known.discard(f"{wire}.protocol")
        if name == "native/objects.py":
            known.discard(f"{wire}.c_header")
        if not name.startswith("esc/kontronik/"):
            assert not known, f"{name} knows the wire"


OUTPUT_TOOLS = (
    "cli/common.py",
    "cli/dbc.py",
    "cli/describe.py",
    "cli/eds.py",
    "desk/conformance/eds_",
    "desk/dbc/",
    "desk/dcf.py",
    "desk/describe/",
)
"""Modules that describe CANopen nodes: commands for EDS and DBC files, tables, a slave's EDS."""


@pytest.mark.promise("wire-private")
def test_only_its_own_tools_import_an_output() -> None:
    """Everything else uses an output through core/output.py and core/output_setup.py."""
    rooms = tuple(f"{NAME}.{output}" for output in OUTPUTS)
    importers = set()
    for path in MODULES:
        name = path.relative_to(PACKAGE).as_posix()
        if _room(path) not in OUTPUTS and any(each.startswith(rooms) for each in _imports(path)):
            importers.add(name)
    assert importers
    assert [name for name in sorted(importers) if not name.startswith(OUTPUT_TOOLS)] == []


MAX_LINES = {"file": 500, "class": 320, "function": 60}
MAX_METHODS = 26


def _sizes(tree: ast.AST, place: str) -> Iterator[tuple[str, int]]:
    """Yield classes and functions over their limits, with their number of lines or methods."""
    for node in ast.iter_child_nodes(tree):
        inside = place
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            inside = f"{place}:{node.name}"
            kind = "class" if isinstance(node, ast.ClassDef) else "function"
            lines = (node.end_lineno or 0) - node.lineno + 1
            if lines > MAX_LINES[kind]:
                yield f"{kind} {inside}", lines
            methods = sum(isinstance(each, ast.FunctionDef) for each in node.body)
            if kind == "class" and methods > MAX_METHODS:
                yield f"methods {inside}", methods
        yield from _sizes(node, inside)


@pytest.mark.promise("small")
def test_files_classes_and_functions_fit_their_limits() -> None:
    """Split by subject if one of them grows too large to read."""
    found: dict[str, int] = {}
    for path in MODULES:
        source = path.read_text(encoding="utf-8")
        name = str(path.relative_to(PACKAGE))
        if (lines := source.count("\n")) > MAX_LINES["file"]:
            found[f"file {name}"] = lines
        found.update(_sizes(ast.parse(source), name))
    assert found == {}
