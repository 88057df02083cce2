"""examples/grafana: a real Prometheus that scrapes `metrics` finds every expression.

The expressions are those in dashboard and alerts.
"""

import json
import re
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlencode
from urllib.request import urlopen

import pytest
import yaml  # type: ignore[import-untyped]
from command_line import written
from harness import LoggedProcess
from statistics_bench import Bench
from vcan_tools import GatewayProcess, wait_for

from kontronik_can_gw.runtime.system.clock import ClockFacts

FOLDER = Path(__file__).parents[2] / "examples/grafana"
RULES = [
    rule
    for group in yaml.safe_load((FOLDER / "alerts.yml").read_text())["groups"]
    for rule in group["rules"]
]
EXPRESSIONS = {
    target["expr"]
    for panel in json.loads((FOLDER / "dashboard.json").read_text())["panels"]
    for target in panel["targets"]
}
ALARMS = {rule["alert"]: rule["expr"] for rule in RULES}
pytestmark = [
    pytest.mark.promise("metrics", "docs"),
    pytest.mark.extended,
]


class Prometheus:
    """A Prometheus server that scrapes one target every second."""

    def __init__(self, folder: Path, target: str) -> None:
        job = {"job_name": "kontronik", "scrape_interval": "1s"}
        job |= {"static_configs": [{"targets": [target]}]}  # type: ignore[dict-item]
        config = {"rule_files": [str(FOLDER / "alerts.yml")], "scrape_configs": [job]}
        file = written(folder / "prometheus.yml", json.dumps(config))
        words = [f"--config.file={file}", f"--storage.tsdb.path={folder / 'data'}"]
        self._process = LoggedProcess(["prometheus", *words, "--web.listen-address=127.0.0.1:0"])
        wait_for(lambda: "is ready to receive" in self._process.log, lambda: self._process.log)
        (self._address,) = set(re.findall(r"127\.0\.0\.1:[1-9]\d*", self._process.log)) - {target}

    def find(self, expression: str) -> list[dict[str, Any]]:
        query = urlencode({"query": expression})
        with urlopen(f"http://{self._address}/api/v1/query?{query}") as answer:
            found: list[dict[str, Any]] = json.load(answer)["data"]["result"]
        return found

    def end(self) -> None:
        self._process.process.terminate()
        self._process.wait()


@pytest.fixture
def prometheus(tmp_path: Path) -> Iterator[Prometheus]:
    if shutil.which("prometheus") is None:
        pytest.skip("there is no Prometheus: sudo apt-get install prometheus")
    bench = Bench(2)
    bench.run(3)
    document = bench.document(clock=ClockFacts(True, 0.01, "rtc-ds3231"))
    file = tmp_path / "status.json"
    stop = threading.Event()

    def refresh() -> None:
        while not stop.wait(0.1):
            document["monotonic_ns"] = time.monotonic_ns()
            part = written(tmp_path / "part", json.dumps(document))
            part.rename(file)

    thread = threading.Thread(target=refresh)
    thread.start()
    words = ("--file", file, "--listen", "127.0.0.1:0")
    metrics = GatewayProcess(None, *words, command="metrics")
    metrics.wait_for_line("/metrics serves")
    (target,) = re.findall(r"http://(\S+)/metrics", metrics.log)
    prometheus = Prometheus(tmp_path, target)
    yield prometheus
    prometheus.end()
    stop.set()
    thread.join()
    metrics.end()


def test_every_expression_returns_data(prometheus: Prometheus) -> None:
    for expression in EXPRESSIONS:
        wait_for(lambda e=expression: prometheus.find(e), expression)  # type: ignore[misc]
    for expression in ALARMS.values():
        without_limit = re.sub(r"\s*(==|<|>)\s*[\d.]+$", "", expression)
        assert without_limit != expression
        wait_for(lambda e=without_limit: prometheus.find(e), without_limit)  # type: ignore[misc]
    assert prometheus.find(ALARMS["EscNotHeard"]) == []


def test_promtool_accepts_the_examples() -> None:
    if shutil.which("promtool") is None:
        pytest.skip("there is no promtool: sudo apt-get install prometheus")
    subprocess.run(["promtool", "check", "rules", FOLDER / "alerts.yml"], check=True)
