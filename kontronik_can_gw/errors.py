"""Errors that a user can correct, each with its exit code.

The command line prints them as plain lines, never as a traceback.
"""

from collections.abc import Callable, Iterable

from kontronik_can_gw.printable import printable


class UserError(Exception):
    """Wrong usage, configuration or layout (exit code 2).

    It has one line for each mistake: the place, the mistake and the remedy.
    """

    exit_code = 2

    def __init__(self, *problems: str) -> None:
        self.problems = tuple(printable(problem) for problem in problems)  # may quote a file
        super().__init__("\n".join(self.problems))


class RunError(UserError):
    """A port, interface or file failed when it was opened or used (exit code 1)."""

    exit_code = 1


def did_you_mean(
    name: str,
    known: Iterable[str],
    cutoff: float = 0.6,
    *,
    show: Callable[[str], str] = str,
    count: int = 1,
    or_known: bool = False,
) -> str:
    """Return a sentence with the known names nearest to a mistyped one, after a blank.

    If no name is near, the result is empty, or with ``or_known`` a sentence with all names.
    ``cutoff`` is the least similarity of a near name, from 0 to 1.
    """
    from difflib import get_close_matches  # only needed after a mistake

    names = list(known)
    if near := get_close_matches(name, names, n=count, cutoff=cutoff):
        return f" Did you mean {' or '.join(map(show, near))}?"
    return f" Known: {', '.join(map(show, names))}." if or_known else ""
