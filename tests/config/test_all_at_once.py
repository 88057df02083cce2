"""Every mistake of configuration, EDS and DBC in one go, whichever of them is found first."""

from collections.abc import Sequence
from pathlib import Path

import pytest

from kontronik_can_gw.cli.common import load_all
from kontronik_can_gw.errors import UserError

DBC = 'VERSION ""\nNS_ :\nBS_:\nBU_: Gateway\nBO_ 256 M: 8 Gateway\n SG_ BattVolt : 0|16@1+ (1,0) [0|0] "V" Gateway\n'
BAD_DBC = "M.BattVolt: no such source"


@pytest.mark.parametrize(
    ("toml", "expected"),
    [
        (
            '[[esc]]\nport = "a"\nname = "x"\n[[esc]]\nport = "b"\nname = "X"\n',
            ["esc[2].name: 'X' is also", BAD_DBC],
        ),
        ('[[esc]]\nport = "a"\n[[esc]]\nport = "a"\n', ["esc[2].port: 'a' is also", BAD_DBC]),
        (
            '[canopen]\nenabled = true\neds = "none.eds"\n[[esc]]\nport = "a"\n',
            ["none.eds: cannot be read", BAD_DBC],
        ),
        (
            '[canopen]\nenabled = true\nnode_id = 127\neds = "none.eds"\n[[esc]]\nport = "a"\n[[esc]]\nport = "a"\n',
            [
                "esc[2].port",
                "esc[2]: its node-ID would be 128",
                "none.eds: cannot be read",
                BAD_DBC,
            ],
        ),
        (
            '[canopen]\nenabled = true\n[[esc]]\nport = "a"\nnode_id = 5\n[[esc]]\nport = "b"\nnode_id = 5\n',
            ["esc[2].node_id: 5 is also", BAD_DBC],
        ),
        (
            '[can]\ninterface = "socketcn"\n[[esc]]\nport = "a"\n',
            ["'socketcn' is no interface", BAD_DBC],
        ),
        ('[statistics]\nfile = "my.dbc"\n[[esc]]\nport = "a"\n', ["statistics.file", BAD_DBC]),
        (
            '[can]\nchannel = "/dev/null"\n[[esc]]\nport = "/dev/null"\n',
            ["is the port of esc1", BAD_DBC],
        ),
    ],
)
def test_mistakes_of_every_file_come_together(
    tmp_path: Path, toml: str, expected: Sequence[str]
) -> None:
    (tmp_path / "my.dbc").write_text(DBC)
    (tmp_path / "a.toml").write_text(f'[dbc]\nfile = "my.dbc"\n{toml}')
    with pytest.raises(UserError) as caught:
        load_all(tmp_path / "a.toml")
    assert caught.value.exit_code == 2
    assert [words in line for words, line in zip(expected, caught.value.problems, strict=True)] == [
        True
    ] * len(expected)


def test_mistakes_in_a_table_are_reported_alone_for_the_rest_depends_on_it(tmp_path: Path) -> None:
    (tmp_path / "my.dbc").write_text(DBC)
    (tmp_path / "a.toml").write_text(
        '[dbc]\nfile = "my.dbc"\nnoode = 1\n[[esc]]\nport = "a"\n[[esc]]\nport = "a"\n'
    )
    with pytest.raises(UserError) as caught:
        load_all(tmp_path / "a.toml")
    assert len(caught.value.problems) == 2 and "noode" in caught.value.problems[0]
