"""Builds the core in C at the installation where there is a C compiler; without one, or when it fails, the core in Python runs."""

import contextlib
import os
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from packaging.tags import sys_tags

FOR_ALL = "KONTRONIK_WHEEL_FOR_ALL"
"""Environment variable of `make wheels`: one wheel with an object for each machine that there is a cross compiler for."""


class CoreBuild(BuildHookInterface[Any]):
    """Puts shared objects beside their sources. A wheel with the one of this machine says so in its tag."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:  # noqa: ARG002
        sys.path.insert(0, self.root)
        from kontronik_can_gw.native import compile as compiling
        from kontronik_can_gw.native.objects import NOT_BUILT, shared_object

        made = []
        with contextlib.suppress(OSError):
            NOT_BUILT.unlink()
        if FOR_ALL in os.environ:
            for machine, program in compiling.CROSS_COMPILERS.items():
                made.append(shared_object(machine))
                why = compiling.compile_core(made[-1], compiling.OF_NO_LIBRARY, program)
                if why is not None:
                    raise RuntimeError(why)
        elif (why := compiling.compile_core(shared_object())) is None:
            made.append(shared_object())
            build_data["tag"] = f"py3-none-{platform()}"
        else:
            self.app.display_warning(f"the core in Python will run: {why}")
            with contextlib.suppress(OSError):
                NOT_BUILT.write_text(why, encoding="utf-8")
                made.append(NOT_BUILT)
        build_data["artifacts"] += [str(Path(each).relative_to(self.root)) for each in made]


def platform() -> str:
    """Of a wheel for this machine, as linux_aarch64: it does not claim to run with older libraries, as a manylinux one does."""
    return min((tag.platform for tag in sys_tags()), key=lambda name: not name.startswith("linux_"))
