"""Secrets are removed from every text, and texts without secrets stay as they are."""

import base64
import json
import tomllib
from pathlib import Path

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from kontronik_can_gw.canopen import eds
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.dbc.reader import parse_database
from kontronik_can_gw.desk.bundle.files import clean_dbc, clean_eds, clean_toml
from kontronik_can_gw.desk.bundle.secrets import REMOVED, Cleaner, is_secret_name

pytestmark = pytest.mark.promise("support-bundle")

PROJECT = Path(__file__).resolve().parents[2]
KEY = "2b7e151628aed2a6abf7158809cf4f3c"
IN_BYTES = " ".join(f"{byte:02X}" for byte in bytes.fromhex(KEY))
PEM = "-----BEGIN EC PRIVATE KEY-----\nMHcCAQEEIDx\nz9aB\n-----END EC PRIVATE KEY-----"
JWT = "eyJhbGciOiJIUzI1NiJ9.eyJzdWIiOiIxMjM0In0.dozjgNryP4J3jVmNHl0w5N"
BASIC = base64.b64encode(b"anna:hunter2").decode()


def cleaned(text: str, **known: str) -> str:
    return Cleaner({value: name for name, value in known.items()}).text(text, "part")


@pytest.mark.parametrize(
    ("text", "secret"),
    [
        ("password = hunter2", "hunter2"),
        ('"password" : "hunter2",', "hunter2"),
        ("password: correct horse battery", "battery"),
        ("PASSWD=hunter2", "hunter2"),
        ("mqttPassword=hunter2", "hunter2"),
        ("broker_pw=>hunter2", "hunter2"),
        ("Passwort: hunter2", "hunter2"),
        ("Kennwort lautet Kennwort := hunter2", "hunter2"),
        ("Schlüssel: hunter2", "hunter2"),
        ("seedKey=0x1234", "1234"),
        ("api-key: hunter2", "hunter2"),
        ("username: t0ken-of-a-cloud", "t0ken"),
        ("login -> no, --password hunter2 --port 1", "hunter2"),
        ("GET /data?device=1&access_token=hunter2 HTTP/1.1", "hunter2"),
        ("HostName=a.example;SharedAccessKey=aHVudGVyMg==", "aHVudGVyMg"),
        ("mqtt://anna:hunter2@broker.example:1883", "hunter2"),
        ("mqtts://hunter2@broker.example", "hunter2"),
        ("mqtt://anna:hun@ter/2@broker.example", "ter/2"),
        ("mqtt.broker: 'mqtt://anna:hunter 2@broker.example' is not a broker", "hunter 2"),
        ("mqtt.broker: 'anna:hunter2@broker.example' is not a broker", "hunter2"),
        ("port = rfc2217://anna:hunter2@10.0.0.1:4000", "hunter2"),
        ("http://anna:hunter2@[fe80::1]:80/", "hunter2"),
        ("socket://:hunter2@10.0.0.1", "hunter2"),
        (PEM, "MHcCAQEEIDx"),
        (PEM.partition("-----END")[0], "z9aB"),
        (f"sent {JWT}", "eyJzdWI"),
        (f"Authorization: Basic {BASIC}", BASIC),
        (f"sent Bearer {BASIC}", BASIC),
        ("remote ghp_0123456789abcdefABCDEF refused", "ghp_01"),
        ("remote AKIAIOSFODNN7EXAMPLE refused", "IOSFODNN7"),
        (f"SecOC {KEY}", KEY),
        (f"SecOC {IN_BYTES}", "2B 7E"),
        (f"SecOC {IN_BYTES.replace(' ', ', 0x')}", "7E"),
        ("/etc/x/hunter2: the password cannot be read: No such file or directory", "hunter2"),
        ("Nov 28 pi gw[1]: /etc/x/hunter2: has no password on its first line", "hunter2"),
    ],
)  # fmt: skip
def test_secret_is_removed_from_a_line(text: str, secret: str) -> None:
    assert secret in text
    found = cleaned(f"before\n{text}\nafter\n")
    assert secret not in found
    assert REMOVED in found
    assert found.startswith("before\n")


@pytest.mark.parametrize(
    "text",
    [
        "left: /dev/serial/by-id/usb-FTDI_FT232R_USB_UART_A10K1ABC-if00-port0: lost. Trying again.",
        "2026-11-28T17:22:58+0000 pi kontronik-can-gw[635]: esc1: telemetry ok (V4), after 4.7 s",
        "MQTT broker broker.example:1883: refuses the connection: not authorized.",
        "gateway.toml: esc[1].nonsense: unknown key. Did you mean name?",
        "core: C, layout 7A680381",
        "http://127.0.0.1:9123/metrics serves /etc/kontronik-can-gw/gateway.toml",
        "kontronik-can-gw@left.service: Main process exited, code=exited, status=1/FAILURE",
        "can0: 680h 00 01 02 03 04 05 06 07",
        "bind.PowerStageTemperatureMaximum = esc1.power_stage_temperature",
        "keyboard: none, monkey: yes, tokyo: 3",
        "",
    ],
)
def test_line_without_a_secret_stays(text: str) -> None:
    assert cleaned(text) == text


@pytest.mark.parametrize(
    ("secret", "text"),
    [
        ("correct horse", "it is correct\n    horse here"),
        ("größe7", "it is gr\u00c3\u00b6\u00c3\u009fe7 in a capture"),
        ('a"b\\c', 'it is a\\"b\\\\c in JSON'),
        ("p@ss/word", "it is p%40ss%2Fword in a URL"),
        ("1234", "it is 1234."),
    ],
)
def test_known_secret_is_removed_in_every_spelling(secret: str, text: str) -> None:
    found = cleaned(text, password=secret)
    assert found.startswith(f"it is {REMOVED}")


def test_short_known_secret_is_removed_only_as_a_word() -> None:
    assert cleaned("the latest test of 12 ms", password="test") == f"the latest {REMOVED} of 12 ms"
    assert cleaned("12 ms", password="12") == "12 ms"


def test_document_keeps_its_names_and_loses_its_secrets() -> None:
    cleaner = Cleaner({"hunter2": "mqtt.username"})
    document = {
        "mqtt": {"username": "anna", "password": None, "tls": True, "port": 1883},
        "log": ["refused hunter2", "password: x"],
        "hunter2": 1,
    }
    assert cleaner.document(document, "status.json") == {
        "mqtt": {"username": REMOVED, "password": None, "tls": True, "port": 1883},
        "log": [f"refused {REMOVED}", f"password: {REMOVED}"],
        "hunter2": 1,
    }
    assert sum(cleaner.removed["status.json"].values()) == 3


# --- configurations

TOML = f"""# the password is hunter2
[can]  # hunter2
channel = "vcan#0"
options.ttyBaudrate = 115200
options.password = "hunter2"
options.access_code = "hunter2"
options.code = 1234567
options.rtscts = true
[mqtt]
broker = "broker.example"
'password' = 'hunter2'
keys = [
  "hunter2",  # and
  'hunter2',
]
"api key" = 1234567
[mqtt.auth]
value = "hunter2"
[[esc]]
port = "rfc2217://anna:hunter2@10.0.0.1"
table = {{ name = "x", token = "hunter2" }}
text = '''
hunter2
'''
gear = "31/4"
certificate = "{PEM.encode("unicode_escape").decode()}"
"""


def test_configuration_loses_secrets_and_comments_and_stays_valid() -> None:
    found = clean_toml(TOML, "gateway.toml", Cleaner())
    assert "hunter2" not in found
    assert "1234567" not in found
    assert "MHcCAQEEIDx" not in found
    assert found.count("\n") == TOML.count("\n")
    tables = tomllib.loads(found)
    assert tables["esc"][0]["table"] == tables["esc"][0]["text"] == REMOVED
    assert tables["can"]["options"]["access_code"] == REMOVED
    assert tables["can"]["options"]["rtscts"] is True
    assert tables["can"]["channel"] == "vcan#0"
    assert tables["can"]["options"]["ttyBaudrate"] == 115200
    assert tables["esc"][0]["gear"] == "31/4"
    assert tables["mqtt"]["broker"] == "broker.example"


@pytest.mark.parametrize(
    "text",
    [
        '[can]\noptions = { host = "a", access_code = "hunter2" }\n',
        'can = { channel = "x", options = { access_code = "hunter2" } }\n',
        '[can.options]\naccess_code = "hunter2"\n',
        "['can'.\"options\"]\n\"access_code\" = 'hunter2'\n",
        'can.options.access_code = "hunter2"\n',
        '[can]\naccess_code = "hunter2"\n',
        '[bus]\naccess_code = "hunter2"\n',
        'access_code = ["hunter2",\n"hunter2"]\n',
    ],
)
def test_option_whose_meaning_is_unknown_loses_its_value(text: str) -> None:
    tomllib.loads(text)
    found = clean_toml(text, "gateway.toml", Cleaner())
    assert "hunter2" not in found
    tomllib.loads(found)


@pytest.mark.parametrize(
    "broken",
    [
        '[mqtt]\npassword = "hunter2\nbroker = "x"\n',
        "[mqtt\npassword = hunter2\n",
        "password: hunter2\n",
        '[mqtt]\npassword = [\n"hunter2"\n',
        "[mqtt]\npassword =\n  hunter2\n",
        '[mqtt]\nx = """\npassword hunter2\n',
        "[mqtt] # hunter2",
    ],
)
def test_configuration_that_is_not_valid_loses_its_secrets_too(broken: str) -> None:
    assert "hunter2" not in clean_toml(broken, "gateway.toml", Cleaner())


@pytest.mark.parametrize("path", sorted(PROJECT.glob("examples/*/*.toml")), ids=str)
def test_examples_lose_only_their_comments(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    cleaner = Cleaner()
    assert tomllib.loads(clean_toml(text, "x", cleaner)) == tomllib.loads(text)
    assert set(cleaner.removed["x"]) == {"comment"}


@given(
    st.text(min_size=3, max_size=30),
    st.sampled_from(["password", "user.name.token", '"pass word"', "api_key"]),
    st.booleans(),
)
def test_no_value_of_a_secret_key_remains(secret: str, key: str, in_comment: bool) -> None:
    secret = "".join(c for c in secret if c.isprintable()).strip("'\"\\ ")
    assume(len(secret) >= 3)
    rest = 'broker = "broker.example"\n'
    assume(secret not in f'[mqtt]\n{key} = "{REMOVED}"\n{rest}#[can]\nfd = true\n')
    literal = json.dumps(secret, ensure_ascii=False)
    comment = f"# {secret}\n" if in_comment else ""
    text = f"[mqtt]\n{key} = {literal}\n{rest}{comment}[can]\nfd = true\n"
    found = clean_toml(text, "x", Cleaner())
    assert secret not in found
    assert tomllib.loads(found)["can"] == {"fd": True}
    assert tomllib.loads(found)["mqtt"]["broker"] == "broker.example"


# --- DBC and EDS

DBC = """VERSION ""
NS_ :
	CM_
	BA_DEF_
	BA_
BS_:
BU_: Gateway
BO_ 100 Key: 8 Gateway
 SG_ Password : 0|16@1+ (0.01,0) [0|0] "V" Vector__XXX
# password hunter2
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 1000;
BA_DEF_ "SeedKey" STRING ;
BA_DEF_ "Server" STRING ;
BA_DEF_DEF_ "SeedKey" "hunter2";
BA_ "SeedKey" "hunter2";
BA_ "Server" "https://anna:hunter2@dbc.example";
BA_ "GenMsgCycleTime" BO_ 100 50;
VAL_ 100 Password 0 "Off" 1 "On";
CM_ "hunter2";
CM_ SG_ 100 Password "two lines,
the second has "hunter2" in quotes";
CM_ BO_ 100
 "escaped \\" hunter2";
CM_ BU_ Gateway "hunter2"
BA_ "BusType" "x";
BA_DEF_ BO_ "Plant" STRING ;
BA_ "Plant" BO_ 100 "hunter2";
// hunter2
"""


def test_dbc_loses_comments_and_secret_attributes_and_nothing_else() -> None:
    cleaner = Cleaner()
    found = clean_dbc(DBC, "x.dbc", cleaner)
    assert "hunter2" not in found
    for kept in ("BO_ 100 Key", '(0.01,0) [0|0] "V"', '"GenMsgCycleTime" BO_ 100 50', '1 "On"'):
        assert kept in found
    assert found.count("\n") == DBC.count("\n")
    assert 'BA_ "BusType" "x";' in found
    assert "Server" not in found
    assert cleaner.removed["x.dbc"]["attribute Plant"] == 2
    assert cleaner.removed["x.dbc"]["comment"] == 6
    assert cleaner.removed["x.dbc"]["attribute SeedKey"] == 3


def test_line_that_is_no_dbc_loses_its_secret() -> None:
    text = DBC.replace("# password", "the password:")
    assert "the password: hunter2" in text
    assert "hunter2" not in clean_dbc(text, "x.dbc", Cleaner())


@pytest.mark.parametrize(
    "path",
    [shipped("dbc/kontronik_esc.dbc"), *sorted(PROJECT.glob("examples/*/*.dbc"))],
    ids=lambda path: path.parent.name,
)
def test_dbc_has_the_same_messages_without_its_comments(path: Path) -> None:
    original = path.read_bytes()
    cleaner = Cleaner()
    data = clean_dbc(original.decode("latin-1"), "x", cleaner).encode("latin-1")
    assert set(cleaner.removed.get("x", ())) <= {"comment"}
    assert described(data) == described(original)


def described(data: bytes) -> list[object]:
    database = parse_database(data, "x.dbc")
    found: list[object] = []
    for message in database.messages:
        found.append((message.name, message.frame_id, message.cycle_time, message.send_type))
        for signal in message.signals:
            found.append((signal.name, signal.start, signal.length, signal.scale, signal.unit))
            found.append((signal.choices, signal.raw_initial, signal.minimum, signal.maximum))
    return found


EDS = """[FileInfo]
Description=x
[Comments]
Lines=1
Line1=hunter2
; hunter2
[2105]
ParameterName=Service password
ObjectType=0x8
[2105sub1]
ParameterName=First
DefaultValue=0xC0FFEE
[2105Value]
NrOfEntries=1
1=0xC0FFEE
[2106]
ParameterName=Speed
DefaultValue=5
"""


def test_eds_loses_comments_and_values_of_objects_with_secret_names() -> None:
    found = clean_eds(EDS, "x.eds", Cleaner())
    assert "hunter2" not in found
    assert "C0FFEE" not in found
    assert "[2106]\nParameterName=Speed\nDefaultValue=5\n" in found
    assert found.count("\n") == EDS.count("\n")


def test_shipped_eds_loses_only_comments() -> None:
    text = shipped("eds/kontronik_esc.eds").read_bytes().decode("latin-1")
    cleaner = Cleaner()
    found = clean_eds(text, "x", cleaner)
    assert set(cleaner.removed.get("x", ())) <= {"comment"}
    loaded = eds.load(found.encode("latin-1"), "x.eds")
    assert loaded.entries == eds.load(text.encode("latin-1"), "x.eds").entries


@pytest.mark.parametrize("name", ["monkey", "keyboard", "passenger_count", "compass", "userspace"])
def test_name_that_only_resembles_a_secret_is_kept(name: str) -> None:
    assert not is_secret_name(name)
