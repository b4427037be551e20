from __future__ import annotations

import math

import pytest
import torch

from gausim.benchmark import interact
from gausim.benchmark.harness import Options
from gausim.core import SimState
from gausim.models.rollout.dynamics import SceneDynamics


def test_a_frame_is_divided_into_its_parts() -> None:
    rows = interact.run(Options(torch.device("cpu"), quick=True, rounds=1))
    (case,) = {row.case for row in rows}
    found = {row.metric: row.value for row in rows}
    assert case.startswith("300 kernels") and len(found) == len(rows)
    assert all(math.isfinite(value) and value >= 0 for value in found.values())
    assert found["simulated"] == pytest.approx(1 / found["step"])
    assert found["made one after the other"] < found["simulated"]
    for name in (*interact.GROUPS, "colours", "packing"):
        assert found[name] > 0 and 0 < found[f"{name}, share"] < 1


def test_the_model_is_the_default_one() -> None:
    """What is measured is what `gausim train` trains: the constants here are those of conf/model/gausim.yaml."""
    from gausim.compose.config import compose, instantiate

    scene, model = interact.build(300)
    torch.manual_seed(0)
    trained = instantiate(compose("model/gausim").model.simulator)(scenes=[scene], fps=[interact.FPS])
    shapes = [{name: value.shape for name, value in m.state_dict().items()} for m in (model, trained)]
    assert shapes[0] == shapes[1] and scene.sh_degree == 3
    for name in ("predicted_levels", "rollout", "conserve_momentum", "knows_energy"):
        assert getattr(model, name) == getattr(trained, name), name
    for name in ("features", "head"):
        assert getattr(model.predictor, name) == getattr(trained.predictor, name), name
    state = SimState(scene.means, scene.means * 0.999)
    model.load_state_dict(trained.state_dict())
    first, second = (SceneDynamics(m).rollout(state, 3).positions for m in (model, trained))
    assert torch.equal(first, second)
