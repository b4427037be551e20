"""From motions known by formula to the numbers and pictures of the diagnosis."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

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
