"""How an item of the conformance test ends.

The procedure of an item stimulates the slave and returns the observed answer as text. It raises
Wrong for an answer that the standard does not allow, and Skipped if the slave does not have the
service. The texts of the items are in items.toml.
"""

from collections.abc import Callable

from kontronik_can_gw.desk.conformance.slave import AbortedTransfer


class Wrong(Exception):
    """The slave did not answer as the standard requires. The text is the observed answer."""


class Skipped(Exception):
    """The item does not apply to this slave. The text is the reason."""


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
