"""The diagnosis of motions, and the growth of small ones."""

import json
import math
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from helpers import toy_object
from helpers.simulators import gausim

import gausim.evaluation.stability as stability
from gausim.core import SimState
from gausim.models.step.simulator import GausSim
from gausim.models.template.elastic import ElasticTemplate
from gausim.pictures.figures import diagnosis_figure, diagnosis_plot
from gausim.results.curves import TRUTH
from gausim.results.diagnosis import Diagnosis, read_diagnosis
from gausim.results.table import ObjectInfo

FPS, FRAMES = 24.0, 61
REST = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
BEND, TWIST = REST[:, 2:] ** 2 * torch.tensor([1.0, 0, 0]), (REST - 0.5).cross(torch.tensor([[0.0, 0, 1]]), dim=-1)


def motion(frequency: float, damping: float, lag: float = 0.0, size: float = 0.1) -> torch.Tensor:
    """Bending with one damped oscillation and a smaller twist at a third of its frequency more."""
    t = torch.arange(FRAMES) / FPS
    omega = 2 * math.pi * frequency
    decay = torch.exp(-omega * damping / math.sqrt(1 - damping**2) * t)
    wave = decay * torch.sin(omega * t - lag)
    other = 0.1 * torch.sin(omega * 4 / 3 * t - lag)
    return REST + size * (wave[:, None, None] * BEND + other[:, None, None] * TWIST)


def made_of(**rows: torch.Tensor) -> dict[str, Any]:
    diagnosis = Diagnosis(FPS)
    for scale in (1.0, -0.6):
        scaled = {name: REST + scale * (points - REST) for name, points in rows.items()}
        diagnosis.add(REST + scale * (motion(2.0, 0.05) - REST), REST, scaled)
    found = diagnosis.summary()
    assert found is not None
    return found


def test_what_differs_is_told_and_nothing_else() -> None:
    made = made_of(same=motion(2.0, 0.05), slow=motion(1.8, 0.05), damped=motion(2.0, 0.1), late=motion(2.0, 0.05, 0.4),
                 still=REST.expand(FRAMES, -1, -1))  # fmt: skip
    found = read_diagnosis(json.loads(json.dumps(made)), 16)  # it is written to a file
    assert found is not None
    assert len(found.fraction) == 2 and sum(found.fraction) == pytest.approx(1, abs=1e-5)
    assert found.frequency_error("same") < 1e-4 and found.damping_ratio("same") == pytest.approx(1, abs=1e-3)
    assert found.phase("same", seen=True) < 0.1 and found.rows["same"].velocity_cosine == pytest.approx(1)
    assert found.frequency_error("slow") == pytest.approx(0.1, abs=0.01)
    assert found.phase("slow", seen=False) > 2 * found.phase("slow", seen=True) > 4
    assert found.damping_ratio("damped") == pytest.approx(2, rel=0.1)
    assert found.phase("late", seen=True) == pytest.approx(math.degrees(0.4), rel=0.25)
    assert found.rows["still"].velocity_cosine is None and np.isnan(found.phase("still", seen=True))
    peak = found.frequency[np.argmax(found.rows[TRUTH].spectrum)]
    assert peak == pytest.approx(2.0, abs=0.3)


def test_errors_are_told_by_level() -> None:
    truth, rest = motion(2.0, 0.05), REST
    large, small = torch.arange(50) // 10, torch.arange(50) // 2
    wobble = 0.05 * torch.tensor([1.0, -1.0]).repeat(25)[:, None] * torch.ones(3)
    diagnosis = Diagnosis(FPS)
    predicted = truth + wobble  # pairs stay where they are, their points do not
    own = {"a": [torch.arange(50), small, large]}
    diagnosis.add(truth, rest, {"a": predicted, "flat": truth}, own)
    diagnosis.add(truth, rest, {"a": predicted, "flat": truth}, own)
    row = diagnosis.summary()["rows"]["a"]
    still = (truth - rest).norm(dim=-1).mean()
    assert row["level_errors"][0] == pytest.approx(0.05 * math.sqrt(3) / float(still), rel=1e-4)
    assert row["level_errors"][1] < 1e-5 and row["level_errors"][2] < 1e-5
    assert "level_errors" not in diagnosis.summary()["rows"]["flat"]
    found = read_diagnosis(diagnosis.summary(), 16)
    assert found is not None and found.rows["a"].level_errors[0] > 1e3 * found.rows["a"].level_errors[-1]
    assert found.rows["flat"].level_errors == []


def test_pictures_are_drawn_and_damaged_entries_are_not(tmp_path: Path) -> None:
    made = made_of(gausim=motion(1.9, 0.1), reference=motion(2.0, 0.2))
    info = ObjectInfo(splits={"seen": (0, 16)}, methods=["gausim"], diagnosis=made)
    assert diagnosis_figure("toy", info, tmp_path / "motion.png")
    assert (tmp_path / "motion.png").stat().st_size > 10_000
    found = read_diagnosis(made, 16)
    assert found is not None
    left, right = diagnosis_plot([("ours", found, "gausim")], title="t").axes
    assert [line.get_label() for line in left.lines] == [TRUTH, "ours", "reference"]
    np.testing.assert_allclose(right.lines[0].get_ydata(), found.rows["gausim"].phase_error)
    for damage in (
        None,
        {"rows": []},
        {**made, "share": "long"},
        {**made, "rows": {"gausim": made["rows"]["gausim"]}},
        {**made, "rows": {TRUTH: {"spectrum": [1.0], "frequencies": [{}]}}},
    ):
        assert read_diagnosis(damage, 16) is None
        assert not diagnosis_figure("toy", msgspec.structs.replace(info, diagnosis=damage), tmp_path / "no.png")
    assert not (tmp_path / "no.png").exists()


def _model(**options: object) -> GausSim:
    torch.manual_seed(0)
    template = partial(ElasticTemplate, modes=9, neighbours=6)
    settings = {"radii": (0.3, 0.7), "hidden": 8, "layers": 1, "edges": "rest", "template": template}
    return gausim([toy_object.toy_scene()], [24.0], **(settings | options))


def test_without_a_network_it_is_that_of_the_template_s_matrices() -> None:
    model = _model(zero_output=True)
    with torch.no_grad():
        model.template.scenes[0].damping.fill_(-0.5)
        part = model.modal_scene(0)
        inertia, stiffness, damping = part.inertia, part.stiffness, part.damping
    inverse = torch.linalg.inv(inertia + stiffness / 4 + damping / 2)
    now, before = inverse @ (2 * inertia - stiffness / 2), inverse @ (inertia + stiffness / 4 - damping / 2)
    step = torch.cat((torch.cat((now, -before), 1), torch.eye(9, 18)))
    expected = float(torch.linalg.eigvals(step).abs().max())
    assert expected < 0.9999
    assert stability.largest_eigenvalue(model, 0) == pytest.approx(expected, abs=1e-4)


def test_it_is_the_growth_of_a_small_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    model = _model(output_scale=0.3, anchor=True).train()
    batch = model.batch([0])
    with torch.no_grad():
        model.step(batch, SimState(batch.rest, batch.rest))  # gathers statistics of the inputs
    found = stability.largest_eigenvalue(model, 0)
    assert model.training
    monkeypatch.setattr(stability, "DENSE", 0)
    assert stability.largest_eigenvalue(model, 0) == pytest.approx(found, abs=1e-4)
    model.eval()
    draw = torch.randn(batch.rest.shape, generator=torch.Generator().manual_seed(0))
    state = SimState(batch.rest, batch.rest + 1e-4 * draw)
    logs, small, prepared = [], 1e-4, model.prepare(batch)
    with torch.no_grad():
        for _ in range(300):
            after = model.step(batch, state, prepared=prepared).positions
            factor = small / float(torch.stack((after - batch.rest, state.positions - batch.rest)).abs().max())
            state = SimState(
                batch.rest + factor * (after - batch.rest), batch.rest + factor * (state.positions - batch.rest)
            )
            logs.append(-torch.tensor(factor).log())
    # The motion turns as it grows, so a mean with equal weights depends on where in a turn it begins and ends.
    weights = torch.hann_window(240, periodic=False)
    mean = (torch.stack(logs[60:]) * weights).sum() / weights.sum()
    assert float(mean.exp()) == pytest.approx(found, abs=5e-3)
