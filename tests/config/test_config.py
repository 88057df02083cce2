"""The configuration: each key, the shipped example, JSON Schema and parser compared.

tests/golden/commands/refused_config.txt has the message of each kind of mistake.
"""

import json
import math
import re
import tomllib
from copy import deepcopy
from dataclasses import MISSING, fields
from fractions import Fraction
from pathlib import Path
from typing import Any

import hypothesis
import jsonschema
import pytest
from hypothesis import strategies as st

import kontronik_can_gw
from kontronik_can_gw.assembly.assemble import load_configuration
from kontronik_can_gw.cli.schema import schema
from kontronik_can_gw.config.conditions import condition
from kontronik_can_gw.config.export import as_toml
from kontronik_can_gw.config.keys import REMOVED_KEYS, Config, shipped
from kontronik_can_gw.config.parse import load, parse
from kontronik_can_gw.core.settings import NUMBERS, CoreSettings
from kontronik_can_gw.errors import UserError, did_you_mean
from kontronik_can_gw.native.header import structure
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.times import MS

pytestmark = pytest.mark.promise("all-mistakes")

EXAMPLE = Path(kontronik_can_gw.__file__).parent / "example.toml"
KCG_PLAN = structure("kcg_plan")
DEFAULT_SETTINGS = {
    each.name: each.default for each in fields(CoreSettings) if each.default is not MISSING
}
KEYS: dict[str, dict[str, Any]] = {}
for _table, _described in schema()["properties"].items():
    _entries = _described.get("items", _described)["properties"]
    KEYS[_table] = {key: entry for key, entry in _entries.items() if "deprecated" not in entry}
"""The schema of each key. docs/reference/configuration.md is made from the same rows."""


def tables(table: str = "", key: str = "", value: object = None) -> dict[str, Any]:
    """Return the smallest valid configuration with one more key."""
    made: dict[str, Any] = {"esc": [{"port": "/dev/ttyUSB0"}]}
    if table == "esc":
        made["esc"][0][key] = value
    elif table:
        made[table] = {key: value}
    if (table, key) == ("dbc", "enabled"):  # at least one output must be enabled
        made["canopen"] = {"enabled": True}
    return made


def taken(table: str, key: str, value: object) -> Any:
    """Return the value in use for one key."""
    config = parse(tables(table, key, value), "a.toml")
    return getattr(table_of(config, table), key)


def table_of(config: Config, table: str) -> Any:
    """Return a table of the configuration, or the first ESC."""
    return config.esc[0] if table == "esc" else getattr(config, table)


def problems(given_tables: Any) -> list[str]:
    with pytest.raises(UserError) as caught:
        parse(given_tables, "a.toml")
    assert caught.value.exit_code == 2
    return list(caught.value.problems)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("batery_voltage < 3", 'there is no value "batery_voltage". Did you mean battery_voltage?'),
        ("left.x < 3", 'there is no value "x"'),
        ("battery_voltage = 3", "= is unknown. Use one of <, <=, >, >="),
        ("battery_voltage <> 3", "<> is unknown. Use one of <, <=, >, >="),
        ("battery_voltage < x", '"x" is not a number'),
        ("battery_voltage <", '"" is not a number'),
        ("battery_voltage < 3 A", '"A" is no unit of battery_voltage. Known: V, mV, kV'),
        ("undervoltage > 0 V", 'undervoltage has no unit. Remove "V"'),
        ("uptime > 3", "uptime is a value of the gateway, not of an ESC"),
        ("operating_state > 3", "operating_state is not a number"),
        ("data_age > 3", "data_age cannot be compared. The loss of telemetry is an event"),
        ("right.battery_voltage < 3", "there is no ESC of this name. Known: esc1."),
        ("hello", '"hello" is not a condition such as "battery_voltage < 20"'),
        ("voltage < 20", "Did you mean battery_voltage or bec_voltage?"),
        ("nothing < 20", 'there is no value "nothing"'),
        ("x" * 300 + "<", "is not a condition such as"),
    ],
)
def test_wrong_condition_is_one_clear_mistake(text: str, problem: str) -> None:
    [found] = problems(tables("record", "when", [text]))
    assert found.startswith("a.toml: record.when: ")
    assert problem in found


def test_all_wrong_conditions_and_error_bits_are_named_at_once() -> None:
    wrong = ["a < 1", "batery_voltage < 1", 3, "battery_voltage < 20"]
    record = {"when": wrong, "errors": ["x", "undervoltag"]}
    when, errors = problems(tables() | {"record": record})
    assert 'there is no value "a"; "batery_voltage < 1": ' in when
    assert when.endswith('Did you mean battery_voltage? 3 is not a string. Write it in quotes: "3"')
    assert '"x" is neither error, warning or status nor an error bit; "undervoltag"' in errors
    assert errors.endswith("Did you mean undervoltage?")


def test_limit_is_converted_to_the_unit_of_the_value() -> None:
    for text, limit in (
        ("battery_voltage<20", 20.0),
        ("BatteryVoltage < 20500 mV", 20.5),
        ("esc1.power_stage_temperature > 212 °F", 100.0),
        ("motor_run_time > 2 min", 120.0),
    ):
        assert condition(text).limit == limit


# --- each key


def test_value_in_use_differs_from_the_value_written() -> None:
    for text in ("9.8", "98/10", "9.8/10", "1/3", "007", "1/1000"):
        numerator, _, denominator = text.partition("/")
        assert taken("esc", "gear", text) == Fraction(numerator) / Fraction(denominator or 1)
    for number in (1, 9.8, 0.001, 1000, 1e3):
        assert taken("esc", "gear", number) == Fraction(str(number))
    assert taken("dbc", "messages", ["Motor_*", "X"]) == ("Motor_*", "X")
    config = parse(tables("esc", "telemetry_timeout_ms", 20), "a.toml")
    assert config.escs[0].timeout_ns == 20 * MS


@pytest.mark.parametrize(
    ("text", "host", "plain", "encrypted"),
    [
        ("broker", "broker", 1883, 8883),
        ("192.168.1.5:1884", "192.168.1.5", 1884, 1884),
        ("[fe80::1]", "fe80::1", 1883, 8883),
        ("[::1]:65535", "::1", 65_535, 65_535),
    ],
)
def test_broker_has_the_usual_port_unless_it_is_given(
    text: str,
    host: str,
    plain: int,
    encrypted: int,
) -> None:
    for tls, port in ((False, plain), (True, encrypted)):
        mqtt = {"broker": text, "tls": tls}
        made = parse({"mqtt": mqtt, "esc": [{"port": "x"}]}, "a.toml")
        assert made.mqtt.address == (host, port)
    assert parse(tables(), "a.toml").mqtt.address is None


def test_node_ids_count_from_the_base_unless_an_esc_has_one() -> None:
    canopen: dict[str, Any] = {"enabled": True, "node_id": 10}
    escs: list[dict[str, Any]] = [{"port": f"p{n}"} for n in range(4)]
    made = {"canopen": canopen, "esc": escs}
    assert parse(made, "a.toml").node_ids == [10, 11, 12, 13]
    escs[2]["node_id"] = 99
    assert parse(made, "a.toml").node_ids == [10, 11, 99, 13]
    canopen["node_id"] = 255
    assert parse(made, "a.toml").node_ids == [255, 255, 99, 255]


@pytest.mark.parametrize(
    "text",
    [
        '[dbc.bind]\n"EscPower.BattVolt" = "battery_voltage"\nSpare = 0\nHalf = 0.5',
        '[dbc.bind]\nEscPower.BattVolt = "battery_voltage"\nSpare = 0\nHalf = 0.5',
        '[dbc]\nbind = { EscPower = { BattVolt = "battery_voltage" }, Spare = 0, Half = 0.5 }',
    ],
)
def test_bindings_may_be_quoted_dotted_or_nested(text: str) -> None:
    config = parse(tomllib.loads(text + '\n[[esc]]\nport = "x"'), "a.toml")
    bind = {"EscPower.BattVolt": "battery_voltage", "Spare": 0, "Half": 0.5}
    assert dict(config.dbc.bind) == bind


# --- mistakes


def escs(*entries: dict[str, Any]) -> dict[str, Any]:
    """Return ESCs with different ports."""
    return {"esc": [{"port": f"p{n}"} | entry for n, entry in enumerate(entries)]}


DBC = """VERSION ""
NS_ :
BS_:
BU_: Gateway
BO_ 256 M: 8 Gateway
 SG_ BattVolt : 0|16@1+ (1,0) [0|0] "V" Gateway
"""
BAD_DBC = "M.BattVolt: no such source"
TWO_ON_ONE_PORT = [{"port": "a"}, {"port": "a"}]
OTHERS: list[tuple[dict[str, Any], list[str]]] = [
    (
        {"statistics": {"file": "my.dbc"}} | escs({"name": "x"}, {"name": "X"}),
        ['esc[2].name: "X" is already used', "statistics.file", BAD_DBC],
    ),
    (
        {"canopen": {"node_id": 127, "eds": "none.eds"}, "esc": TWO_ON_ONE_PORT},
        [
            "esc[2].port",
            "esc[2]: its node-ID would be 128",
            "none.eds: cannot be read",
            BAD_DBC,
        ],
    ),
    (
        {"can": {"channel": "/dev/null"}, "esc": [{"port": "/dev/null"}]},
        ["is the port of esc1", BAD_DBC],
    ),
    # The DBC depends on the tables, so with a mistake in a table it is not checked.
    (
        {"dbc": {"file": "my.dbc", "noode": 1}, "esc": TWO_ON_ONE_PORT},
        ["noode", "esc[2].port"],
    ),
]


@pytest.mark.parametrize(("made", "expected"), OTHERS)
def test_mistakes_of_every_file_are_reported_together(
    tmp_path: Path,
    made: dict[str, Any],
    expected: list[str],
) -> None:
    (tmp_path / "my.dbc").write_text(DBC)
    tables = {"dbc": {"file": "my.dbc"}} | made
    if "canopen" in tables:
        tables["canopen"]["enabled"] = True
    text = ""
    for name, table in tables.items():
        if name != "esc":
            text += f"[{name}]\n{rows_of(table)}"
    for esc in tables["esc"]:
        text += f"[[esc]]\n{rows_of(esc)}"
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(UserError) as caught:
        load_configuration(tmp_path / "a.toml")
    assert caught.value.exit_code == 2
    for words, line in zip(expected, caught.value.problems, strict=True):
        assert words in line


def rows_of(table: dict[str, Any]) -> str:
    return "".join(f"{key} = {json.dumps(value)}\n" for key, value in table.items())


# --- keys of earlier versions


@pytest.mark.promise("removed")
def test_removed_key_is_a_warning_with_place_and_replacement(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(REMOVED_KEYS, "can.queue", "Leave it out.")
    monkeypatch.setitem(REMOVED_KEYS, "esc.motor", "Give pole_pairs.")
    old = {
        "can": {"queue": 3, "channel": "can1"},
        "esc": [{"port": "a"}, {"port": "b", "motor": [], "gear": 2}],
    }
    config = parse(old, "a.toml")
    assert config.warnings == (
        "a.toml: can.queue: was removed and is ignored. Leave it out.",
        "a.toml: esc[2].motor: was removed and is ignored. Give pole_pairs.",
    )
    assert config.can.channel == "can1"
    assert config.esc[1].gear == Fraction(2)
    without = parse({"can": {"channel": "can1"}} | escs({}), "a.toml")
    assert config.can == without.can
    assert jsonschema.Draft202012Validator(schema()).is_valid(old)
    assert "queue" not in as_toml(config)
    assert problems(old | {"run": 1}) == ["a.toml: run: must be a table, written [run]"]
    for key, advice in REMOVED_KEYS.items():
        table, _, name = key.partition(".")
        assert table in KEYS, key
        assert name not in KEYS[table], key
        assert advice.endswith("."), key


# --- the shipped example


def uncommented() -> str:
    """Return the example with all keys and table heads uncommented."""
    commented = r'(?m)^#(?=\[|"?[A-Za-z_.0-9*]+"? = )'
    return re.sub(commented, "", EXAMPLE.read_text(encoding="utf-8"))


@pytest.mark.promise("schema")
def test_shipped_example_is_valid_and_has_every_key(tmp_path: Path) -> None:
    assert load(EXAMPLE).esc[0].pole_pairs == 7
    text = uncommented()
    assert not re.search(r"^#\S", text, re.MULTILINE)
    windows = tmp_path / "a.toml"
    windows.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    assert [esc.name for esc in load(windows).esc] == ["esc1", "right"]
    made = tomllib.loads(text)
    given: dict[str, set[str]] = {}
    for table, found in made.items():
        entries = found if table == "esc" else [found]
        given[table] = {key for entry in entries for key in entry}
    known = {table: set(keys) for table, keys in KEYS.items()}
    assert given == known, f"add the keys to {EXAMPLE.name}"


# --- settings of the core


def test_each_setting_of_the_core_follows_from_the_configuration() -> None:
    made = tomllib.loads(uncommented())
    made["dbc"]["on_loss"] = "silent"  # the only value of the example that is the default
    config = parse(made, str(EXAMPLE))
    settings = config.core_settings((), MessageLayout("", "", ()))
    for name, default in DEFAULT_SETTINGS.items():
        if name != "slots":  # follows from the outputs
            message = f"set {name} in config/keys.py: Config.core_settings"
            assert getattr(settings, name) != default, message


def test_each_setting_that_is_a_number_reaches_the_core_in_c() -> None:
    numbers = {name for name, default in DEFAULT_SETTINGS.items() if type(default) is int}
    missing = numbers - {"slots"} - NUMBERS.keys()
    assert not missing, "add it to NUMBERS in core/settings.py"
    for name in NUMBERS:
        assert hasattr(KCG_PLAN, name), f"add {name} to kcg_plan in native/core.h"


# --- schema and parser compared

VALIDATOR = jsonschema.Draft202012Validator(schema())


def accepted(made: Any) -> Config | None:
    try:
        return parse(made, "a.toml")
    except UserError:
        return None


@pytest.mark.promise("schema")
def test_schema_describes_every_key_with_the_default_of_the_parser() -> None:
    jsonschema.Draft202012Validator.check_schema(schema())
    config = parse(tables(), "folder/a.toml")
    assert config.dbc_path == shipped("dbc/kontronik_esc.dbc")
    assert config.dbc_path.is_file()
    mine = parse(tables("dbc", "file", "my.dbc"), "folder/a.toml")
    assert mine.dbc_path == Path("folder/my.dbc")
    for table, keys in KEYS.items():
        made = config.esc[0] if table == "esc" else getattr(config, table)
        for key, described in keys.items():
            assert described["description"]
            if "default" in described:
                VALIDATOR.evolve(schema=described).validate(described["default"])
                default = described["default"]
                if isinstance(default, list):
                    default = tuple(default)
                assert getattr(made, key) == default
            elif (table, key) not in (("esc", "port"), ("esc", "name")):
                assert not getattr(made, key)


TAKEN: dict[tuple[str, str], list[Any]] = {
    ("dronecan", "name"): ["a", "com.example.esc-1_2", "x" * 60],
    ("mqtt", "broker"): ["broker", "[::1]:65535"],
    ("mqtt", "gateway"): ["a_1-B"],
    ("mqtt", "discovery"): ["ha/x"],
    ("mqtt", "topic"): ["fleet/north", "ü/€", "a$"],
    ("esc", "name"): ["a", "Left", "esc_1", "A23456789012"],
    ("esc", "gear"): ["1/1000", "1/3", 9.8],
    ("dbc", "messages"): [["Motor_*", "X"]],
    ("record", "when"): [["battery_voltage < 20"], ["Battery Current>=1.5e2 A", "throttle > -5"]],
    ("record", "errors"): [["error", "status"], ["undervoltage", "test_short_to_ground"]],
    ("dbc", "bind"): [{"A": "x", "B": -1.5}],
    ("dbc", "e2e"): [{"Motor_*": "2", "EscSpeed": "11C"}],
    ("dbc", "e2e_data_ids"): [{"EscSpeed": 0, "EscStatus": 0xFFFF, "Motor": [*range(16)]}],
    ("dbc", "units"): [{"Unit_X": "degC", "x": "-"}],
    ("dbc", "send_type"): [{"No": "Event"}],
    ("can", "options"): [{"ttyBaudrate": 115200, "host": "a b", "x": 0.5, "y": True}],
}
"""Values of keys that accept neither any text nor any number in a range."""
CHANGED_IN_USE = ("gear", "messages", "bind", "e2e_data_ids", "errors", "when")
"""Keys whose values in use have another form, such as a tuple for a list."""


def given(table: str, key: str) -> list[tuple[bool | None, Any]]:
    """Return values of a key, and whether they are accepted. None: the schema decides."""
    numbers = [0, 1, -1, 7, 127, 128, 200, 10_000, 10**30]
    fractions = [0.0005, 0.001, 0.5, 9.8, 1000.5, -0.5]
    texts = ["", " ", "x", "a b", "1a", "A234567890123", "max"]
    ratios = ["1/3", "98/10", "9.8/2", " 1/3", "1 / 3", "1e1", ".5", "+1", "-1", "٣"]
    others: list[Any] = [True, False, [], [1], {}]
    entries: list[Any] = [
        1,
        "x",
        "",
        True,
        1.5,
        -1,
        65_535,
        65_536,
        {},
        [],
    ]
    entries += [{"b": 1}, {"b": "x"}, {"b": {"c": 1}}, {"b": []}]
    values: list[Any] = [*numbers, *fractions, *texts, *ratios, *others]
    values += [{"a": entry} for entry in entries]
    found: list[tuple[bool | None, Any]] = [(None, value) for value in values]
    entry = KEYS[table].get(key, {})
    found += [(True, value) for value in entry.get("enum", ())]
    found += [(True, value) for value in TAKEN.get((table, key), ())]
    if "minimum" in entry:
        low = entry["minimum"]
        high = entry["maximum"]
        found += [(True, low), (True, high), (False, low - 1), (False, high + 1)]
    return found


@pytest.mark.promise("schema")
def test_schema_and_parser_accept_the_same_and_toml_is_equal() -> None:
    """A schema cannot express the range of a gear as text, or ambiguous names."""
    for table, keys in KEYS.items():
        for key in (*keys, "x"):
            for is_taken, value in given(table, key):
                made = tables(table, key, deepcopy(value))
                config = accepted(made)
                place = f"{table}.{key} = {value!r}"
                assert is_taken in (None, config is not None), place
                if place != "esc.name = 'max'":
                    assert VALIDATOR.is_valid(made) == (config is not None), place
                if config is not None:
                    found = getattr(table_of(config, table), key)
                    if key not in CHANGED_IN_USE:
                        assert found == value, place
                        assert type(found) is type(value), place
                    check_toml(config)


PYTHON = re.compile(r"\b(True|False|None)\b|\{'|\['|'[^' ]*' is |\(\w+,\)")
"""Values as Python writes them."""


def test_no_mistake_of_any_key_has_a_value_as_python_writes_it() -> None:
    found: set[str] = set()
    for table, keys in KEYS.items():
        for key in keys:
            for _, value in given(table, key):
                try:
                    parse(tables(table, key, deepcopy(value)), "a.toml")
                except UserError as error:
                    found.update(line for line in error.problems if PYTHON.search(line))
    assert not found


@pytest.mark.parametrize(
    ("table", "key", "value", "said"),
    [
        ("can", "bitrate", True, "true is not an integer, 10000 to 1000000 bit/s"),
        ("can", "bitrate", 9999, "9999 is outside 10000 to 1000000 bit/s"),
        ("can", "restart_after_s", 0.1, "0.1 is neither 0.3 to 3600 s nor 0"),
        ("can", "channel", 7, '7 is not a string. Write it in quotes: "7"'),
        ("can", "fd", {"b": True}, "{ b = true } is not true or false"),
        ("canopen", "node_id", "1", '"1" is not an integer, 1 to 127 or 255'),
        ("record", "before_s", 601, "601 is outside 1 to 600 s"),
        ("mqtt", "rate", [1], "[1] is not a number, 0.01 to 20 Hz"),
        ("esc", "gear", "1/2/3", '"1/2/3" is neither a number, 0.001 to 1000, nor "numerator'),
    ],
)
def test_refused_value_is_shown_as_toml_with_range_and_unit(
    table: str, key: str, value: Any, said: str
) -> None:
    (line,) = problems(tables(table, key, value))
    assert said in line


@pytest.mark.parametrize(
    ("key", "value"), [("before_s", 3), ("after_s", 3), ("when", ["battery_voltage < 20"])]
)
def test_key_of_events_without_on_event_has_a_warning(key: str, value: Any) -> None:
    (line,) = parse(tables("record", key, value), "a.toml").warnings
    assert line == f"a.toml: record.{key}: has no effect without record.on_event = true"
    on = tables() | {"record": {key: value, "on_event": True, "directory": "d"}}
    assert parse(on, "a.toml").warnings == ()


@pytest.mark.parametrize(
    ("name", "known", "said"),
    [
        ("voltage", ["overvoltage", "battery_voltage"], " Did you mean battery_voltage?"),
        ("temp", ["timing", "bec_temperature"], " Did you mean bec_temperature?"),
        ("BatteryVoltage", ["battery_voltage"], " Did you mean battery_voltage?"),
        ("batery_voltage", ["voltage", "battery_voltage"], " Did you mean battery_voltage?"),
        ("nothing", ["timing"], ""),
        ("canbus", ["can", "dbc"], " Did you mean can?"),
        ("x", ["y"], ""),
        ("", ["y"], ""),
    ],
)
def test_suggestions_rank_whole_words_first(name: str, known: list[str], said: str) -> None:
    assert did_you_mean(name, known) == said


def test_schema_and_parser_accept_the_same_kinds_of_tables() -> None:
    two_escs = [{"port": "a"}, {"port": "b"}]
    kinds: list[Any] = [
        {},
        [],
        1,
        "x",
        [{}],
        [1],
        two_escs,
        [{}, {}],
    ]
    for table in (*KEYS, "x"):
        for kind in kinds:
            made = tables() | {table: kind}
            assert VALIDATOR.is_valid(made) == (accepted(made) is not None), made


def check_toml(config: Config) -> None:
    """Check that the effective configuration as TOML is equal when it is read again."""
    text = as_toml(config)
    again = parse(tomllib.loads(text), config.file)
    assert again == config
    assert as_toml(again) == text


def test_any_text_can_be_written_as_toml() -> None:
    odd = ('a"b', "C:\\x", "a\nb", "\t\x01\x1f\x7f\x85", "ü€😀", "'''", '"""', "#", "a = [b]")
    for text in odd:
        made = {
            "esc": [{"port": text}],
            "can": {"options": {text: text}},
            "dbc": {
                "bind": {text: text},
                "file": text,
                "units": {text: "V"},
                "e2e": {text: "5"},
                "e2e_data_ids": {text: 1, text * 2: [7] * 16},
            },
        }
        check_toml(parse(made, text))
    check_toml(load(EXAMPLE))
    check_toml(parse(tomllib.loads(uncommented()), str(EXAMPLE)))


def test_values_that_only_the_parser_refuses_are_listed() -> None:
    only_parser = [
        tables("esc", "gear", "1/0"),
        tables("esc", "pole_pairs", 7.0),  # a whole number in JSON, a float in TOML
        tables("esc", "name", "a\n"),  # "$" also matches before a line end, but only in Python
        tables("dbc", "bind", {"a": math.inf}),  # JSON has no infinity
    ]
    assert [VALIDATOR.is_valid(made) for made in only_parser] == [True] * 4
    assert [accepted(made) for made in only_parser] == [None] * 4


@hypothesis.settings(max_examples=50)
@hypothesis.given(st.binary(max_size=200))
def test_any_content_of_a_file_raises_at_most_a_user_error(
    tmp_path_factory: Any, content: bytes
) -> None:
    file = tmp_path_factory.getbasetemp() / "any.toml"
    file.write_bytes(content)
    with pytest.raises(UserError):
        load(file)


# --- keys without effect

NO_RESTART = (
    "a.toml: can.restart_after_s: has no effect with the interface slcan, because only SocketCAN "
    "interfaces can be restarted"
)


@pytest.mark.parametrize(
    ("can", "warnings"),
    [
        ({"interface": "socketcan", "restart_after_s": 0.5}, ()),
        ({"interface": "slcan", "restart_after_s": 0}, ()),
        ({"interface": "slcan", "restart_after_s": 0.5}, (NO_RESTART,)),
    ],
)
def test_restart_of_an_interface_that_cannot_be_restarted_is_a_warning(
    can: dict[str, Any],
    warnings: tuple[str, ...],
) -> None:
    config = parse({"can": can} | escs({}), "a.toml")
    assert config.warnings == warnings
