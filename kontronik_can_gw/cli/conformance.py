"""``conformance``: tests a CANopen slave on a bus against CiA 301, CiA 305 and CiA 306."""

import argparse
from pathlib import Path

from kontronik_can_gw.cli.arguments import FORCE, number_from, option
from kontronik_can_gw.cli.common import say
from kontronik_can_gw.cli.output import check_output, write_output
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.conformance.eds_file import read_eds
from kontronik_can_gw.desk.conformance.run import (
    GATEWAY_DEVIATIONS,
    Item,
    ItemVerdict,
    Result,
    all_items,
    chosen_items,
    counts,
    junit,
    markdown_tables,
    read_deviations,
    run,
    slave_on_bus,
)
from kontronik_can_gw.desk.conformance.slave import Slave
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.printable import printable

_LIMIT_S = 2.0
OPTIONS = (
    option("--node N", "node-ID of the slave, 1 to 127 (default 1)", type=int, default=1),
    option("--eds FILE", "EDS of the slave (default: the shipped EDS)"),
    option("--interface NAME", "python-can interface (default socketcan)", default="socketcan"),
    option("--channel NAME", "channel of the interface (default vcan0)", default="vcan0"),
    option("--only WORD", "only items with this word in their names", action="append", default=[]),
    option(
        "--deviations FILE",
        "TOML file with the reasons of deliberate deviations "
        "(default without --eds: those of the gateway's nodes)",
    ),
    option("-o --output FILE", "write the results as Markdown tables"),
    option("--junit FILE", "write the results as JUnit XML"),
    FORCE,
    option(
        "--limit S",
        f"longest time to wait for an answer, in seconds (default {_LIMIT_S:g})",
        type=number_from(0.05, 60, "number of seconds"),
        default=_LIMIT_S,
    ),
    option("--list", "print the items and end"),
)
EPILOG = """\
The command is a master that knows only the EDS. For each item of the standards
it sends frames to the slave, and judges the answer: NMT, boot-up, heartbeat,
SDO, object dictionary, PDO, SYNC, emergencies, stored parameters, EDS and LSS.

It resets the slave many times, changes its node-ID and stores parameters. Use
it on a bench, with one slave on the bus, never in a running vehicle.

The verdict of an item is passed, failed, deviates (it failed, and --deviations
gives a reason), or not supported (an optional service that the slave lacks, or
an item that requires silence of a service that did not work).
The file of deviations has a line for each item:

  od-vendor-id-is-assigned = "prototype without a vendor-ID"

examples:
  kontronik-can-gw conformance
  kontronik-can-gw conformance --node 5 --eds x.eds --channel can0 -o report.md
  kontronik-can-gw conformance --only sdo --only lss --junit results.xml

exit codes: 0 no item failed; 1 an item failed, the slave does not answer, or
the bus cannot be opened; 2 wrong usage, or a file cannot be read; 130 stopped
by a signal
"""


def main(args: argparse.Namespace) -> int:
    if args.list:
        for item in all_items():
            print(f"{item.name:45}  {item.clause}: {item.stimulus}")
        return 0
    if not 1 <= args.node <= 127:
        raise UserError(f"--node {args.node}: a node-ID is a number from 1 to 127")
    items = chosen_items(args.only)
    reasons = args.deviations or (None if args.eds else GATEWAY_DEVIATIONS)
    deviations = read_deviations(reasons)
    path = Path(args.eds) if args.eds else Path(str(shipped("eds/kontronik_esc.eds")))
    for output in filter(None, (args.output, args.junit)):
        check_output(output, [path], force=args.force)
    eds = read_eds(path, args.node)
    with slave_on_bus(args.interface, args.channel, args.node, eds, args.limit) as slave:
        results = _results(slave, items, deviations)
    if args.output is not None:
        write_output(args.output, _report(args, path, results), force=args.force)
    if args.junit is not None:
        xml = junit(results, f"CANopen conformance of {path.name}")
        write_output(args.junit, xml.decode("utf-8"), force=args.force)
    say(counts(results), args.command)
    return int(any(result.verdict is ItemVerdict.FAILED for result in results))


def _results(slave: Slave, items: list[Item], deviations: dict[str, str]) -> list[Result]:
    """Run the items and print each result as soon as it is known."""
    results = []
    for result in run(slave, items, deviations):
        results.append(result)
        line = f"{result.verdict.value:13}  {result.item.name}: {result.answer}"
        if result.reason:
            line += f" ({result.reason})"
        print(printable(line), flush=True)
    return results


def _report(args: argparse.Namespace, eds: Path, results: list[Result]) -> str:
    where = f"{eds.name}, node {args.node}, on {args.interface} {args.channel}"
    lines = [
        "# CANopen conformance",
        "",
        f"Slave: {where}.",
        "",
        f"{counts(results)}.",
        "",
        "`kontronik-can-gw conformance` made this report.",
        "",
        "* passed: the answer is the expected one.",
        "* failed: it is not, or there is none.",
        "* deviates: failed, for a reason that is stated.",
        "* not supported: the slave lacks an optional service that the item needs, or the item",
        "  requires silence of a service that did not work.",
        "",
        *markdown_tables(results),
    ]
    return "\n".join(lines)
