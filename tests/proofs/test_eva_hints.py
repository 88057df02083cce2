"""The annotations for Frama-C's Eva fit the present core. Eva itself runs in `make release`."""

from pathlib import Path

import pytest
from every_value import export_shipped
from long_eva import add_hints

pytestmark = pytest.mark.promise("no-undefined-behaviour")


def test_each_annotation_for_eva_has_its_place_in_the_core(tmp_path: Path) -> None:
    export_shipped(tmp_path)
    core = tmp_path / "core.c"
    before = core.read_text(encoding="utf-8").count("//@")
    add_hints(core)  # raises AssertionError if a place is missing
    added = core.read_text(encoding="utf-8").count("//@") - before
    assert added > 0
