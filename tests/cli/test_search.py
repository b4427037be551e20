"""A search by Optuna that is killed goes on with what it would have tried undisturbed; each trial is trained once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers.sweeps import Sweeps, dying, history, write_toy_object
from hydra.core.override_parser.overrides_parser import OverridesParser
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution

from gausim.cli import train as command
from gausim.cli.sweeps.optuna import distribution
from gausim.core import ConfigError

RATES = (
    "hydra/sweeper=optuna",
    "optimizer.network_lr=tag(log,interval(1e-4,1e-1))",
    "model.simulator.network.layers=range(1,3)",
)
FINISH = "gausim.runs.directory.RunDirectory.finish"


def results(do: Sweeps, name: str) -> dict[str, Any]:
    return yaml.safe_load((do.folder / name / "optimization_results.yaml").read_text())


def tried(do: Sweeps, name: str) -> list[tuple[str, dict[str, Any], float]]:
    return [(t["state"], t["params"], t["value"]) for t in results(do, name)["trials"]]


@pytest.mark.slow
def test_a_killed_search_goes_on_with_what_it_would_have_tried(do: Sweeps) -> None:
    few = (*RATES, "hydra.sweeper.n_trials=4", "hydra.sweeper.sampler.n_startup_trials=1")
    status, output = do("whole", *few)
    assert status == 0, output
    assert len({str(params) for _, params, _ in tried(do, "whole")}) == 4
    # In the third trial, trained but not marked as finished; then after it was told, before the fourth is chosen.
    assert do("cut", *few, **dying(FINISH, 3))[0] == -9
    assert [state for state, _, _ in tried(do, "cut")] == ["complete"] * 2
    assert do("cut", *few, **dying("gausim.cli.sweeps.optuna.Search._ready", 2))[0] == -9
    assert [state for state, _, _ in tried(do, "cut")] == ["complete"] * 3
    status, output = do("cut", *few)
    assert status == 0, output
    assert tried(do, "cut") == tried(do, "whole")
    runs = [history(Path(t["directory"])) for t in results(do, "cut")["trials"]]
    assert runs == [["started", "finished"]] * 2 + [["started", "resumed", "finished"], ["started", "finished"]]
    best = results(do, "cut")
    assert best["best_value"] == min(value for _, _, value in tried(do, "cut"))
    assert f"best: trial {best['best_trial']}," in output and (Path(best["best_directory"]) / "FINISHED").exists()
    assert best["best_params"] == best["trials"][best["best_trial"]]["params"]
    # Nothing is left; more trials are; another search in the same storage is refused.
    status, output = do("cut", *few)
    assert status == 0 and "nothing left to do" in output
    status, output = do("cut", *few, "model.simulator.network.layers=range(1,4)")
    assert status == 2 and "changed: model.simulator.network.layers" in output
    status, output = do("cut", *few, "loss.static_weight=2")
    assert status == 2 and "changed: fixed" in output and len(tried(do, "cut")) == 4


@pytest.mark.slow  # that jobs of a sweep are tried again is a default test of test_sweep.py
def test_a_trial_that_fails_stops_no_other_and_is_tried_again_on_demand(do: Sweeps, tmp_path: Path) -> None:
    late = tmp_path / "late"
    search = ("hydra/sweeper=optuna", f"data.root=choice({late},{do.folder}/toy)",
              "hydra.sweeper.n_trials=3", "hydra.sweeper.n_jobs=3", "hydra.sweeper.seed=1", "data.repeats=1",
              "trainer.max_epochs=1")  # fmt: skip
    status, output = do("mixed", *search)
    states = [state for state, _, _ in tried(do, "mixed")]
    assert status == 2 and {"fail", "complete"} == set(states), output
    # Trials that try the same are one job.
    assert "sweep of 2 jobs: 1 trained, 1 failed" in output and f"DataError: {late}: no data set here" in output
    write_toy_object(late, frames=8)
    status, output = do("mixed", *search, "sweep.retry_failed=true")
    assert status == 0, output
    later = tried(do, "mixed")[3:]
    assert [state for state, _, _ in later] == ["complete"] * states.count("fail")
    assert all(params == {"data.root": str(late)} for _, params, _ in later)


@pytest.mark.slow
def test_poor_trials_are_ended_early(do: Sweeps) -> None:
    pruner = "hydra.sweeper.pruner={_target_:optuna.pruners.ThresholdPruner,upper:0.0,n_warmup_steps:2}"
    search = (*RATES, "hydra.sweeper.n_trials=2", pruner, "trainer.max_epochs=4", "evaluate=true")
    # Killed once it was decided, before the run was marked as finished: the decision stays.
    assert do("pruned", *search, **dying(FINISH, 1))[0] == -9
    status, output = do("pruned", *search)
    assert status == 0 and "sweep of 2 jobs: 2 pruned" in output, output
    assert [state for state, _, _ in tried(do, "pruned")] == ["pruned"] * 2
    for trial in results(do, "pruned")["trials"]:
        run = Path(trial["directory"])
        assert '"pruned": true' in (run / "FINISHED").read_text() and not (run / "evaluation").exists()
        assert len((run / "epochs.csv").read_text().splitlines()) == 1 + 2
    status, output = do("pruned", *search, "trainer.devices=2", "hydra.sweeper.n_trials=3")
    assert status == 2 and "hydra.sweeper.pruner: expected trainer.devices=1" in output, output


def test_what_cannot_be_searched_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="nothing to search"):
        command.main(["-m", "hydra/sweeper=optuna", "seed=1"])
    with pytest.raises(ConfigError, match="n_trials >= 1"):
        command.main(["-m", *RATES, "hydra.sweeper.n_trials=0"])
    with pytest.raises(ConfigError, match=r"_target_: expected something from .*'os\.system'"):
        command.main(["-m", *RATES, "hydra.sweeper.sampler._target_=os.system"])
    assert not list(tmp_path.rglob("seed_*"))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("k=interval(1,5)", FloatDistribution(1.0, 5.0)),
        ("k=int(interval(1,5))", IntDistribution(1, 5)),
        ("k=tag(log,interval(1e-4,1))", FloatDistribution(1e-4, 1.0, log=True)),
        ("k=tag(log,int(interval(1,64)))", IntDistribution(1, 64, log=True)),
        ("k=range(1,4)", IntDistribution(1, 3)),
        ("k=range(8,1,-2)", IntDistribution(2, 8, step=2)),
        ("k=range(0.5,2,0.5)", FloatDistribution(0.5, 1.5, step=0.5)),
        ("k=choice(a,2,true)", CategoricalDistribution(["a", "2", "True"])),
        ("k=null,'a b'", CategoricalDistribution(["null", "'a b'"])),
    ],
)
def test_hydras_notation_becomes_optunas_distributions(text: str, expected: BaseDistribution) -> None:
    found = distribution(OverridesParser.create().parse_override(text))
    assert found == expected


@pytest.mark.slow
def test_a_search_through_joblib(do: Sweeps) -> None:
    side_by_side = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2")
    search = (*RATES, "hydra.sweeper.n_trials=4", "hydra.sweeper.n_jobs=2")
    assert do("alone", *search)[0] == 0
    status, output = do("joblib", *search, *side_by_side)
    assert status == 0, output
    assert tried(do, "joblib") == tried(do, "alone")
