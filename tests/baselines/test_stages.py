"""Stages as data: which one, how many frames and what rate at any time; what a plan refuses."""

from collections.abc import Callable

import pytest

from gausim.baselines.stages import FitPlan, Stage
from gausim.core import ConfigError
from gausim.losses.mixed import MixedLoss
from gausim.nn.schedules import ExponentialSchedule, HalvingSchedule, LinearSchedule


def stage(iterations: int = 10, **options: object) -> Stage:
    return Stage(iterations, {"a": 0.1}, MixedLoss(l1=1.0), **options)  # type: ignore[arg-type]


def test_epochs_walk_through_stages_with_their_windows_and_rates() -> None:
    plan = FitPlan({"first": stage(10), "left": None, "second": stage(20)}, round=5)
    assert plan.shows == 5 and plan.epochs == 6
    places = [(name, done) for name, _, done in (plan.place(e) for e in (0, 1, 1.5, 2, 5, 6, 7))]
    assert places == [("first", 0), ("first", 5), ("first", 7.5), ("second", 0), ("second", 15),
                      ("second", 20), ("second", 20)]  # fmt: skip
    assert FitPlan({"short": stage(3), "long": stage(7)}, round=5).shows == 3
    plan = FitPlan({"few": stage(5, frames=[2, 2]), "more": stage(20, frames=[4, 0])}, round=5)
    assert [plan.steps(float(epoch), 10) for epoch in range(5)] == [2, 4, 6, 8, 10]
    schedules = {"default": HalvingSchedule(100, 100), "b": ExponentialSchedule(0.01)}
    made = Stage(300, {"a": 1e-3, "b": 1e-2}, MixedLoss(l1=1.0), schedules=schedules)
    assert [made.rate("a", i) for i in (0, 99, 100, 250)] == [1e-3, 1e-3, 5e-4, 2.5e-4]
    assert made.rate("b", 150) == pytest.approx(1e-3) and made.rate("b", 300) == pytest.approx(1e-4)
    assert made.rate("c", 0) == 0
    assert [LinearSchedule(0.5).factor(i, 10) for i in (0, 5, 20)] == [1, 0.75, 0.5]


@pytest.mark.parametrize(("wrong", "said"), [
    (lambda: stage(0), "iterations >= 1"),
    (lambda: stage(frames=[3]), "frames as two numbers"),
    (lambda: FitPlan({"only": stage()}).check({"b": []}, []), r"only\.rates: \['a'\] asked for; .* has \['b'\]"),
    (lambda: FitPlan({"only": stage(penalties={"rough": 1.0})}).check({"a": []}, ["smooth"]), r"\['rough'\]"),
    (lambda: FitPlan({}, round=0), "model.plan.round"),
])  # fmt: skip
def test_wrong_stages_are_refused(wrong: Callable[[], object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        wrong()
