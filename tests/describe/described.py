"""What the tests of ``describe`` share: the program in this process, and inputs that try to break a document."""

from pathlib import Path

from command_line import run

from kontronik_can_gw.config.keys import shipped

DBC = shipped("dbc/kontronik_esc.dbc")
EDS = shipped("eds/kontronik_esc.eds")
NASTY = "<script>alert('x')</script> | `tick` *star* _under_ [a](b) \\ & &amp; www.evil.org"
NASTY_UNIT = "<b>|V&"
NASTY_NAME = "Flug | <img src=x> `Daten`"


def described(*words: object) -> str:
    """What ``describe`` prints; it must not have anything to say."""
    done = run("describe", *words)
    assert (done.code, done.err) == (0, ""), done.err
    return done.out


def nasty(folder: Path) -> Path:
    """A configuration with a DBC and an EDS whose texts hold markup of every kind; the DBC has a message of another node, too."""
    comment = NASTY.replace("\\", "/")
    (folder / "nasty.dbc").write_text(
        'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: Gate Other\n\n'
        "BO_ 291 Volt: 5 Gate\n"
        ' SG_ BatteryVoltage : 0|16@1+ (0.01,0) [0|100] "V" Other\n'
        ' SG_ OperatingState : 16|8@1+ (1,0) [0|255] "" Other\n'
        f' SG_ Mark : 24|8@1+ (1,0) [0|255] "{NASTY_UNIT}" Other\n\n'
        "BO_ 292 Foreign: 1 Other\n"
        ' SG_ Timing : 0|8@1+ (1,0) [0|255] "us" Gate\n\n'
        f'CM_ "{comment}";\nCM_ BO_ 291 "{comment}";\nCM_ SG_ 291 BatteryVoltage "{comment}\nsecond line";\n'
        'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;\nBA_DEF_DEF_ "GenMsgCycleTime" 0;\n'
        'BA_ "GenMsgCycleTime" BO_ 291 100;\nBA_ "GenMsgCycleTime" BO_ 292 100;\n'
        'VAL_ 291 OperatingState 12 "MotorOff" 13 "<i>|Stand</i>" 254 "Error" 255 "NotAvailable" ;\n',
        encoding="utf-8",
    )
    text = EDS.read_text().replace("ParameterName=Live data\n", f"ParameterName={NASTY_NAME}\n")
    (folder / "nasty.eds").write_text(
        text.replace("Line8=", "Line8=</table>|<script>"), encoding="utf-8"
    )
    return configuration(
        folder,
        '[dbc]\nfile = "nasty.dbc"\nnode = "Gate"\n[dbc.bind]\nMark = 5\n'
        '[canopen]\nenabled = true\neds = "nasty.eds"\nstore = "store"\n[[esc]]\nport = "/dev/ttyUSB0"\n',
    )


def configuration(folder: Path, text: str) -> Path:
    """A file with this configuration on the virtual interface."""
    file = folder / "gateway.toml"
    file.write_text(f'[can]\ninterface = "virtual"\n{text}')
    return file


TWO_ESCS = """
[canopen]
enabled = true
node_id = 20
store = "store"

[[esc]]
name = "left"
port = "/dev/ttyUSB0"
pole_pairs = 7

[[esc]]
name = "right"
port = "/dev/ttyUSB1"
"""
