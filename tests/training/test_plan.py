"""The training plan: what it decides for every recipe, and that a saved configuration states what ran."""

from dataclasses import replace
from typing import Any

import pytest
import yaml
from helpers.simulators import SMALLEST
from omegaconf import OmegaConf

from gausim.cli import train
from gausim.compose.config import compose, instantiate
from gausim.core import ConfigError
from gausim.nn.schedules import CosineSchedule, HalvingSchedule
from gausim.training.module import GausSimModule
from gausim.training.plan import DataFacts, TrainingPlan, WarmStart

HELD, COLD = DataFacts(12, 16, can_warm_start=True), DataFacts(12, 16, can_warm_start=False)
FREE = replace(COLD, free=True)
GROUPS = ("network", "scene", "template", "initial")


def course(plan: TrainingPlan) -> list[tuple[int, list[float]]]:
    """T and the factors of the groups at the beginning of each epoch."""
    assert plan.epochs is not None
    rates = [[round(plan.rate_factor(n, plan.progress(e)), 4) for n in GROUPS] for e in range(plan.epochs)]
    return [(plan.steps(e), own) for e, own in enumerate(rates)]


def cosine(part: float) -> float:
    return CosineSchedule(warmup=0.0, final=0.05).factor(part, 1.0)


@pytest.mark.parametrize(("overrides", "data", "epochs", "steps", "factors"), [
    (["model=gausim"], HELD, 10, {0: 15, 9: 15}, {0: 0.05, 5: cosine(0.5), 9: cosine(0.9)}),
    (["model=gausim"], FREE, 10, {0: 15, 9: 15}, {0: 0.05, 5: cosine(0.5)}),
    (["model=gausim"], COLD, 60, {0: 2, 1: 3, 12: 14, 13: 15, 59: 15}, {0: 0.05, 30: cosine(0.5)}),
    (["model=gausim", "plan.epochs=200"], HELD, 200, {0: 15, 199: 15}, {100: cosine(0.5)}),
    (["model=gausim", "plan.t_start=3"], HELD, 60, {0: 3, 1: 4, 12: 15}, {30: cosine(0.5)}),
    (["model=gausim", "plan.warm_start=null"], HELD, 60, {0: 2, 13: 15}, {30: cosine(0.5)}),
    (["model=gausim_paper"], HELD, 25, {0: 1, 14: 15, 24: 15}, {0: 1, 15: 1, 16: 0.5, 18: 0.25, 24: 0.03125}),
])  # fmt: skip
def test_t_and_rates_of_every_recipe(overrides, data, epochs, steps, factors) -> None:
    plan: TrainingPlan = instantiate(compose(overrides).plan).resolved(data)
    found = course(plan)
    assert len(found) == plan.epochs == epochs and plan.resolved(data) == plan
    assert {epoch: found[epoch][0] for epoch in steps} == steps
    warm = data.can_warm_start and "warm_start=null" not in str(overrides) and overrides != ["model=gausim_paper"]
    assert (plan.warm_start is not None) == warm
    for epoch, factor in factors.items():
        own = factor * (0.2 if warm else 1.0)
        assert found[epoch][1] == pytest.approx([factor, own, own, own], abs=1e-4), epoch


@pytest.mark.parametrize(
    ("frames", "largest", "first"), [(3, 2, [2, 2]), (16, 15, [2, 3, 4]), (42, 41, [2, 5, 8]), (200, 60, [2, 7])]
)
def test_t_grows_to_the_seen_frames_of_longer_videos_in_as_many_epochs(frames, largest, first) -> None:
    plan = TrainingPlan().resolved(DataFacts(3, frames, can_warm_start=False))
    assert plan.t_max == largest == plan.steps(13) and [plan.steps(e) for e in range(len(first))] == first


def test_batches_and_limits_follow_the_data() -> None:
    assert [TrainingPlan().resolved(DataFacts(n, 16, False)).batch_size for n in (1, 7, 40)] == [1, 2, 4]
    assert TrainingPlan().resolved(DataFacts(3, 16, False), ranks=3).batch_size == 3
    with pytest.raises(ConfigError, match=r"plan\.t_max: 16 predicted frames would see frame 16, .*at most 15"):
        TrainingPlan(t_max=16).resolved(HELD)
    timed = TrainingPlan(epochs=10, max_minutes=2.0)
    assert timed.progress(5, 0.5) == 0.5 and timed.progress(5, 1.5) == 0.75 and timed.progress(11, 0) == 1
    assert timed.time_fraction(3.0) == 1 and TrainingPlan().time_fraction(1e9) == 0


@pytest.mark.parametrize(("wrong", "message"), [
    ({"epochs": 0}, r"plan\.epochs: expected at least 1"),
    ({"t_start": 5, "t_max": 4}, r"t_start <= t_max"),
    ({"schedule": "moon"}, r"plan\.schedule: expected cosine, halving or null"),
    ({"clock": "moon"}, r"clock wall or cpu"),
    ({"max_minutes": 0.0}, r"max_minutes > 0"),
])  # fmt: skip
def test_wrong_plans_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        TrainingPlan(**wrong)
    with pytest.raises(ConfigError, match=r"plan\.warm_start\.updates: expected"):
        WarmStart(updates=0)


def test_schedules() -> None:
    halving = HalvingSchedule(first=16, every=2)
    assert [halving.factor(e, 25) for e in (0, 15.9, 16, 17.5, 18, 24)] == [1, 1, 0.5, 0.5, 0.25, 0.5**5]
    stable = CosineSchedule(warmup=2.0, decay=0.25, final=0.1)
    assert [stable.factor(e, 100) for e in (1, 2, 75, 87.5, 100)] == pytest.approx([0.5, 1.0, 1.0, 0.55, 0.1])


@pytest.mark.parametrize("start", [["plan.warm_start=null"],
                                   pytest.param(["plan.warm_start.updates=5"], marks=pytest.mark.slow)])  # fmt: skip
def test_a_saved_configuration_states_what_ran(start, toy, tmp_path, monkeypatch) -> None:
    ran: list[tuple[int, float, dict[str, float]]] = []
    step = GausSimModule.training_step

    def watched(self: GausSimModule, samples: Any, batch_idx: int) -> None:
        step(self, samples, batch_idx)
        rates = {group["name"]: group["lr"] for group in self.trainer.optimizers[0].param_groups}
        done = self.current_epoch + batch_idx / self.trainer.num_training_batches
        ran.append((samples[0].steps, done, rates))

    monkeypatch.setattr(GausSimModule, "training_step", watched)
    quick = [x for x in SMALLEST if "warm_start" not in x]
    more = [
        "model.simulator.template.modes=6", "render=cpu", "logger=none", "trainer.motion_epochs=0", "plan.repeats=1",
    ]  # fmt: skip
    common = [f"data.root={toy}", "model=gausim", *quick, *more, *start, "plan.epochs=3", f"hydra.run.dir={tmp_path}"]
    assert train.main(common) == 0
    saved = yaml.safe_load((tmp_path / "config.yaml").read_text())
    assert saved["plan"]["epochs"] == 3 and saved["plan"]["t_max"] == 7 and saved["plan"]["batch_size"] == 1
    assert (saved["plan"]["warm_start"] is None) == (start == ["plan.warm_start=null"])
    assert saved["plan"]["t_start"] == (2 if saved["plan"]["warm_start"] is None else 7)
    plan: TrainingPlan = instantiate(OmegaConf.create(saved["plan"]))
    rates = {name: saved["optimizer"][f"{name}_lr"] for name in GROUPS}
    assert len(ran) == 6
    for steps, done, found in ran:
        assert steps == plan.steps(int(done))
        expected = {name: rates[name] * plan.rate_factor(name, plan.progress(done)) for name in found}
        assert found == pytest.approx(expected)
