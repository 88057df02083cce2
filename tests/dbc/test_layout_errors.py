"""What lies near a mistake of people in a DBC is none. (Each mistake, in its line: tests/golden/commands/refused_dbc.txt; random
ones: tests/native/fuzz_dbc.py.)"""

import re

from dbc_bench import compiled
from packer_oracle import Msg, Sig, dbc_text

PAGE, VOLTAGE = Sig("Page", 0, 8, mux="M"), Sig("BatteryVoltage", 0, 16, factor="0.01", unit="V")


def one(*signals: Sig) -> str:
    return dbc_text([Msg("Power", 0x100, 8, list(signals))])


def test_pages_may_share_bits_and_a_crc_may_stand_beside_them() -> None:
    current = Sig("BatteryCurrent", 16, 16, signed=True, mux="m1", unit="A")
    text = one(PAGE, Sig("BatteryVoltage", 8, 16, unit="V", mux="m0"), current)
    assert compiled(text).messages[0].pages == (0, 1)
    crc, alive = Sig("Crc8", 8, 8), Sig("AliveCounter", 16, 4)
    assert compiled(one(PAGE, crc, alive, Sig("Timing", 24, 8, unit="us", mux="m1"))).messages
    wide = Sig("BatteryVoltage", 16, 16, unit="V", mux="m16")
    assert compiled(one(Sig("Page", 0, 5, mux="M"), wide)).messages[0].pages == (16,)


def test_an_id_of_11_bits_is_none_of_29_bits_and_what_others_send_is_not_looked_at() -> None:
    foo = [Sig("Foo", 0, 8)]
    others = [Msg(name, 0x123, 8, foo, sender="Other") for name in ("Brake", "Wheel")]
    ours = [Msg("Power", 0x124, 8, [VOLTAGE]), Msg("Flow", 0x124, 8, [VOLTAGE], True)]
    both = compiled(dbc_text([*others, *ours]), node="Gateway").messages
    assert [message.extended for message in both] == [False, True]


def test_a_start_value_that_is_no_number_does_no_harm() -> None:
    more = 'BA_ "GenSigStartValue" SG_ 256 BatteryVoltage 1;'
    text = dbc_text([Msg("Power", 0x100, 8, [VOLTAGE])], more)
    text = re.sub(r'(?m)^(BA_DEF_ SG_ "GenSigStartValue").*', r'\1 ENUM "a","b";', text)
    text = text.replace('BA_DEF_DEF_ "GenSigStartValue" 0', 'BA_DEF_DEF_ "GenSigStartValue" "a"')
    assert compiled(text).messages[0].signals[0].not_available == 65535
