"""An output that follows the recipe of docs/recipes.md, and the calls of a NodeOutput.

The output is in outputs/voltages. test_every_output.py tests it like the outputs of the package.
"""

from pathlib import Path

import example_output
import pytest
from example_output import FIRST_ID

from kontronik_can_gw.assembly.assemble import assemble
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.core.output import NO_IDS, NodeOutput, NodeState, Output
from kontronik_can_gw.core.output_setup import ReadyOutput
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.kontronik import codec
from kontronik_can_gw.esc.kontronik.codec import encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.frames import EXTENDED, CanFrame
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.runtime.system.locks import names_of
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.status import NmtState
from kontronik_can_gw.times import SECOND

pytestmark = pytest.mark.promise("outputs")

COMMAND_ID = 0x12
ESCS = [EscSettings("left"), EscSettings("right")]


@pytest.fixture
def gateway(monkeypatch: pytest.MonkeyPatch) -> Gateway:
    """Return a gateway with two ESCs that has the output of outputs/voltages alone."""
    example_output.add_to_package(monkeypatch)
    tables = {
        "can": {"interface": "virtual"},
        "dbc": {"enabled": False},
        "voltages": {"enabled": True},
        "esc": [{"port": esc.name, "name": esc.name} for esc in ESCS],
    }
    loaded = assemble(parse(tables, "test"))
    return Gateway(loaded.core_settings, 0, outputs=loaded.outputs)


def test_other_receive_ids_increase_the_revision_even_if_they_are_equal() -> None:
    """Equal ids may stand for other own ids. A set freed before them may have had their address."""
    output = Output()
    for number in range(100):
        before = output.revision
        output.receive_ids = NO_IDS
        output.receive_ids = frozenset((number // 2,))
        assert output.revision == before + 2


class Memory(NodeOutput):
    """An output whose one node stores a number that a frame brings, and rejects odd ones."""

    node_title = "memory node"

    def __init__(self) -> None:
        super().__init__()
        self.receive_ids = frozenset({COMMAND_ID})
        self.answers: list[tuple[int, str | None]] = []
        self.rejected: list[tuple[int, int]] = []

    def receive(self, frame: CanFrame, now: int, at: int) -> None:
        if frame.data[0] % 2:
            self.rejected.append((0, frame.data[0]))
            self.revision += 1
        else:
            self.save(0, frame.data)

    def saved(self, esc: int, error: str | None, now: int) -> None:
        self.answers.append((esc, error))

    def node_states(self) -> list[NodeState]:
        return [NodeState(5, NmtState.OPERATIONAL, 7)]

    def take_rejected_parameters(self) -> list[tuple[int, int]]:
        rejected, self.rejected = self.rejected, []
        return rejected


def test_node_output_stores_parameters_and_plain_output_is_not_asked() -> None:
    memory, plain = Memory(), Output()
    makers = [ReadyOutput(plain), ReadyOutput(memory)]
    gateway = Gateway(CoreSettings(ESCS, MessageLayout("", "", ())), 0, outputs=makers)
    assert gateway.node_outputs == [memory]
    for number in (2, 3, 4):
        before = gateway.revision
        gateway.receive_frame(CanFrame(COMMAND_ID, bytes((number,))), 0, 0)
        assert gateway.revision > before
    assert gateway.take_saves() == [(0, b"\x02"), (0, b"\x04")]
    assert gateway.take_saves() == []
    gateway.saved(0, None, 0)
    gateway.saved(0, "disk full", 0)
    gateway.saved(0, "one too many", 0)
    assert memory.answers == [(0, None), (0, "disk full")]
    assert gateway.take_rejected_parameters() == [(0, 3)]
    assert gateway.node_states() == [(5, NmtState.OPERATIONAL, 7)]
    assert names_of(gateway, "can0") == ["can0: memory node 5"]


def test_further_output_sends_values_and_receives_commands(gateway: Gateway) -> None:
    gateway.start(0)
    found = []
    for now in range(0, 4 * SECOND, SECOND // 10):
        while gateway.next_deadline() < now:
            gateway.advance(gateway.next_deadline())
        if now < 2 * SECOND:
            wire = encode(LiveData(battery_voltage=2400), codec.WireLayout.V4)
            gateway.receive_bytes(1, wire, now, now)
        gateway.advance(now)
        for frame in gateway.take_frames(now):
            found.append((now, frame.can_id - FIRST_ID, frame.data.hex()))
        if now == 2 * SECOND:
            gateway.receive_frame(CanFrame(COMMAND_ID, b"\x09"), now, now)
    sent_for_left = [each for each in found if each[1] == 0]
    sent_for_right = [each for each in found if each[1] == 1]
    assert sent_for_right == [
        (SECOND, 1, "6009"),
        (2 * SECOND, 1, "6009"),
        (2 * SECOND + 2 * SECOND // 10, 1, "ffff"),  # lost 250 ms after the last frame
        (3 * SECOND, 1, "ffff"),
    ]
    assert sent_for_left == [(second * SECOND, 0, "ffff") for second in (1, 2, 3)]


def test_another_device_with_ids_of_a_further_output_is_noticed(gateway: Gateway) -> None:
    assert gateway.receive_ids == {COMMAND_ID, FIRST_ID | EXTENDED, FIRST_ID + 1 | EXTENDED}
    gateway.receive_frame(CanFrame(FIRST_ID + 1, b"\0\0", extended=True), SECOND, SECOND)
    (conflict,) = gateway.conflicts.take()
    assert conflict.whose == "voltage"
    assert conflict.node == 1


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (0x182, "Volts: id 182h is used by TPDO 1 of CANopen node 2"),
        (0x80, "SYNC"),
        (0x581, "SDO responses of CANopen node 1"),
    ],
)
def test_dbc_message_with_a_cob_id_of_a_node_is_refused(
    tmp_path: Path,
    number: int,
    said: str,
) -> None:
    text = f'VERSION ""\nNS_ :\nBS_:\nBU_: Gw Logger\nBO_ {number} Volts: 8 Gw\n'
    text += ' SG_ esc2BatteryVoltage : 0|16@1+ (0.01,0) [0|0] "V" Logger\n'
    (tmp_path / "my.dbc").write_text(text)
    tables = {
        "esc": [{"port": "a"}, {"port": "b"}],
        "canopen": {"enabled": True, "store": str(tmp_path)},
        "dbc": {"file": str(tmp_path / "my.dbc")},
    }
    with pytest.raises(UserError, match=said):
        assemble(parse(tables, "test"))
