"""A database that is made of rows: the text that the common writer makes of it, and what cantools reads in that."""

from fractions import Fraction

from packer_oracle import read

from kontronik_can_gw.dbc.rows import Message, Node, Rows, Signal
from kontronik_can_gw.dbc.writer import dbc_text

TEXT = """VERSION ""

NS_ :

BS_:

BU_: Gw Logger

BO_ 385 Power: 8 Gw
 SG_ Volts : 0|16@1- (0.1,0) [-5|3276.6] "V" Logger
 SG_ Level : 16|8@1+ (2,0) [0|6] "" Logger
 SG_ Heat : 32|32@1- (1,0) [0|0] "" Vector__XXX

CM_ "About.";
CM_ BU_ Gw "Sends.";
CM_ BU_ Logger "Hears.";
CM_ BO_ 385 "A message.";
CM_ SG_ 385 Volts "A voltage.";
CM_ SG_ 385 Level "A level.";
CM_ SG_ 385 Heat "A float.";

BA_DEF_ "LayoutVersion" STRING ;
BA_DEF_ "BusType" STRING ;
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ BO_ "GenMsgSendType" ENUM "Cyclic","Event","OnChange","CyclicAndEvent","CyclicAndOnChange","None";
BA_DEF_ BO_ "GenMsgDelayTime" INT 0 65535;
BA_DEF_ SG_ "GenSigStartValue" FLOAT -2147483648 4294967295;

BA_DEF_DEF_ "LayoutVersion" "";
BA_DEF_DEF_ "BusType" "CAN";
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_DEF_DEF_ "GenMsgSendType" "None";
BA_DEF_DEF_ "GenMsgDelayTime" 0;
BA_DEF_DEF_ "GenSigStartValue" 0;

BA_ "LayoutVersion" "1.2.3";
BA_ "BusType" "CAN";
BA_ "GenMsgCycleTime" BO_ 385 100;
BA_ "GenMsgSendType" BO_ 385 3;
BA_ "GenMsgDelayTime" BO_ 385 5;
BA_ "GenSigStartValue" SG_ 385 Volts -32768;
BA_ "GenSigStartValue" SG_ 385 Level 0;
BA_ "GenSigStartValue" SG_ 385 Heat 0;

VAL_ 385 Volts -32768 "NotAvailable" ;

SIG_VALTYPE_ 385 Heat : 1;
"""


def test_every_row_is_in_the_text_and_cantools_reads_it() -> None:
    volts = Signal(
        "Volts",
        0,
        16,
        "A voltage.",
        is_signed=True,
        factor=Fraction(1, 10),
        unit="V",
        low=-50,
        high=32766,
        start_value=-32768,
        choices={-32768: "NotAvailable"},
        receivers=("Logger",),
    )
    level = Signal("Level", 16, 8, "A level.", factor=Fraction(2), high=3, receivers=("Logger",))
    heat = Signal("Heat", 32, 32, "A float.", is_signed=True, is_float=True)
    signals = [level, volts, heat]
    power = Message(385, "Power", 8, "A message.", ("Gw",), "CyclicAndEvent", 100, 5, signals)
    nodes = [Node("Gw", "Sends."), Node("Logger", "Hears.")]
    text = dbc_text(Rows(nodes, "About.", "1.2.3", [power]))
    assert text == TEXT
    message = read(text).get_message_by_name("Power")
    assert (message.send_type, message.cycle_time) == ("CyclicAndEvent", 100)
    decoded = message.decode(bytes.fromhex("f6ff 02 00 0000c03f"), decode_choices=False)
    assert decoded == {"Volts": -1.0, "Level": 4, "Heat": 1.5}
    assert dbc_text(read(text)) == text
