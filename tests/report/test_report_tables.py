from __future__ import annotations

import csv
import io
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
from helpers import report_runs
from helpers.report_runs import config, evaluate, make_curves, write_run

from gausim.report.gather.paper import CONTRAST, TABLES, paper_object
from gausim.report.gather.runs import find_runs
from gausim.report.gather.study import make_study
from gausim.report.tables.overview import make_sheets
from gausim.report.tables.sheets import Sheet
from gausim.report.write import write_report

VOID = {"meta", "img", "br", "link", "hr", "input"}


@pytest.fixture
def sweep(tmp_path) -> Path:
    return report_runs.write_sweep(tmp_path / "sweep")


def sheets(root: Path) -> dict[str, Sheet]:
    return {sheet.key: sheet for sheet in make_sheets(make_study(find_runs([root])))}


def texts(sheet: Sheet) -> dict[str, list[str]]:
    return {line.label: [e.text for e in line.entries] for line in sheet.lines}


class Page(HTMLParser):
    """Checks that tags nest, and collects what matters."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: dict[str, int] = {}
        self.links: list[tuple[str, str]] = []
        self.anchors: set[str] = set()
        self.bold: list[str] = []
        self.text = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags[tag] = self.tags.get(tag, 0) + 1
        for key, value in attrs:
            assert not key.startswith("on"), (tag, key)
            if key in ("href", "src"):
                self.links.append((tag, value or ""))
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


def report(root: Path, **options) -> tuple[Path, Page]:
    write_report([root], root / "report", **{"pictures": False, **options})
    return root / "report", Page((root / "report" / "report.html").read_text())


def test_the_papers_table(sweep):
    sheet = sheets(sweep)["l2_train"]
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
    found = sheets(sweep)
    for key in ("ssim_train", "motion_energy_points"):
        assert {line.label for line in found[key].lines if line.entries[0].best} == {"gausim"}
    assert texts(found["motion_energy_points"])["gausim w/o mass"][0] == "0.40"


def test_ties_are_all_best_and_one_row_alone_is_not(tmp_path):
    for name in ("a", "b"):
        evaluate(write_run(tmp_path / name, config(name=name)), make_curves(1.0))
    assert [line.entries[0].best for line in sheets(tmp_path)["l2_train"].lines[:2]] == [True, True]
    assert not any(e.best for line in sheets(tmp_path / "a")["l2_train"].lines for e in line.entries)


def test_lpips_without_weights_says_how_to_get_them(sweep):
    sheet = sheets(sweep)["lpips_train"]
    assert texts(sheet)["gausim"] == ["no weights"] * 3 and "`gausim prepare lpips`" in sheet.caption
    assert texts(sheet)["GausSim (paper)"][0] == "0.21 ± 0.02"
    assert "flip_train" not in sheets(sweep)  # nobody measured it


def test_the_efficiency_table(sweep):
    rows = texts(sheets(sweep)["efficiency"])
    assert rows["gausim"] == [
        "200 → 20 → 4", "0.100", "0.0110 ± 0.0010", "2.00", "+ 3.6 MB", "1.1 min", "1.50 GB", "cpu, 1 threads",
    ]  # fmt: skip
    memory, trained = (sheets(sweep)["efficiency"].lines[0].entries[i] for i in (4, 5))
    assert trained.extra == "± 0.1 min, 2 seeds; 1.6 min of wall time"
    assert memory.extra == "first + 20 MB; process 2.10 GB"
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
    out, page = report(sweep)
    text = (out / "report.html").read_text()
    assert "default-src 'none'" in text and "script" not in page.tags and "http-equiv" in text
    assert not re.search(r"https?:|//[a-z]|url\(|@import", re.sub(r"data:[^\"]+", "", text))
    for _, link in page.links:
        assert link.startswith(("#", "data:", "../")), link
        assert not link.startswith("#") or link[1:] in page.anchors, link
        assert not link.startswith("../") or (out / link).exists(), link
    assert "11.00 ± 5.52" in page.bold and "15.00 ± 7.50" not in page.bold
    assert "c0ffeec0ffee" in page.text and "da7ada7ada7a" in page.text and "5ce7e5ce7e5c" in page.text
    assert "conserve_mass: false" in page.text and "5 runs: 3 evaluated, 1 failed, 1 unfinished" in page.text


def test_markdown_tables_have_one_cell_per_column(sweep):
    out, _ = report(sweep)
    text = (out / "results.md").read_text()
    for block in re.findall(r"(?:^\|.*\n)+", text, re.M):
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in block.splitlines()}) == 1, block
    assert "**11.00 ± 1.41 (± 5.52)**" in text


def test_csv_round_trip(sweep):
    out, _ = report(sweep)
    rows = list(csv.DictReader(io.StringIO((out / "numbers.csv").read_text())))
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
