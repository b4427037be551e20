import numpy as np
import pytest
import torch
from helpers import toy_object

from gausim.baselines.references import static_motion
from gausim.core import RunError, Trajectory
from gausim.data.objects import ObjectData
from gausim.evaluation.evaluation import evaluate_object, results_of, write_evaluation
from gausim.render.reference import ReferenceRenderer
from gausim.results.curves import load_curves
from gausim.results.pivot import Pivot
from gausim.results.summary import FLOOR
from gausim.results.table import load_results

LINEAR, MEMORY = "linear AR(2) on true states, 8 modes", "linear AR(4) on true states"


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
        return static_motion(toy.scene, fps=24.0, steps=record.count - 1)

    methods = {"oracle": lambda record: toy.truth(record.name), "half": half, "still": still}
    done: list[str] = []
    curves = evaluate_object(ObjectData(toy.root), toy.scene, methods, ReferenceRenderer(), advance=done.append)
    assert done == ["seq_000", "seq_001"]
    return curves


@pytest.fixture(scope="module")
def number(evaluated):
    pivot = Pivot(results_of([evaluated], {}))
    return lambda row, split, views, metric: pivot.number(row, ("toy", split, views, metric))


@pytest.mark.parametrize("split", ["seen", "unseen", "unseen_near"])
def test_the_true_motion_is_right_up_to_eight_bits(number, split):
    assert number("oracle", split, "points", "error_3d") < 1e-4
    assert number("oracle", split, "points", "motion_energy") == pytest.approx(1.0, abs=1e-5)
    for group in ("train", "heldout"):
        assert number("oracle", split, group, "l2") < 3  # [1e-3]
        assert number("oracle", split, group, "psnr") > 50
        assert number("oracle", split, group, "ssim") > 9.99  # [1e-1]
        assert number("oracle", split, group, "motion_energy") == pytest.approx(1.0, abs=0.02)


def test_reference_rows_are_right(evaluated, toy, number) -> None:
    assert evaluated.info.reference == "static"
    assert evaluated.values["oracle"]["iou"].min() > 0.97
    assert evaluated.values["static"]["iou"][:, 4].max() < 0.97
    for metric in ("l2", "l2_foreground", "psnr", "psnr_foreground", "ssim", "error_3d"):
        still, static = evaluated.values["still"][metric], evaluated.values["static"][metric]
        assert np.allclose(still, static, atol=1e-5)
    assert np.nansum(evaluated.values["static"]["image_energy"]) == 0.0
    assert np.nansum(evaluated.values["static"]["point_energy"]) == 0.0
    moved = torch.stack([toy.truth(n).positions - toy.scene.means for n in toy.amplitudes]).norm(dim=-1).mean(-1)
    extent = toy.scene.means.amax(0) - toy.scene.means.amin(0)
    assert evaluated.values["static"]["error_3d"] == pytest.approx((100 * moved / extent.norm()).numpy(), rel=1e-4)
    assert number("static", "unseen", "train", "l2_ratio") == 1.0
    assert number(LINEAR, "unseen", "points", "error_3d_ratio") < 1e-3
    assert number(LINEAR, "unseen", "train", "l2") is None
    floor = number(FLOOR, "seen", "train", "l2")
    assert floor == pytest.approx(1e3 * evaluated.values["static"]["l2"][:, 0, :2].mean()) and floor < 3


@pytest.mark.parametrize("split", ["seen", "unseen"])
def test_half_the_motion_has_half_the_3d_error_and_a_quarter_of_the_energy(number, split):
    assert number("half", split, "points", "error_3d_ratio") == pytest.approx(0.5, abs=1e-4)
    assert number("half", split, "points", "motion_energy") == pytest.approx(0.25, abs=1e-4)
    assert 0.2 < number("half", split, "train", "l2_ratio") < 0.8


def test_files_follow_the_schema(evaluated, tmp_path):
    written = write_evaluation(tmp_path / "evaluation", [evaluated], {"name": "toy run", "seed": 3})
    found = load_results(tmp_path / "evaluation" / "metrics.json")
    assert found == written
    info = found.objects["toy"]
    assert info.splits == {"seen": (0, 8), "unseen": (8, 20), "unseen_near": (8, 18)}
    assert info.train_views == ["cam_0", "cam_1"] and info.heldout_views == ["cam_2"]
    kinds = {entry.row: (entry.kind, entry.seed) for entry in found.table}
    assert kinds["half"] == ("method", 3) and kinds["static"] == ("reference", None) and kinds[LINEAR][0] == "informed"
    loaded = load_curves(tmp_path / "evaluation" / "metrics.npz", found.objects)["toy"]
    for row, metrics in evaluated.values.items():
        for metric, values in metrics.items():
            assert np.array_equal(loaded.values[row][metric], values, equal_nan=True)
    table = (tmp_path / "evaluation" / "table.md").read_text()
    assert "### seen 0..7, training views" in table and f"| {FLOOR} |" in table


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
