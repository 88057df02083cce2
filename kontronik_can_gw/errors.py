"""Errors that a user can correct, each with its exit code.

The command line prints them as plain lines, never as a traceback.
"""

import re
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
    cutoff: float = 0.65,
    *,
    show: Callable[[str], str] = str,
    count: int = 1,
    or_known: bool = False,
) -> str:
    """Return a sentence with the known names nearest to a mistyped one, after a blank.

    Names that contain all of its words come first, then names with words that begin so, then names
    of similar letters. If no name is near, the result is empty, or with ``or_known`` a sentence
    with all names. ``cutoff`` is the least similarity of letters, from 0 to 1.
    """
    names = list(dict.fromkeys(known))
    near = _with_words(name, names)[: max(count, 3)] or _with_letters(name, names, cutoff)[:count]
    if near:
        return f" Did you mean {' or '.join(map(show, near))}?"
    return f" Known: {', '.join(map(show, names))}." if or_known else ""


_WORD = r"[^\W\d_]+"
_BORDER_IN_CAMEL_CASE = r"(?<=[a-z])(?=[A-Z])"
_SHORTEST_START = 3
"""Letters that the beginning of a word needs, to stand for the word."""


def _words(name: str) -> list[str]:
    return re.findall(_WORD, re.sub(_BORDER_IN_CAMEL_CASE, "_", name).casefold())


def _with_words(name: str, known: Iterable[str]) -> list[str]:
    """Return the known names with all words of a name, or with words that begin so.

    Only the names with the fewest further words are returned.
    """
    wanted = _words(name)
    if not wanted or min(map(len, wanted)) < _SHORTEST_START:
        return []
    whole: dict[str, int] = {}
    begun: dict[str, int] = {}
    for each in known:
        words = _words(each)
        if set(wanted) <= set(words):
            whole[each] = len(words)
        elif all(any(word.startswith(start) for word in words) for start in wanted):
            begun[each] = len(words)
    found = whole or begun
    return [each for each, count in found.items() if count == min(found.values())]


def _with_letters(name: str, known: Iterable[str], cutoff: float) -> list[str]:
    """Return the known names whose letters are similar, the nearest first."""
    from difflib import get_close_matches  # only needed after a mistake

    plain: dict[str, str] = {}
    for each in known:
        plain.setdefault(_plain(each), each)
    near = get_close_matches(_plain(name), plain, n=3, cutoff=cutoff)
    return [plain[each] for each in near]


def _plain(name: str) -> str:
    """Return the letters and digits of a name in lower case, or the name if it has none."""
    return "".join(character for character in name.casefold() if character.isalnum()) or name
