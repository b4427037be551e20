"""A sweep as `gausim train -m` leaves it: NAME/ABLATION/MODEL/OVERRIDES/seed_S, some jobs failed, some missing."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.report_runs import NO_HIERARCHY, config, evaluate, make_curves, write_run

from gausim.report.gather.runs import find_runs
from gausim.report.gather.study import make_study
from gausim.report.tables.overview import make_sheets
from gausim.report.tables.sheets import Sheet

OFF = {
    "none": {}, "no_mass": {"conserve_mass": False}, "no_momentum": {"conserve_momentum": False},
    "no_hierarchy": NO_HIERARCHY,
}  # fmt: skip


def job(root: Path, ablation: str, seed: int, layers: int = 2) -> Path:
    folder = root / ablation / "gausim" / f"experiment=tiny,model.simulator.network.layers={layers}" / f"seed_{seed}"
    settings = config(seed, layers=layers, **OFF[ablation])
    settings["ablation"] = {"name": ablation}
    return write_run(folder, settings, finished=False)


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    root = tmp_path / "outputs" / "tiny"
    for ablation, error in (("none", 1.0), ("no_mass", 1.5), ("no_momentum", 0.9)):
        for seed in (1, 2, 3):
            run = job(root, ablation, seed)
            if (ablation, seed) == ("no_momentum", 2):
                (run / "FAILED").write_text("Traceback ...\ngausim.core.errors.DivergenceError: step 3 is not finite\n")
            else:
                (run / "FINISHED").write_text("{}")
                evaluate(run, make_curves(error + 0.1 * seed))
    for seed in (1, 2):
        (job(root, "no_hierarchy", seed) / "FAILED").write_text("torch.OutOfMemoryError: 80 GB\n")
    for seed in (1, 2):
        (job(root, "none", seed, layers=4) / "FINISHED").write_text("{}")
    return root


def sheets(root: Path) -> dict[str, Sheet]:
    return {sheet.key: sheet for sheet in make_sheets(make_study(find_runs([root])))}


def test_the_ablation_table_pools_seeds_and_shows_what_is_missing(sweep: Path) -> None:
    ablations = sheets(sweep)["ablation_toy_bunny_gausim"]
    ((family, variations),) = ablations.columns
    assert family == "gausim"
    columns = {name: i for i, name in enumerate(variations)}
    assert variations == ("full", "w/o mass", "w/o momentum", "w/o hierarchy", "layers=4")
    line = next(line for line in ablations.lines if line.label == "l2: Unseen 34")
    shown = {name: line.entries[i] for name, i in columns.items()}
    # Means over the two sequences: 10e-3 times 1.1, 1.2, 1.3; deviation of the seeds 1e-3.
    assert shown["full"].text == "12.00 ± 6.01" and shown["full"].extra == "± 1.00, 3 seeds"
    assert shown["w/o momentum"].text == "11.00 ± 5.52" and shown["w/o momentum"].extra == "± 1.41, 2 seeds"
    assert shown["w/o hierarchy"].text == "failed" and shown["w/o hierarchy"].missing
    assert shown["layers=4"].text == "not evaluated"
    assert [name for name, e in shown.items() if e.best] == ["w/o momentum"]
    assert "motion energy, 3D: Unseen 44" in {line.label for line in ablations.lines}
    change = next(line for line in ablations.lines if line.label == "l2: Unseen 34, against full")
    # 17 against 12, each with a deviation of 1 over three seeds: 5 / sqrt(2 / 3).
    assert change.entries[columns["w/o mass"]].text == "+41.7 %"
    assert change.entries[columns["w/o mass"]].extra == "+6.1 σ"


def test_a_list_of_ablations_is_named_by_all_its_parts(tmp_path: Path) -> None:
    for name, off in (
        ("none", {}),
        ("no_mass+relu", OFF["no_mass"]),
        ("no_mass+no_momentum", OFF["no_mass"] | OFF["no_momentum"]),
    ):
        settings = config(1, **off)
        settings["ablation"] = {"name": name}
        evaluate(write_run(tmp_path / name / "gausim" / "seed_1", settings), make_curves())
    assert sheets(tmp_path)["ablation_toy_bunny_gausim"].columns == (
        ("gausim", ("full", "w/o mass, w/o momentum", "w/o mass, relu")),
    )
