"""Mutations of Python source, one expression or statement at a time, each with a key that does not depend on its line.

The key is a hash of file, function, kind and both texts, so that code that does not change keeps its mutations.
"""

import ast
import copy
import hashlib
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# fmt: off
_OTHER: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.FloorDiv, ast.FloorDiv: ast.Mult, ast.Div: ast.Mult,
    ast.Mod: ast.FloorDiv, ast.Pow: ast.Mult, ast.LShift: ast.RShift, ast.RShift: ast.LShift,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.BitXor: ast.BitOr,
}
# fmt: on
_SYMMETRIC = frozenset({"min", "max", "gcd", "isinstance", "issubclass", "cast", "isclose"})
_UNTOUCHED = frozenset(
    {"annotation", "returns", "decorator_list", "type_params", "bases", "format_spec"}
)
_PROSE = re.compile(r"[a-z]{3,} [a-z]{3,}")
_THEN = ast.Constant(...)
# the parent, its field, the index in it, the node there
_Place = tuple[ast.AST, str, int | None, ast.AST]


@dataclass(frozen=True, eq=False)
class Mutation:
    """``after`` in the place of a node. ``line``: where its statement begins; a test that does not execute that cannot see it."""

    file: Path
    tree: ast.Module
    function: str
    place: _Place
    after: ast.AST
    line: int
    key: str

    def __str__(self) -> str:
        before = self.place[3]
        return f"{self.file}:{getattr(before, 'lineno', 0)} {self.function}: {_text(before, 90)} -> {_text(self.after, 90)}"

    @property
    def module(self) -> str:
        return ".".join(self.file.with_suffix("").parts).removesuffix(".__init__")

    @classmethod
    def of_text(cls, file: Path, source: str) -> "Mutation":
        """A whole file with another text."""
        tree = ast.parse(source)
        return cls(file, tree, "", (tree, "body", 0, tree.body[0]), tree.body[0], 0, "")

    def put_in(self) -> None:
        parent, name, index, _ = self.place
        if index is None:
            setattr(parent, name, self.after)
        else:
            getattr(parent, name)[index] = self.after


def mutations(file: Path, source: str) -> Iterator[Mutation]:
    """All mutations of a file in the order of its source."""
    tree, seen = ast.parse(source), Counter[str]()
    for function, line, place in _places(tree, "", 0):
        for kind, after in _instead(place[3]):
            identity = f"{file}|{function}|{kind}|{_text(place[3])}|{_text(after)}"
            seen[identity] += 1
            key = hashlib.sha256(f"{identity}|{seen[identity]}".encode()).hexdigest()[:10]
            yield Mutation(file, tree, function or "<module>", place, after, line, key)


def noting_lines(source: str, file: str, name: str) -> ast.Module:
    """The source with a call of ``name`` (file, line) in front of each statement."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        for field, body in ast.iter_fields(node):
            if isinstance(body, list) and body and isinstance(body[0], ast.stmt):
                noted: list[ast.stmt] = []
                for at, statement in enumerate(body):
                    is_docstring = (
                        at == 0
                        and isinstance(statement, ast.Expr)
                        and isinstance(statement.value, ast.Constant)
                    )
                    call = f"{name}(({file!r}, {statement.lineno}))"
                    noted += [statement] if is_docstring else [*ast.parse(call).body, statement]
                setattr(node, field, noted)
    return tree


def _places(node: ast.AST, function: str, line: int) -> Iterator[tuple[str, int, _Place]]:
    """All that code reads: function, line of the statement, place. What only people or type checkers read is left out."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        function = f"{function}.{node.name}".lstrip(".")
    for name, value in ast.iter_fields(node):
        for index, child in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if name in _UNTOUCHED or not isinstance(child, ast.AST) or _is_type(node, name, index):
                continue
            of_child = child.lineno if isinstance(child, ast.stmt) else line
            yield function, of_child, (node, name, index, child)
            if not _is_for_people(child):
                yield from _places(child, function, of_child)


def _is_for_people(node: ast.AST) -> bool:
    """Error texts, assertions for the type checker, blocks that only it reads, texts of an object."""
    match node:
        case ast.Raise() | ast.Assert() | ast.If(test=ast.Name(id="TYPE_CHECKING")):
            return True
        case ast.FunctionDef(name="__repr__" | "__str__"):
            return True
        case ast.JoinedStr(values=values):
            return bool(
                _PROSE.search(
                    "".join(
                        str(getattr(part, "value", ""))
                        for part in values
                        if isinstance(part, ast.Constant)
                    )
                )
            )
    return False


def _is_type(parent: ast.AST, name: str, index: int | None) -> bool:
    match parent:
        case ast.Call(func=ast.Name(id="isinstance" | "issubclass")):
            return name == "args" and index == 1
        case ast.BinOp(op=ast.BitOr(), left=ast.Name(id=first)):
            return first[0].isupper() or first in ("int", "str", "bytes")  # a union
        case ast.keyword(arg="strict"):
            return True
    return False


def _instead(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """What can take a node's place, and the kind of that."""
    nothing = ast.copy_location(ast.Pass(), node)
    match node:
        case ast.Compare(ops=ops):
            for at, op in enumerate(ops):
                yield "compare", _with(node, ops=[*ops[:at], _OTHER[type(op)](), *ops[at + 1 :]])
        case ast.BinOp(op=op) if type(op) in _OTHER and not _is_type(node, "left", None):
            yield "operator", _with(node, op=_OTHER[type(op)]())
        case ast.Constant(value=bool(value)):
            yield "constant", _with(node, value=not value)
        case ast.Constant(value=int(value) | float(value)):
            yield "constant", _with(node, value=value + (-1 if _coin(node) else 1))
        case ast.BoolOp(op=op):
            yield "and/or", _with(node, op=_OTHER[type(op)]())
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            yield "not", operand
        case ast.Call(func=func, args=[first, second, *rest]):
            is_odd = any(
                isinstance(each, ast.Starred) or _is_for_people(each) for each in (first, second)
            )
            is_symmetric = getattr(func, "id", getattr(func, "attr", "")) in _SYMMETRIC
            if not is_odd and not is_symmetric and ast.dump(first) != ast.dump(second):
                yield "arguments", _with(node, args=[second, first, *rest])
        case ast.If(test=test) | ast.IfExp(test=test) if not _is_for_people(node):
            yield "condition", _with(node, test=ast.copy_location(ast.Constant(_coin(test)), test))
        case ast.While(test=test) if not isinstance(test, ast.Constant):
            yield "condition", _with(node, test=ast.copy_location(ast.Constant(False), test))
        case ast.Return(value=ast.AST() as value) if getattr(value, "value", value) is not None:
            yield "return", _with(node, value=ast.copy_location(ast.Constant(None), value))
        case ast.AugAssign(op=op):
            yield "operator", _with(node, op=_OTHER[type(op)]())
            yield "statement", nothing
        case (
            ast.Assign(targets=[ast.Attribute() | ast.Subscript(), *_])
            | ast.Delete()
            | ast.Expr(value=ast.Call())
        ):
            yield "statement", nothing
        case ast.Raise() | ast.Break() | ast.Continue():
            yield "statement", nothing


def _with(node: ast.AST, **changed: Any) -> ast.AST:
    other = copy.copy(node)
    for name, value in changed.items():
        setattr(other, name, value)
    return other


def _coin(node: ast.AST) -> bool:
    return hashlib.sha256(ast.dump(node).encode()).digest()[0] % 2 == 1


def _text(node: ast.AST, limit: int = 1000) -> str:
    """Source of a node in one line; of a compound statement its head."""
    head: ast.AST = (
        ast.IfExp(node.test, _THEN, _THEN) if isinstance(node, ast.If | ast.While) else node
    )
    text = " ".join(ast.unparse(head).split()).removeprefix("... ").removesuffix(" else ...")
    return text if len(text) <= limit else f"{text[: limit - 1]}…"
