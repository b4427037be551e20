"""Run directories as `gausim train` and `gausim evaluate` leave them, with numbers that are easy to recompute."""

import copy
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import yaml

from gausim.evaluation.evaluation import results_of
from gausim.report.layouts import grids
from gausim.report.runs import find_runs
from gausim.report.study import Study, make_study
from gausim.report.write import write_report
from gausim.results.curves import ImageMetricInfo, ObjectCurves, save_curves
from gausim.results.pivot import Grid, cell_texts
from gausim.results.summary import frame_splits
from gausim.results.table import ObjectInfo, save_results

FRAMES, FIRST_UNSEEN = 60, 16
SEQUENCES, VIEWS = ("a", "b"), ("x", "y")
METRICS = (ImageMetricInfo("l2", "l2", 1e3, "1e-3", False), ImageMetricInfo("ssim", "SSIM", 10.0, "1e-1", True))
CONFIG: dict[str, Any] = {
    "data": {"root": "/data/toy", "names": None, "seed": 0}, "model": {"simulator": {"conserve_mass": True}},
    "optimizer": {"network_lr": 0.001}, "ablation": {"name": "none"}, "experiment": {"name": "toy"}, "seed": 0,
    "name": "toy", "output_root": "out",
}  # fmt: skip


def config(ablation: str = "none", seed: int = 0, name: str = "toy") -> dict[str, Any]:
    made = copy.deepcopy(CONFIG)
    made |= {"seed": seed, "name": name, "ablation": {"name": ablation}}
    return made


def write_run(
    folder: Path, settings: dict[str, Any], *, model: str | None = "gausim", finished: bool = True, epochs: int = 3
) -> Path:
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(settings, sort_keys=False))
    (folder / "epochs.csv").write_text("epoch,step\n" + "".join(f"{e},{4 * e}\n" for e in range(1, epochs + 1)))
    if model is not None:
        (folder / ".hydra").mkdir()
        hydra = {"hydra": {"runtime": {"choices": {"model": model, "ablation": "none"}}}}
        (folder / ".hydra" / "hydra.yaml").write_text(yaml.safe_dump(hydra))
    if finished:
        (folder / "FINISHED").write_text("{}")
    return folder


def make_curves(
    error: float = 1.0, *, name: str = "toy_bunny", static: float = 4.0, frames: int = FRAMES
) -> ObjectCurves:
    """l2 of 1e-3 and 3e-3 (by sequence) times ``error`` in seen frames, five times that in unseen ones."""
    info = ObjectInfo(
        splits=frame_splits(frames, FIRST_UNSEEN), methods=["gausim"], sequences=list(SEQUENCES), frames=[frames] * 2,
        fps=24.0, train_views=[VIEWS[0]], heldout_views=[VIEWS[1]], mean_color=(0.3, 0.0, 0.4), max_l2=0.9,
        sources={"root": "/data/toy", "scene": {"file": "scene.ply", "sha256": "5ce7e" * 12},
                 "manifest": {"file": "dataset.json", "sha256": "da7a" * 16}},
        absent={"lpips": "no weights"}, notes={"gausim": []}, film="a in y (held out).",
    )  # fmt: skip
    late = 1 + 4.0 * (np.arange(frames) >= FIRST_UNSEEN)
    l2 = 1e-3 * np.array([1.0, 3.0])[:, None, None] * late[None, :, None] * np.ones(2)
    energy = np.ones((2, frames))
    energy[:, 0] = np.nan
    images = np.stack((energy, energy), -1)
    values = {
        "gausim": {"l2": error * l2, "ssim": 1 - error * l2, "error_3d": 100 * error * l2[..., 0],
                   "point_energy": energy / (1 + error), "image_energy": images / (1 + error)},
        "static": {"l2": static * l2, "ssim": 1 - static * l2, "error_3d": 100 * static * l2[..., 0],
                   "point_energy": 0 * energy, "image_energy": 0 * images},
        "truth": {"point_energy": energy, "image_energy": images},
    }  # fmt: skip
    costs = {"gausim": {
        "seconds_per_frame": 0.01 * error, "seconds_per_image": 0.002,
        "device": "cpu", "threads": 1, "memory": {
            "kind": "process, resident", "peak_bytes": 2.1e9, "added_bytes": 3e6 * error},
        "levels": {"counts": [200, 20, 4], "predicted": [2, 1], "predictions": 20, "kernels": 200},
        "fit": {"seconds": 90.0 * error, "cpu_seconds": 60.0 * error, "peak_bytes": 1.5e9}}}  # fmt: skip
    return ObjectCurves(name, info, values, METRICS, costs)


def evaluate(run: Path, *curves: ObjectCurves, finished: bool = True, commit: str | None = "c0ffee" * 6) -> Path:
    folder = run / "evaluation"
    folder.mkdir()
    state = {"name": "toy", "finished": finished, "epoch": 2, "updates": 12}
    provenance = {"gausim": "0.1.0", "torch": "2", "python": "3", "commit": commit, "modified": False}
    results = msgspec.structs.replace(results_of(list(curves), state), provenance=provenance)
    save_results(folder / "metrics.json", results)
    save_curves(folder / "metrics.npz", list(curves))
    for item in curves:
        if "/" not in item.name:
            (folder / f"film_{item.name}.mp4").write_bytes(b"a film")
    return run


def write_sweep(root: Path) -> Path:
    """Full method with two seeds, three ablations: one measured, one failed, one killed."""
    for seed, error in ((0, 1.0), (1, 1.2)):
        evaluate(write_run(root / "full" / f"seed_{seed}", config(seed=seed)), make_curves(error))
    evaluate(write_run(root / "no_mass" / "seed_0", config("no_mass")), make_curves(1.5))
    failed = write_run(root / "no_hierarchy" / "seed_0", config("no_hierarchy"), finished=False)
    (failed / "FAILED").write_text("Traceback\nRuntimeError: out of memory\n")
    write_run(root / "no_momentum" / "seed_0", config("no_momentum"), finished=False)
    return root


def study_of(root: Path) -> Study:
    return make_study(find_runs([root]))


def grids_of(root: Path) -> dict[str, Grid]:
    """The tables of a report by the beginning of their titles."""
    return {grid.title: grid for grid in grids(study_of(root))}


def shown(grid: Grid) -> dict[str, list[str]]:
    """The texts of a grid by row, the best with a star."""
    return {
        line.label: [" ".join(filter(None, cell_texts(cell, column.digits))) + "*" * best
                     for cell, column, best in zip(line.cells, grid.columns, line.best, strict=True)]
        for line in grid.lines
    }  # fmt: skip


def page_of(root: Path, **options: Any) -> str:
    """The page of all runs below a folder, written to ``report`` in it."""
    write_report([root], root / "report", **options)
    return (root / "report" / "report.html").read_text()
