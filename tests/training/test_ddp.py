"""Several ranks do together what one rank does with all sequences (see rank_checks.py for what runs in them)."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from helpers.toy_runs import Trainings

# The static loss is one rank's: all that could depend on which rank computes a sequence.
ALL = {"static_probability": 1.0}

Ask = Callable[..., list[Any]]


@pytest.fixture(scope="module")
def ask(trainings: Trainings) -> Ask:
    """Asks for a check in so many ranks; returns what each found."""
    return lambda check, ranks, **options: trainings.ask(check=check, ranks=ranks, options=options)


def distance(found: dict[str, Any], expected: dict[str, Any]) -> float:
    """Norm of the difference over the norm of what is expected; both lack the same entries."""
    assert {n for n, v in found.items() if v is None} == {n for n, v in expected.items() if v is None}
    pairs = [(np.array(found[n]), np.array(v)) for n, v in expected.items() if v is not None]
    return float(np.sqrt(sum(((a - b) ** 2).sum() for a, b in pairs) / sum((b**2).sum() for _, b in pairs)))


def assert_as_one(found: list[Any], alone: Any, tolerance: float, rounding: float = 1e-4) -> None:
    assert all(isinstance(answer, dict) for answer in (*found, alone)), (found, alone)
    for name in ("weights", "stats", "statistics", "baselines"):
        assert all(rank[name] == found[0][name] for rank in found), f"{name} differ between ranks"
    assert distance(found[0]["grads"], alone["grads"]) <= tolerance
    assert distance(found[0]["statistics"], alone["statistics"]) <= tolerance
    assert found[0]["baselines"] == alone["baselines"]
    for mine, theirs in zip(found[0]["stats"], alone["stats"], strict=True):
        assert mine == pytest.approx(theirs, rel=rounding, abs=1e-12)


@pytest.mark.parametrize(("dtype", "tolerance"), [("float32", 1e-6), ("float64", 1e-12)])
def test_the_gradient_of_a_step_is_that_of_one_rank(ask: Ask, dtype: str, tolerance: float) -> None:
    alone = ask("train", 1, count=5, dtype=dtype, objective=ALL)[0]
    assert alone["grads"]["initial_states.offset.5"] is None and alone["grads"]["initial_states.offset.4"] is not None
    assert_as_one(ask("train", 2, count=5, dtype=dtype, objective=ALL), alone, tolerance)


@pytest.mark.parametrize(("ranks", "options", "tolerance"), [
    (2, {"count": 5, "times": 3, "objective": {**ALL, "backprop_steps": 2}}, 1e-9),  # steps follow each other
    (3, {"count": 1, "times": 2, "objective": ALL}, 1e-9),  # ranks without a sequence
    (2, {"count": 3, "objective": {"backprop_steps": 0}}, 1e-11),
    (2, {"count": 3, "objective": {"momentum_weight": 0.0}}, 1e-11),
])  # fmt: skip
def test_ranks_learn_what_one_does(ask: Ask, ranks: int, options: dict[str, Any], tolerance: float) -> None:
    found, alone = (ask("train", n, dtype="float64", **options) for n in (ranks, 1))
    assert_as_one(found, alone[0], tolerance)


@pytest.mark.parametrize(("limit", "ends"), [(0.3, "in between"), (1e-4, "at once")])
def test_a_rollout_ends_on_all_ranks_where_it_ends_on_one(ask: Ask, limit: float, ends: str) -> None:
    options = {"count": 3, "dtype": "float64", "steps": 5, "wild": 2.2,
               "objective": {"explosion": limit, "static_probability": 1.0}}  # fmt: skip
    alone = ask("train", 1, **options)[0]
    assert alone["stats"][0]["exploded"] == 1.0
    assert ("loss_image" in alone["stats"][0]) == (ends != "at once")
    assert_as_one(ask("train", 2, **options), alone, 1e-9)


def test_metrics_of_an_uneven_set_are_those_of_all_of_it(ask: Ask) -> None:
    (alone,) = ask("metrics", 1, count=5)
    for ranks in (2, 4, 6):  # of six, one has no image
        assert ask("metrics", ranks, count=5) == [pytest.approx(alone, rel=1e-12)] * ranks


def test_ranks_that_die_fail_or_drift_apart_are_noticed(ask: Ask) -> None:
    found = ask("fail", 3)
    assert found[1] is None and all("gloo" in answer for answer in (found[0], found[2]))
    value, other = ask("first", 2)
    assert value.startswith("one answer; ValueError: from ")
    assert other.startswith("one answer; RunError: rank 1: the first rank")
    found = ask("drifted", 4)
    assert all("weights: expected the same on all ranks" in text and "ranks [2, 3]" in text for text in found)
    expected = r"training diverged at predicted step 1 of 3, sequence toy/seq_0: positions are nan"
    found = ask("train", 2, count=3, wild=1e30)
    assert all(expected in answer["error"] for answer in found) and found[0] == found[1]
