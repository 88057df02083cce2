"""The most instructions of each function of a Thumb-2 image, from its machine code and loop limits.

The control flow of each function is read from `objdump -dl`. The cost of a function is its longest
path. A loop is identified by the source line of the branch that closes it, and repeats at most as
often as its limit says. Some loops have no limit of their own, but a limit for a whole call of the
core, for example one pass for each byte. They are left out of the paths, and the cost of one pass
is kept for each.

Recursion, computed jumps, calls through pointers and a loop without a limit raise ValueError.
"""

import re
import subprocess
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

CONDITIONS = ("eq", "ne", "cs", "cc", "mi", "pl", "vs", "vc", "hi", "ls", "ge", "lt", "gt", "le")
NO_PATH = -1
_CONDITIONAL = rf"(?:{'|'.join(CONDITIONS)}|hs|lo)"


@dataclass
class Block:
    """Instructions that are run one after the other."""

    instructions: int = 0
    calls: list[str] = field(default_factory=list)
    next: list[int] = field(default_factory=list)
    """Addresses of the blocks that may follow. Empty: the function returns."""
    line: str = ""
    """Source text of the last instruction."""


@dataclass
class Function:
    name: str
    entry: int
    blocks: dict[int, Block]


@dataclass(frozen=True)
class _Instruction:
    address: int
    mnemonic: str
    operands: str
    line: str


def read_functions(image: Path, objdump: str = "arm-none-eabi-objdump") -> dict[str, Function]:
    """Return the functions of an image by name."""
    text = subprocess.run(
        [objdump, "-dl", "--no-show-raw-insn", str(image)],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    sources = _Sources()
    found: dict[str, list[_Instruction]] = {}
    name = line = ""
    for row in text.splitlines():
        if head := re.match(r"[0-9a-f]+ <([^>]+)>:", row):
            name = head[1]
            line = ""
            found[name] = []
        elif place := re.match(r"(/\S+):(\d+)", row):
            line = sources.line(place[1], int(place[2]))
        elif code := re.match(r"\s+([0-9a-f]+):\s+([^.\s]\S*)\s*([^;@]*)", row):
            found[name].append(_Instruction(int(code[1], 16), code[2], code[3].strip(), line))
    return {name: _function(name, code) for name, code in found.items() if code}


class _Sources:
    """Lines of source files."""

    def __init__(self) -> None:
        self._files: dict[str, list[str]] = {}

    def line(self, path: str, number: int) -> str:
        if path not in self._files:
            file = Path(path)
            self._files[path] = file.read_text().splitlines() if file.exists() else []
        lines = self._files[path]
        return lines[number - 1].strip() if number <= len(lines) else path


def _function(name: str, code: list[_Instruction]) -> Function:
    """Split the instructions of a function into blocks."""
    inside = {each.address for each in code}
    begins = {code[0].address}
    jumps: dict[int, tuple[list[int], bool]] = {}
    calls: dict[int, str] = {}
    conditional_left = 0
    for number, each in enumerate(code):
        after = code[number + 1].address if number + 1 < len(code) else None
        in_it = conditional_left > 0
        conditional_left -= in_it
        bare = each.mnemonic.removesuffix(".n").removesuffix(".w")
        target = re.search(r"\b([0-9a-f]+) <([^>+]+)(\+0x[0-9a-f]+)?>", each.operands)
        if re.fullmatch(r"it[te]{0,3}", bare):
            conditional_left = len(bare) - 1
            continue
        if bare in ("bl", "blx"):
            if not target:
                raise ValueError(f"{name}: call through a pointer: {each}")
            calls[each.address] = target[2]
            continue
        ends = bare.startswith(("tbb", "tbh")) or (
            bare.startswith("mov") and "pc," in each.operands
        )
        if ends:
            raise ValueError(f"{name}: computed jump: {each}")
        is_return = (bare.startswith("bx") and "lr" in each.operands) or (
            bare.startswith(("pop", "ldm", "ldr")) and re.search(r"\bpc\b", _written(each))
        )
        is_branch = bool(re.fullmatch(rf"b(?:{_CONDITIONAL})?|cbn?z", bare))
        if not is_return and not is_branch:
            continue
        may_fall = in_it or bool(re.fullmatch(rf"b{_CONDITIONAL}|cbn?z", bare))
        targets = []
        if is_branch:
            assert target, each
            place = int(target[1], 16)
            if place in inside and target[2] == name:
                targets.append(place)
                begins.add(place)
            else:
                calls[each.address] = target[2]  # a call at the end of the function
        if may_fall:
            assert after is not None, each
            targets.append(after)
        jumps[each.address] = (targets, True)
        if after is not None:
            begins.add(after)
    return Function(name, code[0].address, _blocks(code, begins, jumps, calls))


def _written(each: _Instruction) -> str:
    """Return the registers that a load writes."""
    if each.mnemonic.startswith("ldr"):
        return each.operands.split(",")[0]
    return each.operands


def _blocks(
    code: list[_Instruction],
    begins: set[int],
    jumps: Mapping[int, tuple[list[int], bool]],
    calls: Mapping[int, str],
) -> dict[int, Block]:
    blocks: dict[int, Block] = {}
    block = Block()
    for number, each in enumerate(code):
        if each.address in begins:
            block = blocks.setdefault(each.address, Block())
        block.instructions += 1
        block.line = each.line
        if each.address in calls:
            block.calls.append(calls[each.address])
        after = code[number + 1].address if number + 1 < len(code) else None
        if each.address in jumps:
            block.next = jumps[each.address][0]
        elif after is None:
            pass  # a function that does not return, or data follow
        elif after in begins:
            block.next = [after]
    return blocks


@dataclass
class Costs:
    """The longest paths of an image."""

    functions: Mapping[str, Function]
    limits: Mapping[str, int]
    """By the source text of a loop: how often it repeats at most, each time it is entered."""
    shared: Mapping[str, str]
    """Names of the loops that have a limit for a whole call of the core, by their source texts."""
    shared_calls: Mapping[tuple[str, str], str] = field(default_factory=dict)
    """Names of calls with such a limit, by the functions that call and that are called."""
    passes: dict[str, int] = field(default_factory=dict)
    """The cost of one pass of each shared loop, by its name."""
    used: set[str] = field(default_factory=set)
    """Source texts of all loops that were found."""
    _known: dict[str, int] = field(default_factory=dict)
    _open: list[str] = field(default_factory=list)

    def of(self, name: str) -> int:
        """Return the most instructions of a function, without the shared loops."""
        if name in self._known:
            return self._known[name]
        if name in self._open:
            raise ValueError(f"recursion: {' '.join(self._open)} {name}")
        self._open.append(name)
        function = self.functions[name]
        ends = {address for address, block in function.blocks.items() if not block.next}
        found = self._path(function, set(function.blocks), {function.entry}, set(), ends)
        self._open.pop()
        self._known[name] = found
        return found

    def _cost(self, function: Function, block: Block) -> int:
        cost = block.instructions
        for name in block.calls:
            pair = (_plain(function.name), _plain(name))
            shared = self.shared_calls.get(pair)
            if shared is None:
                cost += self.of(name)
            else:
                self.passes[shared] = max(self.passes.get(shared, 0), self.of(name))
        return cost

    def _path(
        self,
        function: Function,
        nodes: set[int],
        entries: set[int],
        cut: set[int],
        ends: set[int],
    ) -> int:
        """Return the longest path through `nodes` from one of `entries` to one of `ends`.

        Edges to the nodes of `cut` are left out. Without such a path, the result is 0.
        """
        blocks = function.blocks
        edges = {
            node: [each for each in blocks[node].next if each in nodes and each not in cut]
            for node in nodes
        }
        groups = _strong_groups(edges)
        group_of = {node: number for number, group in enumerate(groups) for node in group}
        longest: dict[int, int] = {}
        for number, group in enumerate(groups):  # each after all that it leads to
            further = [
                longest[group_of[each]]
                for node in group
                for each in edges[node]
                if group_of[each] != number
            ]
            if ends & set(group):
                further.append(0)
            best = max(further, default=NO_PATH)
            if best > NO_PATH:
                best += self._through(function, group, edges, entries)
            longest[number] = best
        return max(0, *(longest[group_of[node]] for node in entries))

    def _through(
        self,
        function: Function,
        group: list[int],
        edges: Mapping[int, list[int]],
        entries: set[int],
    ) -> int:
        """Return the cost of a block or of a whole loop."""
        inside = set(group)
        (first, *others) = group
        if not others and first not in edges[first]:
            return self._cost(function, function.blocks[first])
        heads = inside & entries
        for node, targets in edges.items():
            if node not in inside:
                heads |= inside & set(targets)
        ends = {node for node in group if heads & set(edges[node])}
        closing = {function.blocks[node].line for node in ends}
        self.used |= closing
        shared = {self.shared[line] for line in closing if line in self.shared}
        limits = [self.limits[line] for line in closing if line in self.limits]
        if len(shared) + bool(limits) != 1:
            raise ValueError(f"{function.name}: not one limit for a loop: {sorted(closing)}")
        exits = set()
        for node in group:
            following = function.blocks[node].next
            if not following or not inside.issuperset(following):
                exits.add(node)
        repeated = self._path(function, inside, heads, heads, ends) * len(heads)
        last = self._path(function, inside, heads, heads, exits) * len(heads)
        if limits:
            return repeated * max(limits) + last
        for name in shared:
            self.passes[name] = max(self.passes.get(name, 0), repeated, last)
        return 0


def _plain(name: str) -> str:
    """Return the name in the source of a function, of which the compiler made a variant."""
    return name.partition(".")[0]


def _strong_groups(edges: Mapping[int, Iterable[int]]) -> list[list[int]]:
    """Return the strongly connected components. Each follows all that it leads to (Tarjan)."""
    index: dict[int, int] = {}
    low: dict[int, int] = {}
    stack: list[int] = []
    groups: list[list[int]] = []

    def visit(node: int) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for each in edges[node]:
            if each not in index:
                visit(each)
                low[node] = min(low[node], low[each])
            elif each in stack:
                low[node] = min(low[node], index[each])
        if low[node] == index[node]:
            place = stack.index(node)
            groups.append(stack[place:])
            del stack[place:]

    for node in edges:
        if node not in index:
            visit(node)
    return groups
