"""From per-frame figures to the long table, by hand."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.report_runs import FRAMES, METRICS, make_curves

from gausim.core import RunError
from gausim.evaluation.evaluation import results_of
from gausim.report.render import LEGEND, evaluation_page
from gausim.results.curves import ImageMetricInfo, ObjectCurves, load_curves
from gausim.results.summary import FLOOR, entries_of, frame_splits
from gausim.results.table import load_results, save_results


def curves() -> ObjectCurves:
    """Two sequences, two views (one held out): errors and energies of round numbers."""
    made = make_curves()
    metrics = (METRICS[0], ImageMetricInfo("psnr", "PSNR", 1.0, "dB", True))
    made.info.methods = ["ours"]
    both_views = made.values["gausim"]["l2"] * [1, 2]
    error = both_views[..., 0]  # (S, F): seen 1e-3 and 3e-3, unseen 5e-3 and 15e-3
    energy = np.full((2, FRAMES), 4.0) * np.array([[1.0], [9.0]])
    energy[:, 0] = np.nan
    values = {
        "ours": {"l2": both_views, "psnr": 30 + both_views, "image_energy": np.stack((energy / 2, energy), -1),
                 "error_3d": error * 1e3, "point_energy": energy * np.array([[0.5], [1.0]])},
        "static": {"l2": 4 * both_views, "psnr": 20 + both_views, "image_energy": np.zeros((2, FRAMES, 2)),
                   "error_3d": error * 4e3, "point_energy": np.zeros((2, FRAMES))},
        "linear": {"error_3d": error * 2e3, "point_energy": energy},
        "truth": {"image_energy": np.stack((energy, energy), -1), "point_energy": energy},
    }  # fmt: skip
    return replace(made, name="toy", values=values, metrics=metrics, costs={})


def figures(made: ObjectCurves, row: str = "ours") -> dict[tuple[str, str, str], tuple[object, float | None]]:
    return {(e.split, e.views, e.metric): (e.value, e.deviation) for e in entries_of(made, 1) if e.row == row}


@pytest.mark.parametrize(("frames", "first_unseen", "expected"), [
    (60, 16, {"seen": (0, 16), "unseen": (16, 50), "unseen_near": (16, 26), "unseen_all": (16, 60)}),
    (50, 16, {"seen": (0, 16), "unseen": (16, 50), "unseen_near": (16, 26)}),
    (16, 16, {"seen": (0, 16)}),
    # The last third of a recording is one range.
    (60, 42, {"seen": (0, 42), "unseen": (42, 60), "unseen_near": (42, 52)}),
])  # fmt: skip
def test_splits(frames, first_unseen, expected):
    assert frame_splits(frames, first_unseen) == expected


def test_figures_are_in_the_units_of_their_metrics():
    found = figures(curves())
    assert found["seen", "train", "l2"] == pytest.approx((2.0, 1.0))  # [1e-3]
    assert found["unseen", "heldout", "l2"] == pytest.approx((20.0, 10.0))
    assert found["unseen", "train", "l2_ratio"] == pytest.approx((0.25, 0.125))
    assert ("unseen", "train", "psnr_ratio") not in found  # one of decibels has no meaning
    assert found["unseen", "points", "error_3d"] == pytest.approx((10.0, 5.0))
    assert found["+1", "points", "error_3d"] == (pytest.approx(10.0), None)
    linear = figures(curves(), "linear")
    assert {views for _, views, _ in linear} == {"points"}
    assert linear["unseen_all", "points", "error_3d_ratio"][0] == pytest.approx(0.5)


def test_energy_is_pooled_and_the_step_into_unseen_frames_counts_as_unseen() -> None:
    found = figures(curves())
    assert found["unseen", "points", "motion_energy"] == (pytest.approx((0.5 * 1 + 1.0 * 9) / 10), None)
    assert found["seen", "train", "motion_energy"][0] == pytest.approx(0.5)
    changed = curves()
    changed.values["ours"]["point_energy"][:, 16] = 1e6
    found = figures(changed)
    assert found["unseen", "points", "motion_energy"][0] > 1e3
    assert found["seen", "points", "motion_energy"][0] == pytest.approx(0.95)


def test_a_shorter_sequence_and_one_without_truth_leave_their_gaps():
    gaps = curves()
    for metrics in gaps.values.values():
        for metric, values in metrics.items():
            values[1, 30:] = np.nan
            if metric in ("error_3d", "point_energy"):
                values[1] = np.nan
    found = figures(gaps)
    assert found["unseen", "train", "l2"][0] == pytest.approx(10.0)  # the mean of sequence means
    assert found["unseen", "points", "error_3d"] == (pytest.approx(5.0), None)
    assert found["unseen", "points", "motion_energy"][0] == pytest.approx(0.5)


def test_still_truth_has_no_ratio_and_undefined_figures_are_no_entries(tmp_path):
    still = curves()
    still.values["truth"]["point_energy"][:] = 0.0
    still.values["static"]["error_3d"][:] = 0.0
    save_results(tmp_path / "metrics.json", results_of([still], {}))
    found = {(e.row, e.views, e.metric) for e in load_results(tmp_path / "metrics.json").table}
    assert ("ours", "points", "error_3d") in found and ("ours", "train", "motion_energy") in found
    assert not {("ours", "points", "error_3d_ratio"), ("ours", "points", "motion_energy")} & found
    assert "NaN" not in (tmp_path / "metrics.json").read_text()


def test_files_that_are_not_ours_are_refused(tmp_path):
    with pytest.raises(RunError, match="no such file"):
        load_results(tmp_path / "metrics.json")
    with pytest.raises(RunError, match="cannot be read"):
        load_curves(tmp_path / "metrics.npz", {"toy": curves().info})
    np.savez(tmp_path / "metrics.npz", a=np.zeros(3))
    with pytest.raises(RunError, match="holds no arrays of"):
        load_curves(tmp_path / "metrics.npz", {"toy": curves().info})
    save_results(tmp_path / "metrics.json", results_of([curves()], {}))
    text = (tmp_path / "metrics.json").read_text()
    for old, new, message in (
        ("gausim.results/1", "gausim.results/0", "field 'schema' is 'gausim.results/0'"),
        ('["ours","method"', '["ours","strange"', "cannot be read"),
        ('"error_3d",null,', '"unknown",null,', "unknown"),
    ):
        (tmp_path / "metrics.json").write_text(text.replace(old, new))
        with pytest.raises(RunError, match=message):
            load_results(tmp_path / "metrics.json")


def test_tables_hold_the_numbers():
    text = evaluation_page(results_of([curves()], {"name": "exp/seed_0", "epoch": 3}))
    points = text.split("### unseen 16..49, 3D, true points")[1].split("###")[0]
    assert "| row | 3D ÷ static | motion energy |" in points and "| ours | **0.250 (± 0.125)** | **0.95** |" in points
    train = text.split("### seen 0..15, training views")[1].split("###")[0]
    assert f"| {FLOOR} | 8.00 (± 4.00) | 20.00 (± 0.00) | |" in train
    assert LEGEND in text and "name exp/seed_0, epoch 3" in text
    assert "colour (0.30, 0.00, 0.40), its norm 0.50; largest l2 of a pixel 0.90." in text
