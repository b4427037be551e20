from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from helpers import toy_object

from gausim.baselines.references import StaticDynamics
from gausim.core import DataError, RunError, SimState, Trajectory
from gausim.data.objects import ObjectData
from gausim.evaluation.evaluation import evaluate_object, write_evaluation
from gausim.render.reference import ReferenceRenderer
from gausim.results.curves import load_curves
from gausim.results.summary import load_summary, summarise

LINEAR = "linear AR(2) on true states, 8 modes"


pytestmark = pytest.mark.usefixtures("quick_evaluations")


@pytest.fixture(scope="module")
def toy(tmp_path_factory):
    return toy_object.write_toy_object(tmp_path_factory.mktemp("data") / "toy")


@pytest.fixture(scope="module")
def evaluated(toy):
    def half(record):
        full = toy.truth(record.name)
        middle = toy.scene.means + 0.5 * (full.positions - toy.scene.means)
        return Trajectory(middle, full.deformation_gradients, full.rotations, full.unit_of_kernel, full.fps)

    def still(record):
        rest = SimState(toy.scene.means, toy.scene.means)
        return StaticDynamics(toy.scene, fps=24.0).rollout(rest, record.count - 1)

    methods = {"oracle": lambda record: toy.truth(record.name), "half": half, "still": still}
    done: list[str] = []
    curves = evaluate_object(ObjectData(toy.root), toy.scene, methods, ReferenceRenderer(), advance=done.append)
    assert done == ["seq_000", "seq_001"]
    return curves


@pytest.fixture(scope="module")
def rows(evaluated):
    return summarise(evaluated)["rows"]


def test_shapes_of_the_curves(evaluated):
    assert evaluated.values["oracle"]["l2"].shape == (2, 20, 3)
    assert evaluated.values["oracle"]["error_3d"].shape == (2, 20)
    assert set(evaluated.rows) == {"oracle", "half", "still", "static", LINEAR, LINEAR.replace("8", "24")}
    finite = [np.isfinite(v[:, 1:]).all() for row in evaluated.values.values() for v in row.values()]
    assert all(finite) and len(finite) > 20


@pytest.mark.parametrize("split", ["seen", "unseen", "unseen_near"])
def test_the_true_motion_is_right_up_to_eight_bits(rows, split):
    cells = rows["oracle"][split]
    assert cells["points"]["error_3d"]["mean"] < 1e-4
    assert cells["points"]["motion_energy"]["pooled"] == pytest.approx(1.0, abs=1e-5)
    for group in ("train", "heldout"):
        assert cells[group]["l2"]["mean"] < 0.003
        assert cells[group]["psnr"]["mean"] > 50
        assert cells[group]["ssim"]["mean"] > 0.999
        assert cells[group]["motion_energy"]["pooled"] == pytest.approx(1.0, abs=0.02)


def test_masks_of_the_true_motion_overlap_and_those_at_rest_less(evaluated):
    assert evaluated.facts.reference == "static"
    assert evaluated.values["oracle"]["iou"].min() > 0.97
    assert evaluated.values["static"]["iou"][:, 4].max() < 0.97


@pytest.mark.parametrize("split", ["seen", "unseen"])
def test_half_the_motion_has_half_the_3d_error_and_a_quarter_of_the_energy(rows, split):
    cells = rows["half"][split]
    assert cells["points"]["error_3d"]["ratio"] == pytest.approx(0.5, abs=1e-4)
    assert cells["points"]["motion_energy"]["pooled"] == pytest.approx(0.25, abs=1e-4)
    assert 0.2 < cells["train"]["l2"]["ratio"] < 0.8


def test_static_row_is_the_rest_state_in_every_frame(evaluated, toy):
    for metric in ("l2", "l2_foreground", "psnr", "psnr_foreground", "ssim", "error_3d"):
        still, static = evaluated.values["still"][metric], evaluated.values["static"][metric]
        assert np.allclose(still, static, atol=1e-5)
    assert np.nansum(evaluated.values["static"]["image_energy"]) == 0.0
    assert np.nansum(evaluated.values["static"]["point_energy"]) == 0.0
    moved = torch.stack([toy.truth(n).positions - toy.scene.means for n in toy.amplitudes]).norm(dim=-1).mean(-1)
    extent = toy.scene.means.amax(0) - toy.scene.means.amin(0)
    assert evaluated.values["static"]["error_3d"] == pytest.approx((100 * moved / extent.norm()).numpy(), rel=1e-4)
    assert summarise(evaluated)["rows"]["static"]["unseen"]["train"]["l2"]["ratio"] == 1.0


def test_linear_reference_follows_a_linear_motion(rows):
    row = rows[LINEAR]["unseen"]
    assert set(row) == {"points"} and row["points"]["error_3d"]["ratio"] < 1e-3


def test_floor_is_frame_0_of_the_training_views(evaluated):
    floor = summarise(evaluated)["floor"]
    assert floor["l2"]["mean"] == pytest.approx(evaluated.values["static"]["l2"][:, 0, :2].mean())
    assert floor["l2"]["mean"] < 0.003 and floor["psnr"]["mean"] > 50


def test_files_follow_the_schema(evaluated, tmp_path):
    written = write_evaluation(tmp_path / "evaluation", [evaluated], {"name": "toy run"})
    summary = load_summary(tmp_path / "evaluation" / "metrics.json")
    assert summary == written == json.loads((tmp_path / "evaluation" / "metrics.json").read_text())
    entry = summary["objects"]["toy"]
    assert entry["splits"] == {"seen": [0, 8], "unseen": [8, 20], "unseen_near": [8, 18]}
    assert entry["train_views"] == ["cam_0", "cam_1"] and entry["heldout_views"] == ["cam_2"]
    for row in entry["rows"].values():
        for split in row.values():
            for cells in split.values():
                for key, cell in cells.items():
                    assert key in entry["metrics"]
                    assert set(cell) == {"mean", "std", "ratio"} | ({"pooled"} if key == "motion_energy" else set())
    loaded = load_curves(tmp_path / "evaluation" / "metrics.npz")[0]
    assert loaded.facts == evaluated.facts
    for row, metrics in evaluated.values.items():
        for metric, values in metrics.items():
            assert np.array_equal(loaded.values[row][metric], values, equal_nan=True)
    table = (tmp_path / "evaluation" / "table.md").read_text()
    assert "toy: views never trained on" in table and "| 0 | floor |" in table


def test_part_of_the_sequences_and_views(toy):
    methods = {"oracle": lambda record: toy.truth(record.name)}
    data = ObjectData(toy.root)
    curves = evaluate_object(data, toy.scene, methods, ReferenceRenderer(), sequences=["seq_001"], views=["cam_2"])
    assert curves.values["oracle"]["l2"].shape == (1, 20, 1)
    entry = summarise(curves)
    assert entry["floor"] == {} and set(entry["rows"]["oracle"]["seen"]) == {"heldout", "points"}
    with pytest.raises(DataError, match="seq_9"):
        evaluate_object(data, toy.scene, methods, ReferenceRenderer(), sequences=["seq_9"])


def test_unusable_predictions_are_named(toy):
    def short(record):
        return toy.truth(record.name, frames=5)

    def broken(record):
        full = toy.truth(record.name)
        full.positions[7:, 3] = torch.nan
        return full

    data = ObjectData(toy.root)
    with pytest.raises(RunError, match=r"short, seq_000: predicted .*\(5, 36\), expected \(20, 36\)"):
        evaluate_object(data, toy.scene, {"short": short}, ReferenceRenderer())
    with pytest.raises(RunError, match="broken, seq_000: the prediction is not finite from frame 7"):
        evaluate_object(data, toy.scene, {"broken": broken}, ReferenceRenderer())
