from __future__ import annotations

import csv
import io
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
from helpers.report_runs import NO_HIERARCHY, config, evaluate, make_curves, page_of, sheets_of, study_of, write_run

from gausim.report.gather.paper import CONTRAST, TABLES, paper_object
from gausim.report.gather.study import Study
from gausim.report.opening import first_table
from gausim.report.records.measure import measured_record
from gausim.report.tables.motion import bounce_sheets, horizon_sheets
from gausim.report.tables.sheets import Sheet
from gausim.report.tables.verdict import outcome, sentences

OFF = {
    "none": {}, "no_mass": {"conserve_mass": False}, "no_momentum": {"conserve_momentum": False},
    "no_hierarchy": NO_HIERARCHY,
}  # fmt: skip
BOUNCE = {"height": 0.5, "rise": 0.2, "height_error": 0.1, "rise_error": 0.25, "depth": 0.3}
VOID = {"meta", "img", "br", "link", "hr", "input"}


def texts(sheet: Sheet) -> dict[str, list[str]]:
    return {line.label: [e.text for e in line.entries] for line in sheet.lines}


class Page(HTMLParser):
    """Checks that tags nest, and collects what matters."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open, self.links, self.bold = list[str](), list[str](), list[str]()
        self.tags, self.anchors, self.text = set[str](), set[str](), ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        for key, value in attrs:
            assert not key.startswith("on"), (tag, key)
            if key in ("href", "src"):
                self.links.append(value or "")
            if key == "id":
                self.anchors.add(value)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data
        if self.open and self.open[-1] == "b":
            self.bold.append(data)


def test_the_papers_table(sweep):
    sheet = sheets_of(sweep)["l2_train"]
    assert sheet.columns == (("toy_bunny", ("Seen", "Unseen 34", "Unseen 44")),)
    assert texts(sheet) == {
        "gausim": ["2.20 ± 1.10", "11.00 ± 5.52", "11.00 ± 5.52"],
        "gausim w/o mass": ["3.00 ± 1.50", "15.00 ± 7.50", "15.00 ± 7.50"],
        "gausim w/o momentum": ["unfinished"] * 3,
        "gausim w/o hierarchy": ["failed"] * 3,
        "static": ["8.00 ± 4.00", "40.00 ± 20.00", "40.00 ± 20.00"],
        "reconstruction (floor)": ["8.00 ± 4.00", "–", "–"],
        "DreamGaussian4D (paper)": ["1.21 ± 0.11", "3.10 ± 0.63", "–"],
        "PhysDreamer (paper)": ["4.77 ± 0.45", "3.62 ± 0.31", "–"],
        "GausSim (paper)": ["1.15 ± 0.12", "2.47 ± 0.40", "–"],
    }
    assert sheet.lines[0].entries[1].extra == "± 1.41, 2 seeds"
    best = {(line.label, i) for line in sheet.lines for i, e in enumerate(line.entries) if e.best}
    assert best == {("gausim", 0), ("gausim", 1), ("gausim", 2)}
    assert [line.kind for line in sheet.lines] == ["method"] * 4 + ["reference"] * 2 + ["paper"] * 3


def test_better_may_be_higher_or_nearer_to_one(sweep):
    found = sheets_of(sweep)
    for key in ("ssim_train", "motion_energy_points"):
        assert {line.label for line in found[key].lines if line.entries[0].best} == {"gausim"}
    assert texts(found["motion_energy_points"])["gausim w/o mass"][0] == "0.40"


def test_ties_are_all_best_and_one_row_alone_is_not(tmp_path):
    for name in ("a", "b"):
        evaluate(write_run(tmp_path / name, config(name=name)), make_curves(1.0))
    assert [line.entries[0].best for line in sheets_of(tmp_path)["l2_train"].lines[:2]] == [True, True]
    assert not any(e.best for line in sheets_of(tmp_path / "a")["l2_train"].lines for e in line.entries)


def test_lpips_without_weights_says_how_to_get_them(sweep):
    sheet = sheets_of(sweep)["lpips_train"]
    assert texts(sheet)["gausim"] == ["no weights"] * 3 and "`gausim prepare lpips`" in sheet.caption
    assert texts(sheet)["GausSim (paper)"][0] == "0.21 ± 0.02"
    assert "flip_train" not in sheets_of(sweep)  # nobody measured it


def test_the_efficiency_table(sweep):
    sheet = sheets_of(sweep)["efficiency"]
    rows = texts(sheet)
    assert rows["gausim"] == [
        "200 → 20 → 4", "0.100", "0.0110 ± 0.0010", "2.00", "+ 3.6 MB", "1.1 min", "1.50 GB", "cpu, 1 threads",
    ]  # fmt: skip
    assert [sheet.lines[0].entries[i].extra for i in (4, 5)] == [
        "first + 20 MB; process 2.10 GB", "± 0.1 min, 2 seeds; 1.6 min of wall time",
    ]  # fmt: skip
    assert rows["gausim w/o hierarchy"][0] == "failed"
    assert rows["GausSim w/o hierarchy (paper)"][2] == "0.36"


def test_the_papers_own_figures():
    assert paper_object("bunny_ready") == "bunny" and paper_object("Pudding-soft") == "pudding"
    assert paper_object("bunnyhop") is None and paper_object("cat") is None
    assert TABLES["l2"]["GausSim (paper)"]["mothorchids"] == ((1.78, 0.23), (1.85, 0.14))
    assert TABLES["ssim"]["PhysDreamer (paper)"]["carnation"] == ((9.71, 0.02), (9.73, 0.02))
    assert TABLES["lpips"]["DreamGaussian4D (paper)"]["duck"] == ((1.52, 0.13), (1.82, 0.14))
    # Sums of all means and of all deviations of each table, taken from the paper's own source.
    sums = {"l2": (136.28, 21.2), "ssim": (296.18, 0.27), "lpips": (68.25, 5.24)}
    for metric, expected in sums.items():
        pairs = [pair for by_object in TABLES[metric].values() for both in by_object.values() for pair in both]
        assert len(pairs) == 30 and [sum(p[i] for p in pairs) for i in (0, 1)] == pytest.approx(expected)
    assert all(abs(sum(c * c for c in color) ** 0.5 - norm) < 0.05 for color, norm, _ in CONTRAST.values())


def test_the_page_stands_alone_and_every_number_leads_to_its_run(sweep):
    text = page_of(sweep, pictures=False)
    page = Page(text)
    assert "default-src 'none'" in text and "script" not in page.tags and "http-equiv" in text
    assert not re.search(r"https?:|//[a-z]|url\(|@import", re.sub(r"data:[^\"]+", "", text))
    for link in page.links:
        assert link.startswith(("#", "data:", "../")), link
        assert not link.startswith("#") or link[1:] in page.anchors, link
        assert not link.startswith("../") or (sweep / "report" / link).exists(), link
    assert "11.00 ± 5.52" in page.bold and "15.00 ± 7.50" not in page.bold
    assert "c0ffeec0ffee" in page.text and "da7ada7ada7a" in page.text and "5ce7e5ce7e5c" in page.text
    assert "conserve_mass: false" in page.text and "5 runs: 3 evaluated, 1 failed, 1 unfinished" in page.text


def test_markdown_tables_have_one_cell_per_column(sweep):
    page_of(sweep, pictures=False)
    text = (sweep / "report" / "results.md").read_text()
    for block in re.findall(r"(?:^\|.*\n)+", text, re.M):
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in block.splitlines()}) == 1, block


def test_csv_round_trip(sweep):
    page_of(sweep, pictures=False)
    rows = list(csv.DictReader(io.StringIO((sweep / "report" / "numbers.csv").read_text())))
    path = sweep / "no_mass" / "seed_0" / "evaluation" / "metrics.json"
    summary = json.loads(path.read_text())["objects"]["toy_bunny"]["rows"]["gausim"]
    own = {(r["split"], r["views"], r["metric"]): r for r in rows if r["row"] == "gausim w/o mass"}
    assert len(own) == sum(len(cells) for views in summary.values() for cells in views.values()) > 20
    for (split, views, metric), row in own.items():
        stored = summary[split][views][metric]
        assert float(row["mean"]) == stored["pooled" if metric == "motion_energy" else "mean"]
        if metric != "motion_energy":
            assert float(row["std_sequences"]) == pytest.approx(stored["std"], rel=1e-12)
    (first, *_) = [r for r in rows if r["row"] == "gausim"]
    assert first["runs"] == "full/seed_0;full/seed_1" and first["commit"] == "c0ffeec0ffee" and first["seeds"] == "2"
    assert {r["status"] for r in rows if r["row"] == "gausim w/o hierarchy"} == {"failed"}
    assert [r["first_frame"] + "-" + r["end_frame"] for r in rows if r["split"] == "unseen"][0] == "16-50"


# ----------------------------------------------------------------------------------------- ablations of a sweep


def job(root: Path, ablation: str, seed: int, layers: int = 2) -> Path:
    folder = root / ablation / "gausim" / f"experiment=tiny,model.simulator.network.layers={layers}" / f"seed_{seed}"
    settings = config(seed, layers=layers, **OFF[ablation])
    settings["ablation"] = {"name": ablation}
    return write_run(folder, settings, finished=False)


@pytest.fixture
def jobs(tmp_path: Path) -> Path:
    """A sweep as `gausim train -m` leaves it: NAME/ABLATION/MODEL/OVERRIDES/seed_S, some jobs failed, some missing."""
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


def test_the_ablation_table_pools_seeds_and_shows_what_is_missing(jobs: Path) -> None:
    ablations = sheets_of(jobs)["ablation_toy_bunny_gausim"]
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
    assert sheets_of(tmp_path)["ablation_toy_bunny_gausim"].columns == (
        ("gausim", ("full", "w/o mass, w/o momentum", "w/o mass, relu")),
    )


# --------------------------------------------------------------------------------- bodies that fall or are in hands


def falling_study(root: Path, reference: str = "ballistic") -> Study:
    for seed, error in ((0, 1.0), (1, 2.0)):
        made = make_curves(error)
        made.values[reference] = made.values.pop("static")
        true = {**BOUNCE, "height_error": 0.0, "rise_error": 0.0}
        rows = {"gausim": {**BOUNCE, "height": 0.4 + 0.1 * seed}, reference: {**BOUNCE, "rise": None}, "truth": true}
        made.record["bounce"] = rows
        evaluate(
            write_run(root / f"seed_{seed}", config(seed)),
            replace(made, facts=replace(made.facts, reference=reference)),
        )
    return study_of(root)


def test_bounces_and_errors_ahead_of_methods_references_and_the_truth(tmp_path):
    study = falling_study(tmp_path)
    (sheet,) = bounce_sheets(study)
    rows = texts(sheet)
    assert rows["gausim"] == ["0.450", "10.0 %", "0.200", "25.0 %", "0.30"]
    assert rows["ballistic"][2] == "–" and rows["truth"][1] == "0.0 %"
    (sheet,) = horizon_sheets(study)
    assert sheet.columns == (("", ("+1", "+2", "+5", "+10", "+20", "+30")),)
    # 100 times the l2 of 2e-3, five times that in unseen frames; twice that with the second seed.
    assert texts(sheet)["gausim"] == ["1.50"] * 6 and texts(sheet)["ballistic"] == ["4.00"] * 6
    # The record has the deviation over seeds beside.
    rows = {row.label[0]: row.cells for row in measured_record(study, "Falling").table("toy_bunny_bounce").rows}
    assert [cell.mean for cell in rows["gausim"]] == pytest.approx([0.45, 10.0, 0.2, 25.0, 0.3])
    assert rows["gausim"][0].seeds == [0.4, 0.5] and rows["ballistic"][2] is None and rows["truth"][3].mean == 0.0


@pytest.mark.parametrize(
    ("reference", "words"),
    [("ballistic", "rigid flight"), ("follow hands", "the hands' motion alone"), ("static", "no motion")],
)
def test_sentences_and_first_table_name_the_reference(tmp_path, reference, words):
    found = falling_study(tmp_path, reference)
    (group,) = found.groups
    entries = [entry for _, entry in group.entries("toy_bunny")]
    assert f"a model that predicts {words}" in sentences(outcome(entries, "gausim"))[0]
    table = first_table(found, group, "toy_bunny")
    assert f"3D error ÷ {reference} ↓" in table.head and any(row[0] == words for row in table.rows)
    assert words in table.title


def test_still_bodies_have_no_bounces(tmp_path):
    evaluate(write_run(tmp_path / "seed_0", config(0)), make_curves(1.0))
    assert bounce_sheets(study_of(tmp_path)) == []
