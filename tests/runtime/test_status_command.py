"""The command ``status``: its files, its judgement and its exit codes. No file can harm it."""

import contextlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_line import refused, run
from hypothesis import given, settings
from hypothesis import strategies as st
from statistics_bench import Bench, with_nodes

from kontronik_can_gw.desk.monitor.status import (
    HEALTHY,
    NOT_RUNNING,
    TROUBLE,
    Seen,
    judge,
    lines_of,
)
from kontronik_can_gw.runtime.files.event_recorder import EventRecorderFacts
from kontronik_can_gw.runtime.status.facts import (
    CanFacts,
    PortFacts,
    ProgramFacts,
    StoreFacts,
    program_facts,
)
from kontronik_can_gw.runtime.status.snapshot import STALE_NS
from kontronik_can_gw.runtime.system import folders
from kontronik_can_gw.status import CanState, GatewayState
from kontronik_can_gw.times import SECOND

pytestmark = pytest.mark.promise("status")

Document = dict[str, Any]


def heard(
    escs: int = 2,
    seconds: float = 2,
    change: Callable[[Bench], None] | None = None,
) -> Bench:
    """Return a healthy gateway that runs."""
    bench = Bench(escs)
    bench.run(seconds)
    bench.gateway.set_can_state(CanState.ERROR_ACTIVE, bench.now)
    if change is not None:
        change(bench)
    return bench


def judged(document: Document, later: int = 0) -> Seen:
    return judge(Path("status.json"), document, document["monotonic_ns"] + later)


def words(seen: Seen) -> str:
    return "\n".join(line.plain for line in lines_of(seen))


def shell(*arguments: object) -> tuple[object, str, str]:
    """Run the command. Return its exit code, standard output and standard error."""
    done = run("status", *arguments)
    return done.code, done.out, done.err


NOW = 10**15


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stop the command's clock."""
    monkeypatch.setattr("kontronik_can_gw.cli.status.time.monotonic_ns", lambda: NOW)


def written(
    file: Path,
    bench: Bench,
    program: ProgramFacts | None = None,
    **changes: Any,
) -> Document:
    """Write a status file of this process and this instant."""
    document = bench.document(program=program or program_facts("gateway.toml"))
    document |= {"monotonic_ns": NOW} | changes
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(document), encoding="utf-8")
    return document


@pytest.fixture
def run_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "run"
    monkeypatch.setattr(folders, "RUN", folder)
    monkeypatch.setattr(folders, "TEMPORARY", tmp_path / "tmp")
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    return folder


# --- the judgement


def test_esc_that_is_not_heard_is_a_fault_with_its_reason() -> None:
    bench = heard()
    bench.silent.add(1)
    bench.run(2)
    why = "no bytes: ESC off"  # shown only for the ESC that is not heard
    ports = [PortFacts(name, "/dev/a", True, diagnosis=why) for name in ("esc1", "esc2")]
    seen = judged(bench.document(ports=ports))
    assert seen.code == TROUBLE
    assert seen.sentence == "running, 1 fault"
    assert seen.faults[0].startswith("esc2: no bytes: ESC off")


def test_old_name_of_faults_has_the_same_texts() -> None:
    bench = heard()
    bench.silent.add(1)
    bench.run(2)
    found = judged(bench.document()).as_json()
    assert found["faults"]
    assert found["troubles"] == found["faults"]


def test_missing_telemetry_is_no_fault_in_quiet_mode() -> None:
    bench = heard()
    bench.silent = {0, 1}
    bench.run(2)
    bench.gateway.status.state = GatewayState.QUIET
    ports = [PortFacts(name, "/dev/a", True, diagnosis="no bytes") for name in ("esc1", "esc2")]
    seen = judged(bench.document(ports=ports))
    assert (seen.code, seen.sentence) == (HEALTHY, "quiet")
    seen = judged(bench.document(ports=[LOST, *ports[1:]]))
    assert (seen.code, seen.sentence) == (TROUBLE, "quiet, 1 fault")


ACTIVE = CanState.ERROR_ACTIVE
UNKNOWN = CanState.UNKNOWN
OPEN = CanFacts("socketcan", "can0", None, True)
SLCAN = CanFacts("slcan", "x", None, True)
CLOSED = CanFacts("socketcan", "can0", None, False, "can0: gone")
LOST = PortFacts("esc1", "/dev/a", False, "esc1: /dev/a: lost (unplugged).", lost_since_ns=0)


@pytest.mark.parametrize(
    ("state", "facts", "said"),
    [
        (ACTIVE, {"can": OPEN}, []),
        (CanState.ERROR_PASSIVE, {"can": OPEN}, []),
        (UNKNOWN, {"can": SLCAN}, []),
        (CanState.BUS_OFF, {"can": OPEN}, ["CAN can0 is bus-off"]),
        (CanState.DOWN, {"can": OPEN}, ["CAN can0 is down"]),
        (UNKNOWN, {"can": CLOSED}, ["can0: gone"]),
        (ACTIVE, {"can": OPEN._replace(stalled=True)}, ["CAN can0: no frame can be sent"]),
        (ACTIVE, {"store": StoreFacts(0, "full")}, ["parameters cannot be stored: full"]),
        (ACTIVE, {"ports": [LOST]}, ["esc1: port not open for 70.0 s: /dev/a: lost (unplugged)."]),
    ],
)
def test_each_fault_is_reported_as_a_sentence(
    state: CanState,
    facts: dict[str, Any],
    said: list[str],
) -> None:
    bench = heard(1)
    bench.gateway.set_can_state(state, bench.now)
    if "ports" in facts:
        bench.gateway.port(0, False, bench.now)
        facts = {"ports": [LOST._replace(lost_since_ns=bench.now - 70 * SECOND)]}
    seen = judged(bench.document(**facts))
    assert seen.code == (TROUBLE if said else HEALTHY)
    assert list(seen.faults) == said


def test_last_recorded_event_and_its_file_are_shown() -> None:
    document = heard().document()
    facts = EventRecorderFacts(ring_bytes=1_200_000)
    document["recording"] = vars(facts)
    shown = words(judged(document))
    assert "recording waits for an event, with 1.2 MB in memory" in shown
    assert "last event" not in shown
    facts.event = {"time": "2026-11-28T21:00:00Z", "esc": "e1", "reason": "hot", "file": ""}
    shown = words(judged(document))
    assert "last event at 2026-11-28T21:00:00Z: e1: hot, not recorded yet" in shown
    assert "recording waits for the disk, with 1.2 MB in memory" in shown
    facts.event |= {"esc": "", "file": "/captures/a.kcap"}
    facts.file = "/captures/a.kcap"
    shown = words(judged(document))
    assert "recording waits" not in shown
    assert "last event at 2026-11-28T21:00:00Z: hot, /captures/a.kcap" in shown


def test_document_older_than_three_seconds_shows_no_value() -> None:
    document = heard().document()
    assert judged(document, STALE_NS).code == HEALTHY
    seen = judged(document, 12 * SECOND)
    assert seen.code == NOT_RUNNING
    assert seen.sentence == "has written nothing for 12.0 s (ended, blocked, or the disk is full)"
    shown = words(seen)
    assert "has written nothing for 12.0 s" in shown
    assert "25." not in shown
    assert "esc1" not in shown
    assert judged(document, -STALE_NS - 1).sentence == "not running", "the machine was restarted"


# --- files


CONTENTS = (b"", b"{", b"7", b"{}", b"\xff\xfe", b'{"format": 2}', b"[" * 100_000, b"1" * 5000)


def test_file_that_is_no_statistics_file_is_refused_in_one_line(tmp_path: Path) -> None:
    file = tmp_path / "status.json"
    for content in CONTENTS:
        file.write_bytes(content)
        assert refused(NOT_RUNNING, "status", "--file", file).startswith(f"{file}: is ")
    os.mkfifo(tmp_path / "pipe")
    for name, said in (
        ("none", "does not exist"),
        (".", "not a regular file"),
        ("pipe", "not a regular file"),
    ):
        assert said in refused(NOT_RUNNING, "status", "--file", tmp_path / name)


def test_configuration_selects_its_file_or_the_service_of_its_name(
    tmp_path: Path,
    run_folder: Path,
) -> None:
    esc = '[[esc]]\nport = "x"\n'
    for name, folder in (("gateway", ""), ("left", "-left")):
        toml = tmp_path / f"{name}.toml"
        toml.write_text(esc, encoding="utf-8")
        code, _, talk = shell("-c", toml)
        assert code == NOT_RUNNING
        assert f"run -c {toml}" in talk
        file = run_folder / f"kontronik-can-gw{folder}" / "status.json"
        written(file, heard(), program_facts(tmp_path / "other.toml"))
        code, _, talk = shell("-c", toml)
        assert code == NOT_RUNNING
        assert "other.toml, not with" in talk
        written(file, heard(), program_facts(toml))
        code, out, _ = shell("-c", toml)
        assert code == HEALTHY
        assert out.count("kontronik-can-gw ") == 1
        by_hand = folders.status_folders()[0] / folders.status_name(toml)
        written(file, heard(), program_facts(tmp_path / "other.toml"))
        written(by_hand, heard(), program_facts(toml))
        assert shell("-c", toml)[0] == HEALTHY, "not the service of another configuration"
        by_hand.unlink()
    elsewhere = tmp_path / "elsewhere.toml"
    elsewhere.write_text(f'[statistics]\nfile = "s/status.json"\n{esc}')
    written(tmp_path / "s" / "status.json", heard(), program_facts(elsewhere))
    assert shell("-c", elsewhere)[0] == HEALTHY


def test_broken_configuration_in_this_folder_is_only_a_warning(
    run_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("gateway.toml").write_text("cann = 1\n")
    code, out, talk = shell()
    assert code == NOT_RUNNING
    assert out == ""
    assert "status: warning: gateway.toml: " in talk
    assert "status: no gateway of this user or of the system runs." in talk
    written(run_folder / "kontronik-can-gw" / "status" / "1.json", heard())
    code, out, talk = shell()
    assert code == HEALTHY
    assert out.count("kontronik-can-gw ") == 1
    assert talk == ""
    assert shell("-c", "gateway.toml")[0] == 2


def test_only_for_an_ended_service_is_the_journal_advised(run_folder: Path, tmp_path: Path) -> None:
    """A killed gateway leaves its file behind. A gateway started by hand has no journal."""
    stopped_ns = NOW - 60 * SECOND
    by_hand = run_folder / "kontronik-can-gw" / "status" / "1.json"
    written(by_hand, heard(), monotonic_ns=stopped_ns)
    code, out, _ = shell()
    assert code == NOT_RUNNING
    assert "has written nothing for 60.0 s" in out
    assert "journalctl" not in out
    by_hand.unlink()
    service = run_folder / "kontronik-can-gw-left" / "status.json"
    configured = tmp_path / "statistics.json"
    written(configured, heard(), monotonic_ns=stopped_ns)
    service.parent.mkdir()
    service.symlink_to(configured)
    for arguments in ((), ("--file", configured)):
        assert "Why? journalctl -e -u 'kontronik-can-gw*'" in shell(*arguments)[1]


def test_without_options_all_gateways_are_shown_and_3_means_none_runs(
    run_folder: Path,
) -> None:
    code, out, talk = shell()
    assert code == NOT_RUNNING
    assert out == ""
    assert "sudo systemctl start kontronik-can-gw" in talk
    assert talk.count("\n") == 1
    service = run_folder / "kontronik-can-gw" / "status.json"
    written(service, heard(), monotonic_ns=1)
    assert shell()[0] == NOT_RUNNING
    written(service, heard())
    code, out, _ = shell()
    assert code == HEALTHY
    assert out.count("kontronik-can-gw ") == 1
    troubled = heard(change=lambda bench: bench.gateway.set_can_state(CanState.BUS_OFF, bench.now))
    written(run_folder / "kontronik-can-gw-a" / "status.json", troubled)
    assert shell()[0] == TROUBLE
    written(run_folder / "kontronik-can-gw-a" / "status.json", heard(), monotonic_ns=1)
    code, out, _ = shell()
    assert (code, out.count("kontronik-can-gw ")) == (TROUBLE, 2), "one runs, one has stopped"


def test_gateways_of_this_user_are_found_in_every_runtime_folder(
    run_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "session"))
    uid = os.geteuid()
    places = [
        run_folder / "kontronik-can-gw",
        tmp_path / "session" / "kontronik-can-gw",
        run_folder / "user" / str(uid) / "kontronik-can-gw",
        tmp_path / "tmp" / f"kontronik-can-gw-{uid}",
    ]
    for number, place in enumerate(places):
        written(place / "status" / f"{number}.json", heard(), program_facts(f"{number}.toml"))
    code, out, _ = shell()
    assert code == HEALTHY
    assert [f"/{n}.toml" in out for n in range(4)] == [True] * 4
    places[3].chmod(0o777)  # another user could have written the file
    assert shell()[1].count("kontronik-can-gw ") == 3
    (places[0] / "status" / "same.json").symlink_to(places[1] / "status" / "1.json")
    assert shell()[1].count("kontronik-can-gw ") == 3, "a link is no second gateway"


def test_json_is_one_document_with_the_judgement_and_the_file_content(tmp_path: Path) -> None:
    file = tmp_path / "status.json"
    document = written(file, heard())
    for name, code, held in ((file, HEALTHY, document), (tmp_path / "none", NOT_RUNNING, None)):
        done = shell("--file", name, "--json")
        (gateway,) = json.loads(done[1])["gateways"]
        assert done[0] == code
        assert done[2] == ""
        assert gateway["exit_code"] == code
        assert gateway["file"] == str(name)
        assert gateway["document"] == held


# --- the screen


WHOLE = with_nodes(heard(3).document(log_lines=["14:03:01 esc1: telemetry lost"]))


def test_count_and_its_label_are_on_one_line() -> None:
    document: Any = json.loads(json.dumps(WHOLE))
    for counts in (0, 7, 4_321, 98_765_432):
        document["can"]["counters"] = dict.fromkeys(document["can"]["counters"], counts)
        shown = [text.plain for text in lines_of(judge(Path("x"), document, WHOLE["monotonic_ns"]))]
        assert max(map(len, shown)) <= 80
        (line,) = [text for text in shown if "id conflicts" in text]
        grouped = f"{counts:,}".replace(",", " ")
        assert f"{grouped} id conflicts" in line


def places(value: object, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the paths of all values in a document."""
    children = dict(enumerate(value)) if isinstance(value, list) else value
    found = [path]
    if isinstance(children, dict):
        for key, child in children.items():
            found += places(child, (*path, key))
    return found


PLACES = [place for place in places(WHOLE) if place]
_ODD = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(10**30), 10**30),
    st.sampled_from([float("nan"), float("inf"), 1e308, 10**400, [], {}, [None, {}], {"a": {}}]),
    st.text(max_size=20),
    st.just("\x1b[2J\x1b]0;x\x07\r\n\x9b[31m\u202e"),
)


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(PLACES), _ODD), min_size=1, max_size=5), st.booleans())
def test_lines_of_any_document_contain_no_terminal_controls(
    changes: list[tuple[tuple[Any, ...], Any]],
    alive: bool,
) -> None:
    document: Any = json.loads(json.dumps(WHOLE))
    for place, value in changes:
        at = document
        with contextlib.suppress(KeyError, IndexError, TypeError):
            for key in place[:-1]:
                at = at[key]
            at[place[-1]] = value
    if not alive:
        document["monotonic_ns"] = -(10**12)
    seen = judge(Path("x"), document, WHOLE["monotonic_ns"])
    assert seen.code in (HEALTHY, TROUBLE, NOT_RUNNING)
    assert all(line.plain.isprintable() for line in lines_of(seen))


def test_text_in_place_of_a_time_is_not_multiplied() -> None:
    """The product would be larger than the memory."""
    document: Any = json.loads(json.dumps(WHOLE))
    document["process"]["uptime_s"] = "x" * 1_000_000
    assert judge(Path("x"), document, WHOLE["monotonic_ns"]).document is None
