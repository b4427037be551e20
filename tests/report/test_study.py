from __future__ import annotations

import html
import json
import re
from pathlib import Path

import pytest
from helpers.report_runs import config, evaluate, make_curves, page_of, study_of, write_run

from gausim.report.media import error_curves
from gausim.report.opening import MOST_OPENINGS, make_openings
from gausim.report.runs import find_runs
from gausim.report.study import EFFECT, EFFECT_SIGMA, Study
from gausim.results.table import Cell


def l2(study: Study, row: str, name: str = "toy_bunny", split: str = "seen") -> Cell | None:
    return study.pivot.cell(row, (name, split, "train", "l2"))


def states(root: Path) -> dict[str, str]:
    return {run.name: run.status for run in find_runs([root])}


def test_every_state_of_a_run_is_told_apart(sweep):
    write_run(sweep / "later" / "seed_0", config(name="later"))
    (sweep / "dead" / ".hydra").mkdir(parents=True)
    (sweep / "dead" / ".hydra" / "config.yaml").write_text("model: {}\nseed: 3\ndata: {}\n")
    (sweep / ".hydra").mkdir()  # of the whole sweep: no run of its own
    (sweep / ".hydra" / "config.yaml").write_text("seed: 0\n")
    assert states(sweep) == {
        "dead": "failed", "full/seed_0": "evaluated", "full/seed_1": "evaluated", "later/seed_0": "not evaluated",
        "no_mass/seed_0": "evaluated", "no_momentum/seed_0": "unfinished", "no_hierarchy/seed_0": "failed",
    }  # fmt: skip
    details = {run.name: run.detail for run in find_runs([sweep])}
    assert details["no_hierarchy/seed_0"] == "RuntimeError: out of memory"
    assert "epoch 3" in details["no_momentum/seed_0"] and "before training" in details["dead"]
    assert "gausim evaluate" in details["later/seed_0"]


def test_runs_are_found_once_and_the_report_is_not_searched(sweep):
    write_run(sweep / "report" / "copy", config(name="copy"))
    assert len(find_runs([sweep, sweep / "full", sweep / "full" / "seed_0"], skip=sweep / "report")) == 5
    names = [run.name for run in find_runs([sweep / "full", sweep / "no_mass"])]
    assert names == ["full/seed_0", "full/seed_1", "no_mass/seed_0"]
    assert [run.name for run in find_runs([sweep / "full" / "seed_1"])] == ["seed_1"]


@pytest.mark.parametrize(("file", "text", "message"), [
    ("config.yaml", "a: [", "cannot be read as YAML"),
    ("config.yaml", "a: !!python/object/apply:os.mkdir [boom]", "cannot be read as YAML"),
    ("evaluation/metrics.json", '{"schema": "other"}', "schema"),
    ("evaluation/metrics.json", '{"schema": "gausim.results/1", "run": 3}', "at `$.run`"),
])  # fmt: skip
def test_broken_files_are_a_state_and_nothing_in_them_runs(sweep, monkeypatch, file, text, message):
    monkeypatch.chdir(sweep)
    (sweep / "full" / "seed_0" / file).write_text(text)
    (broken,) = [run for run in find_runs([sweep]) if run.name == "full/seed_0"]
    assert broken.status == "broken files" and message in broken.detail
    assert not (sweep / "boom").exists()


def test_rows_are_named_after_what_was_configured(sweep):
    study = study_of(sweep)
    assert [(g.label, g.variation, len(g.runs)) for g in study.groups] == [
        ("gausim", "full", 2), ("gausim w/o mass", "w/o mass", 1), ("gausim w/o momentum", "w/o momentum", 1),
        ("gausim w/o hierarchy", "w/o hierarchy", 1),
    ]  # fmt: skip
    # The failed run has no summary: its object is known from the runs on the same data.
    assert study.objects == ("toy_bunny",) and all(g.objects == ("toy_bunny",) for g in study.groups)


def test_rows_with_one_name_are_told_apart_by_what_differs(tmp_path):
    for rate in (0.001, 0.01):
        settings = config()
        settings["optimizer"]["network_lr"] = rate
        evaluate(write_run(tmp_path / f"lr_{rate}", settings), make_curves(rate))
    evaluate(write_run(tmp_path / "other", config(name="other")), make_curves(2.0))
    labels = [g.label for g in study_of(tmp_path).groups]
    assert labels == ["gausim (network_lr=0.001)", "gausim (network_lr=0.01)", "gausim (other)"]


def test_networks_of_one_object_each_are_one_row_beside_the_joint_one(tmp_path):
    def on(root, ablation="none"):
        settings = config(ablation)
        settings["data"].update(root=root, selections={"pinned": f"z={len(root)}"})
        return settings

    for seed in (0, 1):
        for i, name in enumerate(("one", "three")):
            run = write_run(tmp_path / f"{name}_{seed}", {**on(f"/data/{name}"), "seed": seed})
            evaluate(run, make_curves(1.0 + i + seed, name=name))
    write_run(tmp_path / "two_0", on("/data/two"), finished=False)
    evaluate(write_run(tmp_path / "other", on("/data/one", "no_mass")), make_curves(7.0, name="one"))
    joint = [make_curves(4.0, name="one"), make_curves(5.0, name="three")]
    evaluate(write_run(tmp_path / "joint", on("/data")), *joint)
    study = study_of(tmp_path)
    assert [(g.label, sorted(g.objects)) for g in study.groups] == [
        ("gausim", ["one", "three", "two"]), ("gausim jointly", ["one", "three"]), ("gausim w/o mass", ["one"]),
    ]  # fmt: skip
    values = [l2(study, "gausim", name) for name in ("one", "three")]
    assert [v.value for v in values] == pytest.approx([3.0, 5.0]) and [len(v.seeds) for v in values] == [2, 2]
    assert study.groups[0].state("two") == "unfinished"
    assert not any("more than once" in note for note in study.notes)


def test_seeds_are_pooled_by_hand(sweep):
    study = study_of(sweep)
    cell = l2(study, "gausim", split="unseen")
    # Means over sequences 10 and 12 with deviations 5 and 6 [1e-3].
    assert cell.value == pytest.approx(11) and cell.seeds == pytest.approx((10, 12))
    assert cell.std == pytest.approx(((5**2 + 6**2) / 2) ** 0.5, rel=1e-2)
    assert cell.seed_std == pytest.approx(2**0.5)
    energy = study.pivot.cell("gausim", ("toy_bunny", "seen", "points", "motion_energy"))
    assert energy.value == pytest.approx((1 / 2 + 1 / 2.2) / 2) and energy.std is None
    static = l2(study, "static", split="unseen")  # no seed changes it
    assert static.seeds == pytest.approx((40,)) and static.seed_std is None


def test_the_size_of_an_ablation_is_told_against_the_spread_of_seeds(sweep):
    evaluate(write_run(sweep / "no_mass" / "seed_1", config("no_mass", 1)), make_curves(1.7))
    study = study_of(sweep)
    place = "toy_bunny", "unseen", "train"
    effect = [study.pivot.number("gausim w/o mass", (*place, metric)) for metric in (EFFECT, EFFECT_SIGMA)]
    # Means 11 and 16, deviations over two seeds the square root of 2 each: a difference of 5 in units of that.
    assert effect == pytest.approx([100 * 5 / 11, 5 / 2**0.5])
    assert study.pivot.number("gausim", (*place, EFFECT)) is None


def test_why_there_is_no_number(sweep):
    study = study_of(sweep)
    assert [l2(study, g.label) is None for g in study.groups] == [False, False, True, True]
    assert [g.state("toy_bunny") for g in study.groups] == ["", "", "unfinished", "failed"]
    assert study.groups[0].state("else") == ""
    # Of seeds that all lack the number, the worst state is shown.
    failed = write_run(sweep / "no_momentum" / "seed_1", config("no_momentum", 1), finished=False)
    (failed / "FAILED").write_text("")
    (group,) = [g for g in study_of(sweep).groups if g.variation == "w/o momentum"]
    assert group.state("toy_bunny") == "failed" and len(group.runs) == 2


def test_what_makes_runs_incomparable_is_noted(tmp_path):
    evaluate(write_run(tmp_path / "a", config()), make_curves(1.0))
    evaluate(write_run(tmp_path / "b", config(seed=1)), make_curves(1.0, frames=40))
    evaluate(write_run(tmp_path / "c", config(seed=1)), make_curves(1.0))
    write_run(tmp_path / "d", config(seed=2))
    notes = "\n".join(study_of(tmp_path).notes)
    assert "toy_bunny: runs were evaluated on different ranges of frames and cannot be compared, as c, b." in notes
    assert "seed 1 is there more than once" in notes
    assert "1 of 4 runs have no numbers" in notes


EVIL = "<script>alert(1)</script>&\"'|`"


def first_screen(page: str) -> str:
    return page.split("<details", 1)[0]


def test_the_first_screen_is_a_film_and_a_sentence(tmp_path: Path) -> None:
    evaluate(write_run(tmp_path / "a", config()), make_curves(1.0))
    page = page_of(tmp_path)
    first = first_screen(page)
    assert first.count("<video") == 1 and 'src="data:video/mp4;base64,' in first and "autoplay" in first
    assert "a in y (held out)" in first
    text = re.search(r'<div class="sentences">(.*?)</div>', first, re.S)
    assert text is not None and "3D error 0.25 of the static" in text[1]
    assert first.count("<table") == 0 and page.count("<details") >= 5
    uri, problems = error_curves(study_of(tmp_path), "toy_bunny")
    assert not problems and uri.startswith("data:image/webp;base64,") and "Errors over time of toy_bunny" in page


def test_several_runs_can_be_chosen(tmp_path: Path) -> None:
    for i in range(8):
        settings = config(name=f"run{i}")
        settings["optimizer"]["network_lr"] = 0.1 * (i + 1)
        evaluate(write_run(tmp_path / f"r{i}", settings), make_curves(3.0 - 0.3 * i))
    openings, left = make_openings(study_of(tmp_path), pictures=False)
    assert len(openings) == MOST_OPENINGS and left == 2
    assert openings[0].run.name == "r7" and openings[0].label == "gausim (run7)"
    page = page_of(tmp_path, pictures=False)
    assert page.count('type="radio"') == MOST_OPENINGS == page.count('<section class="opening"')
    assert page.count(" checked>") == 1 and "and 2 more:" in page and "<script" not in page


def test_what_is_missing_is_named_with_the_command_that_makes_it(tmp_path: Path) -> None:
    trained = write_run(tmp_path / "my run", config())
    failed = write_run(tmp_path / "failed", config("no_mass"), finished=False)
    (failed / "FAILED").write_text("RuntimeError: out of memory")
    first = html.unescape(first_screen(page_of(tmp_path)))
    assert "Nothing has been evaluated" in first and f"<code>gausim evaluate '{trained}'</code>" in first
    assert "failed (RuntimeError: out of memory)" in first and "<video" not in first

    (evaluate(trained, make_curves(1.0)) / "evaluation" / "film_toy_bunny.mp4").unlink()
    (trained / "evaluation" / "metrics.npz").unlink()
    first = html.unescape(first_screen(page := page_of(trained)))
    assert "has no film" in first and f"<code>gausim evaluate '{trained}'</code>" in first
    assert "metrics.npz: cannot be read" in page


def test_hostile_names_stay_text_on_the_first_screen(tmp_path: Path) -> None:
    name = EVIL.replace("/", "∕")
    run = evaluate(write_run(tmp_path / name, config(name=EVIL), model=EVIL), make_curves(1.0, name=name))
    summary = json.loads((run / "evaluation" / "metrics.json").read_text())
    summary["objects"][name] |= {"heldout_views": [EVIL], "film": EVIL}
    (run / "evaluation" / "metrics.json").write_text(json.dumps(summary))
    write_run(tmp_path / "b", config("no_mass", name=EVIL), model=EVIL)
    page = page_of(tmp_path, title=EVIL)
    assert "<script" not in page and first_screen(page).count("&lt;script&gt;") >= 4 and "<video" in page
    assert "<script>" not in (tmp_path / "report" / "results.md").read_text().replace("\\<script\\>", "")
