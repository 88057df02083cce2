"""The items of a conformance test, and how one item ends.

An item is a function with the decorator ``item``. It stimulates the slave and returns the observed
answer as text. It raises Wrong for an answer that the standard does not allow, and Skipped if the
slave does not have the service.
"""

from collections.abc import Callable
from typing import NamedTuple

from kontronik_can_gw.desk.conformance.slave import AbortedTransfer, Slave

Procedure = Callable[[Slave], str]


class Wrong(Exception):
    """The slave did not answer as the standard requires. The text is the observed answer."""


class Skipped(Exception):
    """The item does not apply to this slave. The text is the reason."""


class Item(NamedTuple):
    """One item of the test."""

    name: str
    """Name in reports and in the file of deviations, for example "sdo-toggle-bit"."""
    clause: str
    stimulus: str
    expected: str
    run: Procedure
    needs: str
    """Item that shows that the slave has the service whose silence this item requires, or ""."""


ITEMS: list[Item] = []
"""All items. The modules of the items add to it when they are imported."""


def item(
    clause: str, stimulus: str, expected: str, *, needs: str = ""
) -> Callable[[Procedure], Procedure]:
    """Add a function to the items. Its name becomes the name of the item."""

    def add(procedure: Procedure) -> Procedure:
        name = procedure.__name__.replace("_", "-")
        ITEMS.append(Item(name, clause, stimulus, expected, procedure, needs))
        return procedure

    return add


def require(condition: bool, answer: str) -> None:
    """Raise Wrong with the answer unless the condition is true."""
    if not condition:
        raise Wrong(answer)


def require_abort(action: Callable[[], object], *codes: int) -> str:
    """Run an action that the slave must abort with one of the codes. No code: with any code."""
    try:
        action()
    except AbortedTransfer as abort:
        require(not codes or abort.code in codes, f"abort {abort.code:08X}h")
        return f"abort {abort.code:08X}h"
    raise Wrong("it was accepted")
