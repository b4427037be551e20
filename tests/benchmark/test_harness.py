from __future__ import annotations

import importlib
import json
import sys
import time
import types

import pytest
import torch

from gausim.benchmark import data
from gausim.benchmark.harness import Options, Row, medians, peak_saved_bytes, spent_in
from gausim.cli import benchmark
from gausim.core import ConfigError

QUICK = Options(torch.device("cpu"), quick=True, rounds=3)


def test_candidates_are_called_in_turn_and_warm_up_is_not_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    result = medians({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, QUICK, warmup=2)
    assert calls == ["a", "b"] * 5
    assert set(result) == {"a", "b"} and all(value >= 0 for value in result.values())
    calls.clear()
    monkeypatch.setattr(time, "perf_counter", lambda: len(calls) * 0.01)
    assert medians({"c": lambda: calls.append("c")}, QUICK, at_least=0.035) == {"c": pytest.approx(0.01)}
    assert len(calls) == 1 + 3 * 3  # three in a row, after one that warms up


def test_peak_counts_what_is_held_at_one_time() -> None:
    x = torch.rand(1000, requires_grad=True)

    def together() -> None:
        (x.exp().sum() + x.sin().exp().sum()).backward()

    def in_turn() -> None:
        for _ in range(5):
            x.exp().sum().backward()

    assert peak_saved_bytes(in_turn) == 4000  # the result of exp, once
    assert peak_saved_bytes(together) == 3 * 4000  # x for sin, and both results of exp
    assert peak_saved_bytes(lambda: (x * x).sum()) == 4000  # x twice, the same storage
    with torch.no_grad():
        assert peak_saved_bytes(lambda: (x * x).sum()) == 0


def test_time_is_told_by_part_and_functions_are_themselves_again() -> None:
    own = QUICK.__class__.__init__
    with spent_in({"options": [(Options, "__init__")], "sleep": [(time, "sleep")]}, QUICK.device) as seconds:
        time.sleep(0.02)
        assert Options(QUICK.device).rounds == 7
    assert seconds["sleep"] >= 0.02 > seconds["options"] > 0 and Options.__init__ is own


def test_json_is_one_object_on_stdout(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    case = types.ModuleType("gausim.benchmark.cluster")
    case.run = lambda options: [Row("2k kernels", "time", 0.5, "s"), Row("2k kernels", "ratio", 3.0, "x", "scipy")]
    monkeypatch.setitem(sys.modules, case.__name__, case)
    assert benchmark.main(["cluster", "--json", "--quick", "--rounds", "1"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert set(document) == {"machine", "rows"} and "quick" in document["machine"]["sizes"]
    assert document["rows"][1] == {
        "case": "2k kernels", "metric": "ratio", "value": 3.0, "unit": "x", "reference": "scipy"
    }  # fmt: skip


@pytest.mark.parametrize("device", ["nonsense", "cuda:7"])
def test_a_missing_device_is_refused(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match="--device"):
        benchmark.main(["cluster", "--quick", "--device", device])


def test_packed_frames_are_compared_with_images() -> None:
    found = {(row.metric, row.unit): row.value for row in data.run(QUICK)}
    assert found["packed", "x"] == pytest.approx(found["packed", "images/s"] / found["image files", "images/s"])
    assert 0 < found["stored", "1"] < 0.5 and found["opening", "s"] > 0


def test_the_command_has_every_case() -> None:
    assert all(callable(importlib.import_module(f"gausim.benchmark.{name}").run) for name in benchmark.CASES)
