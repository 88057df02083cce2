"""Removes passwords, keys and comments from configurations, DBC files and EDS files. Pure.

Only keys and attributes whose meaning is known keep their values. The options of a python-can
interface and the attributes that a vehicle maker has invented may contain anything.

People write passwords into comments, in any words. Comments change nothing that the gateway does,
so all of them are removed. The number of lines stays, so that messages with line numbers fit.
"""

import re
import tomllib
from dataclasses import fields

from kontronik_can_gw.config.keys import TABLES
from kontronik_can_gw.desk.bundle.secrets import REMOVED, Cleaner, is_secret_name
from kontronik_can_gw.esc.value_names import normalize

COMMENT = "comment"
OPTIONS = ("can", "options")
"""The table and the key of a python-can interface's options."""
_TOML_TOKEN = re.compile(
    r"(?P<long>\"\"\".*?(?:\"\"\"|\Z)|'''.*?(?:'''|\Z))"
    r"|\"(?:[^\"\\\n]|\\[^\n])*\"|'[^'\n]*'|#(?P<comment>[^\n]*)",
    re.DOTALL,
)
_TOML_NAME = r"(?:[\wÀ-ÿ-]+|\"[^\"\n]*\"|'[^'\n]*')"
_TOML_KEY = re.compile(rf"\s*(?P<key>{_TOML_NAME}(?:[ \t]*\.[ \t]*{_TOML_NAME})*)[ \t]*=")
_TOML_TABLE = re.compile(r"\s*\[\[?(?P<name>[\wÀ-ÿ .\"'-]+)\]\]?\s*#?\s*$")
_OPTION_OF_RATE = re.compile(r"(?i).*(?:rate|timeout|delay|interval|size)")
"""Names of interface options whose numbers are harmless."""
_NUMBER = re.compile(r"[\d_.+-]+")
_DBC_STRING = re.compile(r'"(?:\\"|[^"])*(?:"|\Z)|//[^\n]*|^[ \t]*(?:#|--|/\*)[^\n]*', re.MULTILINE)
"""A string, or a line that other formats would regard as a comment."""
_DBC_NEXT = r"(?:(?!\n[ \t]*[A-Z][A-Z_]*_[ \t:])[^;])*;?"
"""The rest of a statement. Without a semicolon it ends before the next keyword."""
_DBC_COMMENT = re.compile(rf"\bCM_\s+(?:(?:BU_|BO_|SG_|EV_)\s[^\x00;]*)?\x00[0-9]+\x01{_DBC_NEXT}")
_DBC_ATTRIBUTE = re.compile(
    r"\bBA_(?:DEF_)?(?:DEF_)?(?:REL_|SGTYPE_)?\s+(?:(?:BU_|BO_|SG_|EV_|BU_[A-Z]+_REL_)\s+)?"
    rf"\x00(?P<name>[0-9]+)\x01{_DBC_NEXT}"
)
_KNOWN_ATTRIBUTE = re.compile(
    "gen(?:msg|sig|node|env).*|e2e.*|dataids?|dataidlist|sigfunctype|layoutversion|bustype"
    "|protocoltype|vframeformat|baudrate.*|nm[a-z]*|diag(?:request|response|state)"
    "|tp[a-z]*index|ilused|canfdbrs|multiplexextenabled|spn|sigtype"
    "|system(?:message|signal|node|envvar)longsymbol"
)
"""Normalized names of attributes of Vector, SAE J1939 and AUTOSAR, and of this project."""
_DBC_STATEMENT = re.compile(r"\s*(?:VERSION\b|[A-Z][A-Z_]*_\b|;|\x00|$)")
_MASKED = re.compile(r"\x00([0-9]+)\x01")
_EDS_SECTION = re.compile(r"\s*\[(?P<name>[^\]\n]*)\]")
_EDS_VALUES = ("defaultvalue", "parametervalue", "lowlimit", "highlimit", "denotation")
_EDS_LISTS = ("value", "denotation")
"""Ends of the names of sections that hold values of several entries."""


def clean_toml(text: str, part: str, cleaner: Cleaner) -> str:
    """Return a configuration without secrets and comments, also if it is not valid TOML."""
    comments = 0

    def token(found: re.Match[str]) -> str:
        nonlocal comments
        if found["comment"] is not None:
            comments += bool(found["comment"].strip())
            return "#" if found["comment"].strip() else found[0]
        if found["long"] is None:
            return found[0]
        cleaner.count(part, "text of several lines")
        return f'"{REMOVED}"' + "\n" * found[0].count("\n")

    lines = []
    is_hidden = False
    is_hidden_table = False
    table_name = ""
    for line in _TOML_TOKEN.sub(token, text).split("\n"):
        table = _TOML_TABLE.match(line)
        entry = _TOML_KEY.match(line)
        if table is not None:
            is_hidden = False
            table_name = table["name"]
            is_hidden_table = is_secret_name(table_name)
            lines.append(cleaner.forms(line, part))
        elif entry is not None:
            value = line[entry.end() :].strip(" \t\r#")
            is_harmless = _is_harmless(table_name, entry["key"], value)
            is_hidden = is_hidden_table or not is_harmless
            if is_hidden:
                cleaner.count(part, entry["key"].strip())
                lines.append(f'{entry[0]} "{REMOVED}"')
            else:
                lines.append(cleaner.text(line, part))
        else:
            lines.append("" if is_hidden else cleaner.text(line, part))
    cleaner.count(part, COMMENT, comments)
    return "\n".join(lines)


def _is_harmless(table: str, key: str, value: str) -> bool:
    """Return True for a key of the configuration, and for a value that cannot be a secret.

    A key with the name of a secret is never harmless.
    """
    if is_secret_name(key):
        return False
    path = [part.strip(" \t\"'") for part in f"{table}.{key}".strip(".").split(".")]
    rows = () if path[0] not in TABLES else [row.name for row in fields(TABLES[path[0]])]
    if len(path) > 1:
        is_known = path[1] in rows and path[:2] != list(OPTIONS)
    else:
        is_known = path[0] in TABLES and OPTIONS[1] not in value
    is_rate = _OPTION_OF_RATE.fullmatch(path[-1]) and _NUMBER.fullmatch(value)
    return is_known or value in ("true", "false") or is_rate is not None


def tables_of(text: str) -> dict[str, object]:
    """Return the tables of a configuration. Empty if it is not valid TOML."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError):
        return {}


def clean_dbc(text: str, part: str, cleaner: Cleaner) -> str:
    """Return a DBC file without comments, unknown attributes, and secrets in its other texts."""
    strings: list[str] = []
    comments = 0

    def mask(found: re.Match[str]) -> str:
        nonlocal comments
        if not found[0].startswith('"'):
            comments += 1
            return "//"
        strings.append(found[0])
        return f"\x00{len(strings) - 1}\x01"

    def without_comment(found: re.Match[str]) -> str:
        nonlocal comments
        comments += 1
        return _blank(found[0], strings)

    def without_attribute(found: re.Match[str]) -> str:
        name = strings[int(found["name"])].strip('"')
        if _KNOWN_ATTRIBUTE.fullmatch(normalize(name)) and not is_secret_name(name):
            return found[0]
        cleaner.count(part, f"attribute {name}")
        return _blank(found[0], strings)

    masked = _DBC_STRING.sub(mask, text.replace("\x00", "?").replace("\x01", "?"))
    masked = _DBC_COMMENT.sub(without_comment, masked)
    masked = _DBC_ATTRIBUTE.sub(without_attribute, masked)
    cleaner.count(part, COMMENT, comments)

    def unmask(found: re.Match[str]) -> str:
        string = strings[int(found[1])]
        end = '"' if len(string) > 1 and string.endswith('"') else ""
        return f'"{cleaner.text(string[1 : len(string) - len(end)], part)}{end}'

    lines = masked.split("\n")
    for number, line in enumerate(lines):
        if _DBC_STATEMENT.match(line) is None:  # not as in a DBC, so it may be a sentence
            lines[number] = cleaner.text(line, part)
    return _MASKED.sub(unmask, "\n".join(lines))


def _blank(statement: str, strings: list[str]) -> str:
    """Return as many line ends as a masked statement has."""
    number = statement.count("\n")
    for found in _MASKED.finditer(statement):
        number += strings[int(found[1])].count("\n")
    return "\n" * number


def clean_eds(text: str, part: str, cleaner: Cleaner) -> str:
    """Return an EDS or DCF without comments, and without values of objects with secret names."""
    secret_sections = _sections_with_secrets(text)
    section = ""
    comments = 0
    lines = []
    for line in text.split("\n"):
        end = "\r" if line.endswith("\r") else ""
        found = _EDS_SECTION.match(line)
        key, _, value = line.partition("=")
        name = key.strip().lower()
        if found is not None:
            section = found["name"].strip().lower()
        elif line.lstrip().startswith((";", "#")):
            comments += 1
            line = f";{end}"
        elif section == "comments" and name.startswith("line") and value.strip():
            comments += 1
            line = f"{key}={end}"
        elif (
            section in secret_sections
            and value.strip()
            and (name in _EDS_VALUES or section.endswith(_EDS_LISTS))
        ):
            cleaner.count(part, f"value of {section}")
            line = f"{key}={end}"
        else:
            line = cleaner.text(line, part)
        lines.append(line)
    cleaner.count(part, COMMENT, comments)
    return "\n".join(lines)


def _sections_with_secrets(text: str) -> set[str]:
    """Return the sections of objects whose ParameterName is secret, and of their entries."""
    section = ""
    found = set()
    for line in text.split("\n"):
        head = _EDS_SECTION.match(line)
        key, _, value = line.partition("=")
        if head is not None:
            section = head["name"].strip().lower()
        elif key.strip().lower() == "parametername" and is_secret_name(value):
            found.add(section)
    entries = re.compile(r"([0-9a-f]{4})(?:sub[0-9a-f]+|value|denotation)", re.IGNORECASE)
    for head in _EDS_SECTION.finditer(text):
        name = head["name"].strip().lower()
        inner = entries.fullmatch(name)
        if inner is not None and inner[1] in found:
            found.add(name)
    return found
