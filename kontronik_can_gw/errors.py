"""Errors that a user can correct, each with its exit code. The command line prints them as plain lines, never as a traceback."""

from kontronik_can_gw.printable import printable


class UserError(Exception):
    """Wrong usage, configuration or layout (exit code 2). Holds one line per mistake: where, what, remedy."""

    exit_code = 2

    def __init__(self, *problems: str) -> None:
        self.problems = tuple(printable(problem) for problem in problems)  # they quote files
        super().__init__("\n".join(self.problems))


class RunError(UserError):
    """A port, interface or file failed when it was opened or used (exit code 1)."""

    exit_code = 1
