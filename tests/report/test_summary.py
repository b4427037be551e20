from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.report_runs import FRAMES, METRICS, make_curves

from gausim.core import RunError
from gausim.results.curves import ImageMetricInfo, ObjectCurves, load_curves
from gausim.results.summary import frame_splits, load_summary, summarise, write_summary
from gausim.results.table import LEGEND, markdown, object_tables


def curves(**changes) -> ObjectCurves:
    """Two sequences, two views (one held out): errors and energies of round numbers."""
    made = make_curves()
    metrics = (METRICS[0], ImageMetricInfo("psnr", "PSNR", 1.0, "dB", True))
    facts = replace(made.facts, name="toy", methods=("ours",), metrics=metrics)
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
    return ObjectCurves(facts, values)


@pytest.mark.parametrize(
    ("frames", "first_unseen", "expected"),
    [
        (60, 16, {"seen": (0, 16), "unseen": (16, 50), "unseen_near": (16, 26), "unseen_all": (16, 60)}),
        (50, 16, {"seen": (0, 16), "unseen": (16, 50), "unseen_near": (16, 26)}),
        (20, 16, {"seen": (0, 16), "unseen": (16, 20), "unseen_near": (16, 20)}),
        (16, 16, {"seen": (0, 16)}),
        # The last third of a recording is one range.
        (60, 42, {"seen": (0, 42), "unseen": (42, 60), "unseen_near": (42, 52)}),
        (90, 63, {"seen": (0, 63), "unseen": (63, 90), "unseen_near": (63, 73)}),
    ],
)
def test_splits(frames, first_unseen, expected):
    assert frame_splits(frames, first_unseen) == expected


def test_cells_by_hand():
    rows = summarise(curves())["rows"]
    seen, unseen = rows["ours"]["seen"], rows["ours"]["unseen"]
    assert seen["train"]["l2"] == pytest.approx({"mean": 0.002, "std": 0.001, "ratio": 0.25})
    assert unseen["heldout"]["l2"] == pytest.approx({"mean": 0.02, "std": 0.01, "ratio": 0.25})
    assert unseen["train"]["psnr"]["ratio"] is None
    assert unseen["points"]["error_3d"] == pytest.approx({"mean": 10.0, "std": 5.0, "ratio": 0.25})
    assert rows["linear"]["unseen"] == {"points": rows["linear"]["unseen"]["points"]}
    assert rows["linear"]["unseen_all"]["points"]["error_3d"]["ratio"] == pytest.approx(0.5)


def test_energy_is_pooled_over_sequences_and_means_are_their_own():
    ours = summarise(curves())["rows"]["ours"]
    pooled = pytest.approx((0.5 * 1 + 1.0 * 9) / 10)
    assert ours["unseen"]["points"]["motion_energy"] == {
        "mean": pytest.approx(0.75), "std": pytest.approx(0.25), "ratio": None, "pooled": pooled
    }  # fmt: skip
    assert ours["seen"]["train"]["motion_energy"]["pooled"] == pytest.approx(0.5)


def test_the_step_into_the_first_unseen_frame_counts_as_unseen():
    changed = curves()
    changed.values["ours"]["point_energy"][:, 16] = 1e6
    rows = summarise(changed)["rows"]["ours"]
    assert rows["unseen"]["points"]["motion_energy"]["pooled"] > 1e3
    assert rows["seen"]["points"]["motion_energy"]["pooled"] == pytest.approx(0.95)


def test_a_shorter_sequence_and_one_without_truth_leave_their_gaps():
    gaps = curves()
    for metrics in gaps.values.values():
        for metric, values in metrics.items():
            values[1, 30:] = np.nan
            if metric in ("error_3d", "point_energy"):
                values[1] = np.nan
    rows = summarise(gaps)["rows"]["ours"]
    assert rows["unseen"]["train"]["l2"]["mean"] == pytest.approx(0.01)  # the mean of sequence means
    assert rows["unseen"]["points"]["error_3d"]["mean"] == pytest.approx(5.0)
    assert rows["unseen"]["points"]["motion_energy"]["pooled"] == pytest.approx(0.5)


def test_still_truth_has_no_ratio_and_the_file_stays_valid_json(tmp_path):
    still = curves()
    still.values["truth"]["point_energy"][:] = 0.0
    still.values["static"]["error_3d"][:] = 0.0
    write_summary(tmp_path / "metrics.json", [still], {})
    cells = load_summary(tmp_path / "metrics.json")["objects"]["toy"]["rows"]["ours"]["unseen"]["points"]
    assert cells["error_3d"]["ratio"] is None
    assert cells["motion_energy"] == {"mean": None, "std": None, "ratio": None, "pooled": None}
    assert "NaN" not in (tmp_path / "metrics.json").read_text()


def test_files_that_are_not_ours_are_refused(tmp_path):
    with pytest.raises(RunError, match="no such file"):
        load_summary(tmp_path / "metrics.json")
    with pytest.raises(RunError, match="cannot be read"):
        load_curves(tmp_path / "metrics.npz")
    np.savez(tmp_path / "metrics.npz", a=np.zeros(3))
    with pytest.raises(RunError, match="holds no array"):
        load_curves(tmp_path / "metrics.npz")


def test_tables_hold_the_numbers(tmp_path):
    summary = write_summary(tmp_path / "metrics.json", [curves()], {"name": "exp/seed_0", "epoch": 3})
    tables = object_tables("toy", summary["objects"]["toy"])
    assert [t.title for t in tables] == [
        "toy: 3D, true points", "toy: training views", "toy: views never trained on",
    ]  # fmt: skip
    points, train, heldout = tables
    assert points.head == ["frames", "row", "3D error [% of diagonal]", "/ static", "motion energy"]
    assert ["unseen 16..49", "ours", "10.00 ± 5.00", "0.250", "0.95"] in points.rows
    assert ["seen 0..15", "linear", "4.00 ± 2.00", "0.500", "1.00"] in points.rows
    assert train.rows[0] == ["0", "floor", "8.00 ± 4.00", "", "20.00 ± 0.00", ""]
    assert ["unseen 16..49", "static", "80.00 ± 40.00", "1.000", "20.02 ± 0.01", "0.00"] in heldout.rows
    text = markdown(summary)
    assert LEGEND in text and "name exp/seed_0, epoch 3" in text and "(0.30, 0.00, 0.40) | 0.50 | 0.90" in text
    for table in tables:
        assert len({len(row) for row in [table.head, *table.rows]}) == 1
