"""Builds the core in C at the installation where there is a C compiler; without one, or when it fails, the core in Python runs."""

import sys
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CoreBuild(BuildHookInterface[Any]):
    """Puts the shared object for this machine beside its source."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:  # noqa: ARG002
        sys.path.insert(0, self.root)
        from kontronik_can_gw.native.compile import compile_core, shared_object

        target = shared_object()
        if (why := compile_core(target)) is not None:
            self.app.display_warning(f"the core in Python will run: {why}")
        else:
            build_data["artifacts"].append(str(target.relative_to(self.root)))
