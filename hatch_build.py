"""Compiles the core in C during the installation.

Without a C compiler, or if compiling fails, the core in Python runs.
"""

import contextlib
import os
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from packaging.tags import sys_tags

FOR_ALL = "KONTRONIK_WHEEL_FOR_ALL"
"""Environment variable of `make wheels`, which builds one wheel with an object for each machine."""


class CoreBuild(BuildHookInterface[Any]):
    """Add shared objects beside their sources.

    The tag of a wheel with an object names the machine.
    """

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
    """Return the platform in the tag of a wheel for this machine, for example linux_aarch64.

    It is not a manylinux tag, which would promise to run with older libraries.
    """
    return min((tag.platform for tag in sys_tags()), key=lambda name: not name.startswith("linux_"))
