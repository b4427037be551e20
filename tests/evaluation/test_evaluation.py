import json

import numpy as np
import pytest
import torch
from helpers import toy_object

from benchmarks.reference_renderer import ReferenceRenderer
from gausim.baselines.references import static_motion
from gausim.core import RunError, Trajectory
from gausim.data.objects import ObjectData
from gausim.evaluation.evaluation import evaluate_object, results_of, write_evaluation
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


GROUND, GRAVITY, LANDED = 0.0, 6.0, 8


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
             "floor": {"point": [0.0, 0.0, GROUND], "normal": [0.0, 0.0, 1.0]}}  # fmt: skip
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
