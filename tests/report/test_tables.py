"""Tables of reports, their files, pages made from records, and the figures of the repository's own pages."""

import csv
import importlib.util
import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.report_runs import (
    FRAMES,
    METRICS,
    config,
    evaluate,
    grids_of,
    make_curves,
    page_of,
    shown,
    study_of,
    write_run,
)

from gausim.cli import main as cli
from gausim.core import RunError
from gausim.evaluation.evaluation import results_of
from gausim.report.layouts import summary
from gausim.report.paper import TABLES, paper_object
from gausim.report.render import LEGEND, evaluation_page
from gausim.report.runs import find_runs
from gausim.results.curves import ImageMetricInfo, ObjectCurves, load_curves
from gausim.results.pivot import Pivot, cell_texts, markdown_table
from gausim.results.summary import FLOOR, entries_of, frame_splits
from gausim.results.table import SCHEMA, Cell, Entry, Made, Metric, ObjectInfo, Results, load_results, save_results

ROOT = Path(__file__).resolve().parents[2]
MAKE = importlib.util.spec_from_file_location("make_results", ROOT / "docs" / "results" / "make.py")
make_results = importlib.util.module_from_spec(MAKE)
MAKE.loader.exec_module(make_results)
page = make_results.page
HOSTILE = r"a_b & 100% {x} \input{/etc/passwd} $y^2 #1 ~z"


def table_of(*entries: Entry, **metrics: Metric) -> Results:
    return Results(SCHEMA, "Title", made=Made("2026-01-01", ["abc"], ["gausim train"]), objects={"o": ObjectInfo()},
                   metrics=metrics, table=list(entries), facts={"minutes": 0.5, "of": "6"})  # fmt: skip


def entry(row: str, metric: str, value: float | str, seed: int = 0, kind: str = "method", std: float | None = None):
    return Entry(row, kind, "o", "", "", metric, seed, value, std)  # type: ignore[arg-type]


def test_figures_as_printed() -> None:
    metrics = {
        "low": Metric("low", "", "low", 1), "one": Metric("one", "", "one"), "stored": Metric("as stored", digits=None),
        "high": Metric("high", "", "high"),
    }  # fmt: skip
    entries = [
        entry("a", "low", 1.24), entry("a", "one", 1.2), entry("a", "stored", 0.0001), entry("a", "high", 0.4),
        entry("a", "high", 0.6, 1), entry("b", "low", 1.16), entry("b", "one", 0.8), entry("b", "stored", 12345.0),
        entry("b", "high", 0.75, 0, std=0.125), entry("b", "high", 0.75, 1, std=0.125), entry("c", "low", 0.0),
        entry("c", "stored", "6 to 7"), entry("truth", "low", -1.0, kind="informed"),
        entry("truth", "one", 1.0, kind="informed"), entry("truth", "high", 9.0, kind="informed"),
    ]  # fmt: skip
    pivot = Pivot(table_of(*entries, **metrics))
    grid = pivot.grid(pivot.column(("o", "", "", metric)) for metric in metrics)
    assert markdown_table(grid).splitlines()[2:] == [
        "| a | 1.2 | **1.20** | 0.0001 | 0.50 ± 0.14 |",
        "| b | 1.2 | **0.80** | 12,345 | **0.75 ± 0.00 (± 0.12)** |",
        "| c | **0** | | 6 to 7 | |",
        "| truth | -1.0 | 1.00 | | 9.00 |",
    ]
    assert cell_texts(Cell(1.5, (1.0, 2.0), 0.7, 0.1), 1) == ("1.5", "± 0.7 (± 0.1)")


def test_pages_name_records(tmp_path: Path) -> None:
    results = table_of(entry("a | x", "l2", 1.0), l2=Metric("l2", digits=1))
    save_results(tmp_path / "mine.json", results)
    assert load_results(tmp_path / "mine.json") == results
    call = 'table("mine", "o", stub="row | kind")'
    template = f"## A {{#a}}\n{{{{ mine.minutes }}}} of {{{{ mine.of }}}}\n\n{{{{ {call} }}}}\n\n"
    template += '{{ made("mine") }}\n'
    (tmp_path / "page.md").write_text(template)
    text = page(tmp_path)
    assert "## A {#a}\n0.5 of 6\n" in text and "| a | x | 1.0 |" in text and "| row | kind | l2 |" in text
    assert "Made by (abc; recorded 2026-01-01)" in text and "\n    gausim train\n" in text
    results.made.test = "Looked at once."
    save_results(tmp_path / "mine.json", results)
    assert page(tmp_path) == text.replace("Made by (", "Looked at once.\n\nMade by (")
    for wrong, message in (
        ("table('mine', 'u')", "no object 'u'"),
        ("table('no', 't')", "record 'no', expected one of"),
        ("mine.hours", "cannot be made into a page"),
        ("table('mine', 'o', 'ahead')", "no figures"),
    ):
        (tmp_path / "page.md").write_text(f"{{{{ {wrong} }}}}")
        with pytest.raises(RunError, match=message):
            page(tmp_path)
    (tmp_path / "mine.json").write_text("{}")
    with pytest.raises(RunError, match=r"mine\.json: field 'schema' is None, .*gausim report DIR --record"):
        page(tmp_path)


def test_the_papers_table(sweep: Path) -> None:
    grid = grids_of(sweep)["l2 [1e-3] ↓, training views"]
    assert [(c.group, c.label) for c in grid.columns] == [("toy_bunny", s) for s in ("Seen", "Unseen 34", "Unseen 44")]
    assert shown(grid) == {
        "gausim": ["2.20 ± 0.28 (± 1.10)*", "11.00 ± 1.41 (± 5.52)*", "11.00 ± 1.41 (± 5.52)*"],
        "gausim w/o mass": ["3.00 (± 1.50)", "15.00 (± 7.50)", "15.00 (± 7.50)"],
        "static": ["8.00 (± 4.00)", "40.00 (± 20.00)", "40.00 (± 20.00)"],
        "reconstruction (floor), frame 0": ["8.00 (± 4.00)", "", ""],
        "DreamGaussian4D (paper)": ["1.21 (± 0.11)", "3.10 (± 0.63)", ""],
        "PhysDreamer (paper)": ["4.77 (± 0.45)", "3.62 (± 0.31)", ""],
        "GausSim (paper)": ["1.15 (± 0.12)", "2.47 (± 0.40)", ""],
    }
    kinds = ["method"] * 2 + ["reference", "informed"] + ["paper"] * 3
    assert [line.kind for line in grid.lines] == kinds


def test_better_may_be_higher_or_nearer_to_one_and_ties_are_all_best(sweep: Path, tmp_path: Path) -> None:
    found = grids_of(sweep)
    for title in ("SSIM [1e-1] ↑, training views", "motion energy, 3D, true points"):
        assert {line.label for line in found[title].lines if line.best[0]} == {"gausim"}
    for name in ("a", "b"):
        evaluate(write_run(tmp_path / "two" / name, config(name=name)), make_curves(1.0))
    assert [line.best[0] for line in grids_of(tmp_path / "two")["l2 [1e-3] ↓, training views"].lines[:2]] == [True] * 2


def test_the_comparison_has_costs_and_every_method_its_notes(sweep: Path) -> None:
    grid = grids_of(sweep)["toy_bunny, frames 16..49 (unseen)"]
    assert [column.label for column in grid.columns] == [
        "l2 [1e-3]", "SSIM [1e-1]", "3D ÷ static", "motion energy", "units", "fit [CPU min]", "fit, memory [GB]",
        "per frame [s]", "prediction, memory [MB]",
    ]  # fmt: skip
    rows = shown(grid)
    assert rows["gausim"][4:] == ["200 → 20 → 4", "1.1 ± 0.1", "1.5 ± 0.0", "0.0110 ± 0.0014", "3.3 ± 0.4"]
    assert rows["static"][2:] == ["1.000 (± 0.500)", "0", *[""] * 5]


def test_several_objects_have_a_summary(sweep: Path) -> None:
    assert summary(study_of(sweep).pivot) is None
    run = write_run(sweep / "other", config() | {"data": {"root": "/data/toy", "names": ["toy_cube"], "seed": 0}})
    evaluate(run, make_curves(2.0, name="toy_cube"))
    grid = summary(study_of(sweep).pivot)
    names = ("toy_bunny", "toy_cube")
    assert [c.label for c in grid.columns] == [f"{n}: {w}" for n in names for w in ("l2 [1e-3]", "3D ÷ static")]
    full = next(row for row in shown(grid).values() if all(row))
    assert [text.rstrip("*") for text in full[::2]] == ["11.0", "20.0"]


def test_the_papers_own_figures() -> None:
    assert paper_object("bunny_ready") == "bunny" and paper_object("Pudding-soft") == "pudding"
    assert paper_object("bunnyhop") is None and paper_object("cat") is None
    assert TABLES["l2"]["GausSim (paper)"]["mothorchids"] == ((1.78, 0.23), (1.85, 0.14))
    # Sums of all means and of all deviations of each table, taken from the paper's own source.
    sums = {"l2": (136.28, 21.2), "ssim": (296.18, 0.27), "lpips": (68.25, 5.24)}
    for metric, expected in sums.items():
        pairs = [pair for by_object in TABLES[metric].values() for both in by_object.values() for pair in both]
        assert len(pairs) == 30 and [sum(p[i] for p in pairs) for i in (0, 1)] == pytest.approx(expected)


def test_the_page_stands_alone_and_lists_its_runs(sweep: Path) -> None:
    text = page_of(sweep, pictures=False)
    links, anchors = re.findall(r' (?:href|src)="([^"]*)"', text), re.findall(r' id="([^"]*)"', text)
    assert "default-src 'none'" in text and "<script" not in text and "http-equiv" in text
    assert not re.search(r"<[^>]* on\w+=", text)
    assert not re.search(r"https?:|//[a-z]|url\(|@import", re.sub(r"data:[^\"]+", "", text))
    for link in links:
        assert link.startswith(("#", "data:", "../")), link
        assert not link.startswith("#") or link[1:] in anchors, link
        assert not link.startswith("../") or (sweep / "report" / link).exists(), link
    bold = re.findall(r"<b>([^<]*)", text)
    assert "11.00" in bold and "15.00" not in bold and "../full/seed_0" in links
    assert "c0ffeec0ffee" in text and "da7ada7ada7a" in text and "5ce7e5ce7e5c" in text
    assert "name: no_mass" in text and "5 runs: 3 evaluated, 1 failed, 1 unfinished" in text
    markdown = (sweep / "report" / "results.md").read_text()
    for block in re.findall(r"(?:^\|.*\n)+", markdown, re.M):
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in block.splitlines()}) == 1, block


def test_csv_is_the_long_table(sweep: Path) -> None:
    page_of(sweep, pictures=False)
    rows = list(csv.DictReader(io.StringIO((sweep / "report" / "numbers.csv").read_text())))
    stored = load_results(sweep / "no_mass" / "seed_0" / "evaluation" / "metrics.json").table
    own = {(r["split"], r["views"], r["metric"]): r["value"] for r in rows if r["row"] == "gausim w/o mass"}
    for e in stored:
        if e.row == "gausim":
            assert own.pop((e.split, e.views, e.metric)) == str(e.value)
    assert {metric for _, _, metric in own} <= {"l2_effect", "l2_effect_sigma"}
    full = [r for r in rows if (r["row"], r["split"], r["views"], r["metric"]) == ("gausim", "seen", "train", "l2")]
    assert [r["seed"] for r in full] == ["0", "1"] and full[0]["runs"] == "full/seed_0;full/seed_1"
    assert full[0]["unit"] == "1e-3" and full[0]["commit"] == "c0ffeec0ffee"
    assert {r["status"] for r in rows if r["row"] == "gausim w/o hierarchy"} == {"failed"}


def test_results_come_with_commit_command_and_hardware(sweep: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path in sweep.rglob(".hydra/hydra.yaml"):
        hydra = yaml.safe_load(path.read_text())
        own = [f"seed={path.parents[1].name[-1]}", "experiment=tables/ablations", "data.names=[a]"]
        hydra["hydra"] |= {"mode": "MULTIRUN", "overrides": {"task": own}}
        path.write_text(yaml.safe_dump(hydra))
    words = ["experiment=tables/ablations", "seed=0,1", "data.names=[a]"]
    (sweep / "multirun.yaml").write_text(yaml.safe_dump({"hydra": {"overrides": {"task": words}}}))
    out = sweep.parent / "results"
    assert cli.main(["report", str(sweep), "--out", str(out), "--no-pictures"]) == 0
    assert cli.main(["report", str(sweep), "--record", str(out / "sweep.json")]) == 0
    assert "record: file://" in capsys.readouterr().out
    text = (out / "results.md").read_text()
    command = "gausim train -m experiment=tables/ablations seed=0,1 'data.names=[a]'"
    assert r"* Without figures: no\_hierarchy/seed\_0 (failed)" in text
    assert f"* Command: `{command}`" in text and "* Commits: c0ffeec0ffee" in text and "* Hardware: " in text
    assert "| gausim | **11.00 ± 1.41 (± 5.52)** |" in text
    record = load_results(out / "sweep.json")
    assert record.table == study_of(sweep).results.table and record.objects["toy_bunny"].sources == {}
    assert f"% Command: {command}" in (out / "tables.tex").read_text()
    # Another sweep of the same name has taken the place of the first.
    (sweep / "multirun.yaml").write_text(yaml.safe_dump({"hydra": {"overrides": {"task": [*words, "model=other"]}}}))
    commands = {run.command for run in find_runs([sweep / "full"])}
    assert commands == {f"gausim train seed={i} experiment=tables/ablations 'data.names=[a]'" for i in (0, 1)}
    assert cli.main(["report", str(sweep / "no_hierarchy"), "--record", str(out / "none.json")]) == 2
    assert "no run here is evaluated" in capsys.readouterr().err


def test_latex_nests_is_escaped_and_fills_its_columns(sweep: Path) -> None:
    evaluate(write_run(sweep / "other", config(name=HOSTILE), model=None), make_curves(2.0, name=HOSTILE))
    page_of(sweep, pictures=False)
    latex = (sweep / "report" / "tables.tex").read_text()
    assert "etc/passwd" in latex and r"\input" not in latex  # the hostile name is there, as text
    bare = re.sub(r"(?m)(?<!\\)%.*$|\\[&%$#_{}\\]", "", latex)  # without comments and what is escaped
    assert not set("$^_#~%") & set(re.sub(r"\$[^$\n]*\$", "", bare)) and bare.count("{") == bare.count("}")
    assert not [c for c in re.sub(r"(?m)(?<!\\)%.*$", "", latex) if ord(c) > 126]
    tables = re.findall(r"\\begin\{tabular\}\{(lc+)\}\n(.*?)\\end\{tabular\}", latex, re.S)
    assert len(tables) == latex.count(r"\begin{table*}") == latex.count(r"\caption{") > 6
    for columns, table in tables:
        rows = [r for r in table.splitlines() if not r.endswith("rule") and "multicolumn" not in r]
        assert all(row.endswith(r" \\") and len(re.split(r"(?<!\\)&", row)) == len(columns) for row in rows)
    labels = re.findall(r"\\label\{(.*?)\}", latex)
    assert len(set(labels)) == len(labels) and all(re.fullmatch(r"tab:[A-Za-z0-9-]+", label) for label in labels)
    assert r"\textbf{11.00 $\pm$ 1.41 ($\pm$ 5.52)}" in latex


def test_figures_of_readme_and_results_are_of_the_records() -> None:
    assert (ROOT / "docs" / "results.md").read_text() == page(ROOT / "docs" / "results"), "run `make results`"
    found = re.search(r"\[start:results\] -->\n(\|.*?)\n\n", (ROOT / "README.md").read_text(), re.DOTALL)
    assert found is not None
    head, *rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in found[1].splitlines()]
    grid = summary(Pivot(load_results(ROOT / "docs" / "results" / "comparison.json")), [row[0] for row in rows[1:]])
    assert len(rows) > 5 and grid is not None
    whole = [[cell.strip() for cell in line.split("|")[1:-1]] for line in markdown_table(grid).splitlines()]
    shown = [0, *(i for i, name in enumerate(whole[0]) if name == "trials" or name.endswith("3D ÷ static"))]
    assert rows[1:] == [[row[i] for i in shown] for row in whole[2:]]
    assert all(whole[0][i].startswith(name) for name, i in zip(head[1:], shown[1:], strict=True))
    # Every decimal of the page comes from a record: the template has integers and settings only.
    text = (ROOT / "docs" / "results" / "page.md").read_text()
    prose = re.sub(r"\{\{.*?\}\}|`[^`]*`|\]\([^)]*\)", "", text)
    assert not re.findall(r"(?<![\w.])\d*\.\d+", prose)


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
