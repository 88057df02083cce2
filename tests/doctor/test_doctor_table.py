"""checks.toml and the checks that say its cases agree; it is in the package."""

import ast
from pathlib import Path

from kontronik_can_gw.cli import doctor as command
from kontronik_can_gw.desk import doctor
from kontronik_can_gw.desk.doctor.findings import Severity, wordings

MODULES = [*Path(doctor.__path__[0]).glob("*.py"), Path(command.__file__)]
NODES = [node for path in MODULES for node in ast.walk(ast.parse(path.read_text("utf-8")))]
TEXTS = {node.value for node in NODES if isinstance(node, ast.Constant)}
ROWS = [(check, case, row) for check, cases in wordings().items() for case, row in cases.items()]


def test_each_row_has_a_severity_and_a_text_and_is_said_somewhere() -> None:
    for check, case, (severity, text, *more) in ROWS:
        assert Severity(severity) and text and len(more) <= 2, f"{check}: {case}"
        assert {check, case} <= TEXTS, f"{check}: {case} is never said"


def branches(node: ast.expr) -> list[object]:
    """The constants that an expression may give."""
    if isinstance(node, ast.IfExp):
        return branches(node.body) + branches(node.orelse)
    return [node.value] if isinstance(node, ast.Constant) else []


def test_what_is_said_is_in_the_table() -> None:
    said = [
        (check, case)
        for node in NODES
        if isinstance(node, ast.Call) and len(node.args) > 1
        for check in branches(node.args[0])
        if check in wordings()
        for case in branches(node.args[1])
    ]
    assert len(said) > len(ROWS) / 2
    for check, case in said:
        assert case in wordings()[str(check)], f"{check}: {case}"
