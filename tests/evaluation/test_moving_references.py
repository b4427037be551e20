"""Evaluation of bodies that fall or are moved by hands: which reference, what figures, and how they are printed."""

import json

import numpy as np
import pytest
import torch
from helpers import toy_object

from gausim.core import Trajectory
from gausim.data.objects import ObjectData
from gausim.evaluation.evaluation import evaluate_object, write_evaluation
from gausim.render.reference import ReferenceRenderer

FLOOR, GRAVITY, LANDED = 0.0, 6.0, 8


def moved(toy, shift: torch.Tensor) -> Trajectory:
    """The toy as a rigid body, shifted by (F, 3)."""
    count, identity = len(shift), torch.eye(3).expand(len(shift), 1, 3, 3)
    units = torch.zeros(toy.scene.count, dtype=torch.long)
    assert count == toy.frames
    return Trajectory(toy.scene.means + shift[:, None], identity, identity, units, toy.fps)


def rewrite(toy, facts: dict, shift: torch.Tensor) -> None:
    """Gives the toy other facts, and its sequences another true motion (its pictures stay)."""
    path = toy.root / "dataset.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **facts}))
    for folder in (toy.root / "sequences").iterdir():
        truth = shift[:, None].expand(-1, toy.scene.count, -1)
        np.savez(folder / "ground_truth.npz", displacement=truth.numpy().astype(np.float32))


pytestmark = pytest.mark.usefixtures("quick_evaluations")


@pytest.fixture(scope="module")
def falling(tmp_path_factory):
    """A rigid body that falls for 8 frames and is thrown up again by the floor."""
    toy = toy_object.write_toy_object(tmp_path_factory.mktemp("falling") / "toy")
    t = torch.arange(toy.frames) / toy.fps
    fall = 0.5 * GRAVITY * (t[LANDED] ** 2 - t**2)
    later = t - t[LANDED]
    height = torch.where(later < 0, fall, 1.6 * later - 0.5 * GRAVITY * later**2)
    shift = torch.stack((0.1 * t, torch.zeros_like(t), height), 1)
    facts = {"free": True, "gravity": [0.0, 0.0, -GRAVITY], "train_frames": [0, 11],
             "floor": {"point": [0.0, 0.0, FLOOR], "normal": [0.0, 0.0, 1.0]}}  # fmt: skip
    rewrite(toy, facts, shift)
    data = ObjectData(toy.root)
    oracle = moved(toy, shift)
    methods = {"oracle": lambda record: oracle}
    curves = evaluate_object(data, data.scene(), methods, ReferenceRenderer(), sequences=["seq_000"])
    folder = tmp_path_factory.mktemp("evaluation")
    results = write_evaluation(folder, [curves], {})
    found = {(e.row, e.split, e.metric): e.value for e in results.table if e.views == "points"}
    return shift, results, found, (folder / "table.md").read_text()


def test_a_falling_body_is_compared_with_rigid_flight_and_bounces_by_formula(falling) -> None:
    _, results, found, _ = falling
    assert results.objects["toy"].reference == "ballistic"
    kinds = {entry.row: entry.kind for entry in results.table if entry.metric == "error_3d"}
    assert kinds == {"oracle": "method", "ballistic": "informed"}, "linear references need a rest state"
    # Before the contact and after the last seen frame it is right, for the truth is rigid.
    assert found["ballistic", "unseen_near", "error_3d"] < 0.02
    assert found["ballistic", "seen", "error_3d"] > 0.3, "it stays on the floor, the truth leaves it"
    assert found["oracle", "seen", "error_3d_ratio"] < 1e-3 and found["oracle", "seen", "track_error"] < 1e-2
    assert found["oracle", "seen", "chamfer"] < 1e-2  # [1e-3 scene units]
    shift, _, found, table = falling
    assert found["truth", "bounce", "rise"] == pytest.approx(float(shift[LANDED:, 2].max()), abs=1e-4)
    assert found["truth", "bounce", "height_error"] == 0
    assert found["truth", "bounce", "depth"] == pytest.approx(0, abs=1e-4)
    assert found["oracle", "bounce", "rise_error"] < 0.1  # [%]
    assert "### bounce" in table and "÷ ballistic" in table
    _, _, found, table = falling
    ahead = {split: value for (row, split, _), value in found.items() if row == "ballistic" and split[0] == "+"}
    assert list(ahead) == ["+1", "+2", "+5"] and ahead["+1"] < 1e-3
    assert "| +1 | +2 | +5 |" in table


def test_a_body_in_hands_is_compared_with_following_them(tmp_path):
    toy = toy_object.write_toy_object(tmp_path / "toy")
    shift = torch.zeros(toy.frames, 3)
    shift[:, 1] = 0.2 * torch.sin(0.3 * torch.arange(toy.frames))
    rewrite(toy, {"grip": 0.05}, shift)
    rest = toy.scene.means[toy.scene.pinned]
    for folder in (toy.root / "sequences").iterdir():
        points = (rest + shift[:, None]).numpy()
        np.savez(folder / "hands.npz", points=points, hand=np.zeros(len(rest), dtype=np.int64))
    data, oracle = ObjectData(toy.root), moved(toy, shift)
    methods = {"oracle": lambda record: oracle}
    curves = evaluate_object(data, data.scene(), methods, ReferenceRenderer(), sequences=["seq_000"])
    assert curves.info.reference == "follow hands"
    # One hand carries the whole body: the reference is right.
    assert np.nanmax(curves.values["follow hands"]["error_3d"]) < 1e-3
