"""Runs the items of a conformance test, and writes the results as a table and as JUnit."""

import tomllib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree as ET

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.desk.conformance import (
    eds_items,
    emergency_items,
    lss_items,
    nmt_items,
    od_items,
    pdo_items,
    sdo_items,
    storage_items,
)
from kontronik_can_gw.desk.conformance.eds_file import EdsFile
from kontronik_can_gw.desk.conformance.items import Skipped, Wrong
from kontronik_can_gw.desk.conformance.nmt_items import RESET_NODE
from kontronik_can_gw.desk.conformance.slave import (
    AbortedTransfer,
    NoAnswer,
    Slave,
    UnexpectedAnswer,
)
from kontronik_can_gw.errors import RunError, UserError, did_you_mean
from kontronik_can_gw.light_imports import without_asammdf
from kontronik_can_gw.runtime.can.open_can import open_can

_TEXTS = Path(__file__).with_name("items.toml")
_GROUPS = {
    "NMT and heartbeat": nmt_items,
    "SDO": sdo_items,
    "Object dictionary": od_items,
    "PDO and SYNC": pdo_items,
    "Emergencies": emergency_items,
    "Stored parameters": storage_items,
    "EDS": eds_items,
    "LSS": lss_items,
}
"""The module with the procedures of each group of items."""


class Item(NamedTuple):
    """One item of the test."""

    group: str
    name: str
    """Name in reports and in the file of deviations, for example "sdo-toggle-bit"."""
    run: Callable[[Slave], str]
    clause: str
    stimulus: str
    expected: str
    needs: str = ""
    """Item that shows that the slave has the service whose silence this item requires, or ""."""
    objects: Sequence[str] = ()
    """Objects that the EDS must have, for example "1017h" or "1016h:2"."""


def all_items() -> list[Item]:
    """Return all items in the order of the test."""
    found = []
    for group, items in tomllib.loads(_TEXTS.read_text(encoding="ascii")).items():
        for name, texts in items.items():
            procedure = getattr(_GROUPS[group], name.replace("-", "_"))
            found.append(Item(group, name, procedure, **texts))
    return found


class ItemVerdict(Enum):
    """The result of an item."""

    PASSED = "passed"
    FAILED = "failed"
    DEVIATES = "deviates"
    """It failed, and the file of deviations gives a reason."""
    SKIPPED = "not supported"
    """The slave does not have the optional service."""


class Result(NamedTuple):
    """One item, the observed answer and its verdict."""

    item: Item
    answer: str
    verdict: ItemVerdict
    reason: str
    """Reason of a deviation, or ""."""
    seconds: float


GATEWAY_DEVIATIONS = Path(__file__).with_name("gateway_deviations.toml")
"""Deliberate deviations of the gateway's nodes."""


def read_deviations(path: str | Path | None) -> dict[str, str]:
    """Return the reasons of deliberate deviations by the name of the item.

    The file is TOML with lines such as ``od-vendor-id-is-assigned = "only CiA assigns one"``.
    Raises UserError if it is unreadable or names no item.
    """
    if path is None:
        return {}
    try:
        found = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: is not valid TOML: {error}.") from None
    names = [item.name for item in all_items()]
    for name, reason in found.items():
        if name not in names:
            raise UserError(f"{path}: there is no item {name!r}.{did_you_mean(name, names)}")
        if not isinstance(reason, str) or not reason.strip():
            raise UserError(f"{path}: {name}: give the reason of the deviation as a text.")
    return found


def chosen_items(words: Sequence[str]) -> list[Item]:
    """Return the items whose names contain one of the words. No words: all items."""
    chosen = [item for item in all_items() if not words or any(word in item.name for word in words)]
    if not chosen:
        names = ", ".join(item.name for item in all_items())
        raise UserError(f"--only {' '.join(words)}: no item has this name. There are: {names}")
    return chosen


def run(slave: Slave, items: Sequence[Item], deviations: Mapping[str, str]) -> Iterator[Result]:
    """Run the items one after the other. Before each one the slave is reset.

    An item that requires silence is not supported instead of passed if the item that it needs did
    not pass, because a slave without the service is silent, too.
    """
    named = {item.name: item for item in all_items()}
    done: dict[str, Result] = {}

    def result_of(item: Item) -> Result:
        if item.name in done:
            return done[item.name]
        result = _run_item(slave, item, deviations.get(item.name, ""))
        is_doubtful = bool(item.needs) and result.verdict is ItemVerdict.PASSED
        if is_doubtful and result_of(named[item.needs]).verdict is not ItemVerdict.PASSED:
            answer = f"{result.answer}, but {item.needs} did not pass either"
            result = result._replace(answer=answer, verdict=ItemVerdict.SKIPPED)
        done[item.name] = result
        return result

    for item in items:
        yield result_of(item)


def _run_item(slave: Slave, item: Item, reason: str) -> Result:
    """Run one item. ``reason`` explains a deliberate deviation."""
    begun_s = slave.clock()
    verdict = ItemVerdict.PASSED
    try:
        if item.group != "EDS":
            slave.restart(RESET_NODE)
        for place in item.objects:
            index, _, sub = place.partition("h")
            if not slave.has(int(index, 16), int(sub[1:] or 0)):
                raise Skipped(f"the EDS does not have {place}")
        if item.group == "LSS":
            lss_items.require_lss(slave)
        answer = item.run(slave)
    except Skipped as skipped:
        answer = str(skipped)
        verdict = ItemVerdict.SKIPPED
    except (Wrong, AbortedTransfer, UnexpectedAnswer) as error:
        answer = str(error)
        verdict = ItemVerdict.FAILED
    except NoAnswer:
        answer = f"no answer within {slave.limit_s:g} s"
        verdict = ItemVerdict.FAILED
    if verdict is ItemVerdict.FAILED and reason:
        verdict = ItemVerdict.DEVIATES
    else:
        reason = ""
    return Result(
        item,
        answer,
        verdict,
        reason,
        slave.clock() - begun_s,
    )


@contextmanager
def slave_on_bus(
    interface: str, channel: str, node_id: int, eds: EdsFile, limit_s: float
) -> Iterator[Slave]:
    """Open the bus. Raises RunError if it cannot be opened or the slave does not answer."""
    open_can(CanConfig(interface=interface, channel=channel)).close()  # raises with a remedy
    with without_asammdf():
        import can
    try:
        bus = can.Bus(interface=interface, channel=channel)
    except Exception as error:  # the drivers raise exceptions of any kind
        raise RunError(f"CAN {channel}: cannot be opened: {error}.") from None
    with bus:
        slave = Slave(
            bus,
            node_id,
            eds,
            limit_s,
        )
        try:
            slave.read(0x1000)
        except NoAnswer:
            raise RunError(
                f"node {node_id} on {channel}: does not answer. Is it on this bus, and is "
                "the bit rate right?"
            ) from None
        yield slave


def counts(results: Sequence[Result]) -> str:
    """Return the number of items of each verdict in one line."""
    number = Counter(result.verdict for result in results)
    parts = [f"{number[verdict]} {verdict.value}" for verdict in ItemVerdict]
    return f"{len(results)} items: {', '.join(parts)}"


def markdown_tables(results: Sequence[Result]) -> Iterator[str]:
    """Yield the lines of a table for each group of items."""
    for title in _GROUPS:
        rows = [result for result in results if result.item.group == title]
        if not rows:
            continue
        yield f"## {title}"
        yield ""
        yield "| item | clause | stimulus | expected | answer | verdict |"
        yield "|---|---|---|---|---|---|"
        for result in rows:
            item = result.item
            verdict = result.verdict.value
            if result.reason:
                verdict += f": {result.reason}"
            cells = (f"`{item.name}`", item.clause, item.stimulus, item.expected, result.answer)
            escaped = [cell.replace("|", "\\|") for cell in (*cells, verdict)]
            yield f"| {' | '.join(escaped)} |"
        yield ""


def junit(results: Sequence[Result], name: str) -> bytes:
    """Return the results as a JUnit file. Deviations and unsupported services are skipped tests."""
    number = Counter(result.verdict for result in results)
    suite = ET.Element(
        "testsuite",
        name=name,
        tests=str(len(results)),
        failures=str(number[ItemVerdict.FAILED]),
        skipped=str(number[ItemVerdict.DEVIATES] + number[ItemVerdict.SKIPPED]),
        errors="0",
        time=f"{sum(result.seconds for result in results):.3f}",
    )
    for result in results:
        case = ET.SubElement(
            suite,
            "testcase",
            classname=result.item.clause,
            name=result.item.name,
            time=f"{result.seconds:.3f}",
        )
        detail = f"{result.item.stimulus}: expected {result.item.expected}; {result.answer}"
        match result.verdict:
            case ItemVerdict.FAILED:
                ET.SubElement(case, "failure", message=detail)
            case ItemVerdict.DEVIATES:
                ET.SubElement(case, "skipped", message=f"{detail}; {result.reason}")
            case ItemVerdict.SKIPPED:
                ET.SubElement(case, "skipped", message=result.answer)
            case ItemVerdict.PASSED:
                ET.SubElement(case, "system-out").text = detail
    ET.indent(suite)
    return bytes(ET.tostring(suite, encoding="utf-8", xml_declaration=True)) + b"\n"
