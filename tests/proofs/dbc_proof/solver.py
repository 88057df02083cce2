"""Tells whether z3 can be used. The modules that compute with it are imported afterwards."""

import io
from contextlib import redirect_stdout

from kontronik_can_gw.desk.libraries import missing_library, unusable_library

_PURPOSE = "check --prove"
_EXTRA = "prove"


def require_z3() -> None:
    """Raise RunError with the remedy if z3 is missing, broken, or another library of this name."""
    try:
        with redirect_stdout(io.StringIO()):  # z3 prints advice if it does not find its library
            import z3  # type: ignore[import-untyped]
    except ModuleNotFoundError as error:
        if error.name == "z3":
            raise missing_library(_PURPOSE, _EXTRA) from None
        raise unusable_library(_PURPOSE, _EXTRA, f"z3 is broken: {_text(error)}") from None
    except Exception as error:  # z3 loads a library in C++, which fails with errors of many types
        raise unusable_library(_PURPOSE, _EXTRA, f"z3 is broken: {_text(error)}") from None
    if not hasattr(z3, "Solver"):
        place = getattr(z3, "__file__", None) or "without files"
        reason = f"the installed z3 is another library ({place})"
        raise unusable_library(_PURPOSE, _EXTRA, reason, remove="z3")


def _text(error: Exception) -> str:
    """Return the text of an error in one line."""
    return " ".join(str(error).split()).rstrip(".") or type(error).__name__
