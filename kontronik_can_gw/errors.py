"""Mistakes of people, each with its exit code. The command line prints them as plain lines, never as a traceback."""


class UserError(Exception):
    """Wrong usage, configuration or layout (exit code 2). Holds one line per mistake: what, where, remedy."""

    exit_code = 2

    def __init__(self, *problems: str) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


class RunError(UserError):
    """Something outside failed while running or opening: a port, an interface, a file (exit code 1)."""

    exit_code = 1
