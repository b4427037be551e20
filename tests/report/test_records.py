"""Records of tables, the pages made from them, and the figures of the repository's own pages."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from helpers.report_runs import config, evaluate, make_curves, page_of, study_of, write_run

from gausim.cli import main as cli
from gausim.core import RunError
from gausim.report.gather.runs import find_runs
from gausim.report.gather.study import make_study
from gausim.report.records.commands import joined
from gausim.report.records.measure import measured_record
from gausim.report.records.print import markdown_table, page, results_latex, results_page
from gausim.report.records.record import (
    SCHEMA,
    Column,
    Figure,
    Made,
    Record,
    RecordTable,
    Row,
    load_record,
    save_record,
)

ROOT = Path(__file__).resolve().parents[2]
HOSTILE = r"a_b & 100% {x} \input{/etc/passwd} $y^2 #1 ~z"
# Commands of LaTeX itself and of the packages that the file's first line asks for.
KNOWN = {
    "begin", "end", "centering", "caption", "label", "textbf", "linewidth", "width", "ifdim", "else", "fi", "pm",
    "times", "to", "uparrow", "downarrow", "sigma", "div",  # LaTeX
    "textbackslash", "textasciitilde", "textasciicircum", "textless", "textgreater", "textbar", "textquotedbl",  # T1
    "toprule", "midrule", "bottomrule", "resizebox",  # booktabs, graphicx
}  # fmt: skip


def record_of(root: Path) -> Record:
    return measured_record(study_of(root), "Sweep")


def test_a_record_holds_every_figure_with_seeds_and_sequences_apart(sweep: Path, tmp_path: Path) -> None:
    record = record_of(sweep)
    keys = [table.key for table in record.tables]
    assert keys[0] == "toy_bunny_comparison" and {"toy_bunny_seen_train", "toy_bunny_unseen_points"} < set(keys)
    first = record.tables[0]
    assert [column.label for column in first.columns] == [
        "l2 [1e-3]", "SSIM [1e-1]", "3D ÷ static", "motion energy", "units", "fit [CPU min]", "fit, memory [GB]",
        "per frame [s]", "prediction, memory [MB]",
    ]  # fmt: skip
    rows = {row.label[0]: row for row in first.rows}
    assert list(rows) == ["gausim", "gausim w/o mass", "static"]
    l2, _, ratio, _, units, fit, _, _, memory = rows["gausim"].cells
    spreads = (pytest.approx(2**0.5, rel=1e-5), pytest.approx(5.52268, rel=1e-5))
    assert l2 == Figure(11.0, [10.0, 12.0], *spreads)
    assert rows["gausim w/o mass"].cells[0] == Figure(15.0, std=7.5)
    assert ratio.mean == pytest.approx(1.1 / 4) and ratio.std is not None
    assert fit.mean == pytest.approx(1.1) and rows["static"].cells[5] is None
    assert memory.mean == pytest.approx(3.3) and units == "200 → 20 → 4"
    assert record.made.missing == ["no_hierarchy/seed_0 (failed)", "no_momentum/seed_0 (unfinished)"]
    assert record.made.commits == ["c0ffeec0ffee"] and record.made.hardware == ["not recorded"]
    save_record(tmp_path / "record.json", record)
    assert load_record(tmp_path / "record.json") == record


def test_the_size_of_an_ablation_is_told_against_the_spread_of_seeds(sweep: Path) -> None:
    evaluate(
        write_run(sweep / "no_mass" / "seed_1", config(1, conserve_mass=False)),
        make_curves(1.7),
    )
    table = record_of(sweep).table("toy_bunny_ablations_gausim")
    full, without = table.rows
    assert (full.label, without.label) == (["full"], ["w/o mass"]) and full.cells[-2:] == [None, None]
    # Means 11 and 16, deviations over two seeds the square root of 2 each: a difference of 5 in units of that.
    assert without.cells[-2:] == [pytest.approx(100 * 5 / 11, rel=1e-4), pytest.approx(5 / 2**0.5, rel=1e-4)]
    assert [column.label for column in table.columns][:2] == ["l2 [1e-3], seen", "l2 [1e-3], unseen"]


def test_a_metric_that_is_new_is_a_column(sweep: Path) -> None:
    runs = find_runs([sweep])
    for run in runs:
        for entry in run.objects.values():
            entry["metrics"]["iou"] = {"label": "mask IoU", "scale": 1.0, "unit": "", "higher_is_better": True}
            entry["rows"]["gausim"]["unseen"]["train"]["iou"] = {"mean": 0.5, "std": 0.1, "ratio": None}
    tables = {table.key: table for table in measured_record(make_study(runs), "Sweep").tables}
    column = [c.label for c in tables["toy_bunny_unseen_train"].columns].index("mask IoU")
    assert "mask IoU" not in [c.label for c in tables["toy_bunny_seen_train"].columns]
    cells = {row.label[0]: row.cells[column] for row in tables["toy_bunny_unseen_train"].rows}
    assert cells["gausim w/o mass"] == Figure(0.5, std=0.1) and cells["static"] is None


def test_errors_by_frames_ahead_are_a_table(sweep: Path) -> None:
    table = record_of(sweep).table("toy_bunny_ahead")
    assert [column.label for column in table.columns] == ["+1", "+2", "+5", "+10", "+20", "+30"]
    rows = {row.label[0]: row.cells[0] for row in table.rows}
    # l2 of 1e-3 and 3e-3, five times that in unseen frames, of the two seeds 1 and 1.2 times that.
    assert rows["gausim"] == Figure(1.1, [1.0, 1.2], pytest.approx(0.2 / 2**0.5, rel=1e-5))
    assert rows["static"] == Figure(4.0)


def test_several_objects_have_a_summary(sweep: Path) -> None:
    assert all(table.key != "summary" for table in record_of(sweep).tables)
    run = write_run(sweep / "other", config() | {"data": {"root": "/data/toy", "names": ["toy_cube"], "seed": 0}})
    evaluate(run, make_curves(2.0, name="toy_cube"))
    table = record_of(sweep).tables[0]
    names = ("toy_bunny", "toy_cube")
    assert table.key == "summary" and [column.label for column in table.columns] == [
        f"{name}: {what}" for name in names for what in ("l2 [1e-3]", "3D ÷ static")
    ]
    rows = {tuple(c is None for c in row.cells): row.cells for row in table.rows}
    assert rows[False, False, False, False][::2] == [11.0, 20.0]


def test_runs_that_take_over_from_runs_of_other_seeds_or_objects_are_one_row(tmp_path: Path) -> None:
    for name, error in (("toy_bunny", 1.0), ("toy_cube", 2.0)):
        for seed in (0, 1):
            own = config(seed) | {"data": {"root": "/data/toy", "names": [name], "seed": seed}}
            own |= {"model": {"method": {"_target_": "physgaussian"}}, "init_from": f"out/{name}/seed_{seed}"}
            run = write_run(tmp_path / name / f"seed_{seed}", own, model="physgaussian")
            evaluate(run, make_curves(error + seed, name=name))
    table = record_of(tmp_path).table("summary")
    assert [(row.label, row.cells[::2]) for row in table.rows] == [(["physgaussian"], [15.0, 25.0])]


def test_an_object_that_no_run_has_evaluated_has_no_tables(sweep: Path) -> None:
    other = config() | {"data": {"root": "/data/other", "names": ["toy_cube"], "seed": 0}}
    write_run(sweep / "other", other)
    assert study_of(sweep).objects == ("toy_bunny", "toy_cube")
    assert all(table.key.startswith("toy_bunny") for table in record_of(sweep).tables)


def test_rows_of_different_sequences_are_told_apart(sweep: Path) -> None:
    runs = find_runs([sweep])
    entry = next(run for run in runs if "no_mass" in run.name).objects["toy_bunny"]
    entry["sequences"] = ["a"]
    first = measured_record(make_study(runs), "Sweep").tables[0]
    assert "Rows of different sequences cannot be compared: gausim: a, b; gausim w/o mass: a." in first.caption
    cell = first.rows[1].cells[0]
    assert isinstance(cell, Figure) and cell.std is None  # over one sequence there is none


def test_results_come_with_commit_command_and_hardware(sweep: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path in sweep.rglob(".hydra/hydra.yaml"):
        hydra = yaml.safe_load(path.read_text())
        own = [f"seed={path.parents[1].name[-1]}", "experiment=tables/ablations", "data.names=[a]"]
        hydra["hydra"] |= {"mode": "MULTIRUN", "overrides": {"task": own}}
        path.write_text(yaml.safe_dump(hydra))
    words = ["experiment=tables/ablations", "seed=0,1", "data.names=[a]"]
    (sweep / "multirun.yaml").write_text(yaml.safe_dump({"hydra": {"overrides": {"task": words}}}))
    out = sweep.parent / "results"
    assert cli.main(["report", str(sweep), "--results", str(out), "--record", str(out / "sweep.json")]) == 0
    assert "tables: file://" in (said := capsys.readouterr().out) and "record: file://" in said
    text = (out / "results.md").read_text()
    command = "gausim train -m experiment=tables/ablations seed=0,1 'data.names=[a]'"
    assert r"* Without figures: no\_hierarchy/seed\_0 (failed)" in text
    assert f"* Command: `{command}`" in text and "* Commits: c0ffeec0ffee" in text and "* Hardware: " in text
    assert "| gausim | **11.00 ± 1.41 (± 5.52)** |" in text
    # Another sweep of the same name has taken the place of the first.
    (sweep / "multirun.yaml").write_text(yaml.safe_dump({"hydra": {"overrides": {"task": [*words, "model=other"]}}}))
    commands = {run.command for run in find_runs([sweep / "full"])}
    assert commands == {f"gausim train seed={i} experiment=tables/ablations 'data.names=[a]'" for i in (0, 1)}
    latex = (out / "tables.tex").read_text()
    assert (
        latex.count(r"\begin{tabular}") == latex.count(r"\end{tabular}") == len(load_record(out / "sweep.json").tables)
    )
    assert f"% Command: {command}" in latex
    assert cli.main(["report", str(sweep / "no_hierarchy"), "--results", str(out)]) == 2
    assert "no run here is evaluated" in capsys.readouterr().err
    assert cli.main(["report", "--results", str(out)]) == 2
    assert "DIR: expected run directories" in capsys.readouterr().err


def test_commands_that_differ_by_one_key_are_joined_to_the_same_runs() -> None:
    start = "gausim train experiment=tables/comparison"
    jobs = [f"{start} method={m} seed={s} ++plan.clock=cpu paths.output_root=/x" for m in "ab" for s in (0, 1)]
    jobs += [f"{start} method=c seed=0 ++plan.clock=cpu paths.output_root=/x", "gausim train model=m init_from=o/r"]
    assert joined(jobs) == [
        f"gausim train -m {start[13:]} method=a,b seed=0,1 plan.clock=cpu",
        f"gausim train {start[13:]} method=c seed=0 plan.clock=cpu",
        "gausim train model=m init_from=o/r",
    ]
    assert joined(
        ["gausim train -m 'data.sequences=[a,b]' seed=0,1", "gausim train 'data.sequences=[a,b]' seed=2"]
    ) == ["gausim train -m 'data.sequences=[a,b]' seed=0,1,2"]
    assert joined(
        ["gausim train -m method=b,a seed=0", "gausim train method=a seed=1", "gausim train method=b seed=1"]
    ) == ["gausim train -m method=a,b seed=0,1"]
    assert joined(["gausim train paths.output_root=/x/y init_from=/x/y/run", "not recorded"]) == [
        "gausim train init_from=outputs/run", "not recorded",
    ]  # fmt: skip


def record(*rows: Row, columns: list[Column], **options: object) -> Record:
    table = RecordTable("t", columns, list(rows), **options)  # type: ignore[arg-type]
    return Record(SCHEMA, "Title", Made("2026-01-01", ["abc"], ["gausim train"]), [table], {"minutes": 0.5, "of": "6"})


def test_figures_as_printed() -> None:
    columns = [Column("low", 1, "low"), Column("one", 2, "one"), Column("as stored", None), Column("high", 2, "high")]
    rows = [
        Row(["a"], [1.24, 1.2, 0.0001, Figure(0.5, [0.4, 0.6])]),
        Row(["b"], [1.16, 0.8, 12345.0, Figure(0.75, seed_std=0.0, std=0.125)]),
        Row(["c"], [0.0, None, "6 to 7", None]),
        Row(["truth"], [-1.0, 1.0, None, 9.0], reference=True),
    ]
    lines = markdown_table(record(*rows, columns=columns).tables[0]).splitlines()
    assert lines[2:] == [
        "| a | 1.2 | **1.20** | .0001 | .40, .60 |",
        "| b | 1.2 | **.80** | 12,345 | **.75 ± .00 (± .12)** |",
        "| c | **0** | | 6 to 7 | |",
        "| truth | -1.0 | 1.00 | | 9.00 |",
    ]
    grouped = [Row(["x", "a"], [1.0]), Row(["x", "b"], [2.0]), Row(["y", "a"], [3.0]), Row(["y", "b"], [2.5])]
    table = record(*grouped, columns=[Column("low", 1, "low")], stub=["object", "row"], groups=1).tables[0]
    assert [line.split("|")[3].strip() for line in markdown_table(table).splitlines()[2:]] == [
        "**1.0**", "2.0", "3.0", "**2.5**",
    ]  # fmt: skip


def test_pages_name_records(tmp_path: Path) -> None:
    made = record(Row(["a"], [1.0]), columns=[Column("l2", 1)])
    save_record(tmp_path / "mine.json", made)
    template = '## A {#a}\n{{ mine.minutes }} of {{ mine.of }}\n\n{{ table("mine", "t") }}\n\n{{ made("mine") }}\n'
    (tmp_path / "page.md").write_text(template)
    text = page(tmp_path)
    assert "## A {#a}\n.5 of 6\n" in text and "| a | 1.0 |" in text and "Made by (abc; recorded 2026-01-01)" in text
    assert "\n    gausim train\n" in text
    made.made.test = "Looked at once."
    save_record(tmp_path / "mine.json", made)
    assert page(tmp_path) == (text := text.replace("Made by (", "Looked at once.\n\nMade by ("))
    made.tables[0].rows[0].cells[0] = 1.1
    save_record(tmp_path / "mine.json", made)
    assert page(tmp_path) == text.replace("| a | 1.0 |", "| a | 1.1 |")
    for wrong, message in (("table('mine', 'u')", "no table 'u'"), ("table('no', 't')", "record 'no', expected one of"),
                           ("mine.hours", "cannot be made into a page")):  # fmt: skip
        (tmp_path / "page.md").write_text(f"{{{{ {wrong} }}}}")
        with pytest.raises(RunError, match=message):
            page(tmp_path)
    (tmp_path / "mine.json").write_text("{}")
    with pytest.raises(RunError, match=r"mine\.json: expected a record"):
        page(tmp_path)


def test_a_damaged_record_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    save_record(path, record(Row(["a"], [1.0]), columns=[Column("l2")]))
    path.write_text(path.read_text().replace('"cells": [1.0]', '"cells": [1.0, 2.0]'))
    with pytest.raises(RunError, match=r"row \['a'\]: expected 1 labels and 1 cells, got 1 and 2"):
        load_record(path)
    path.write_text(path.read_text().replace(SCHEMA, "gausim.record/0").replace("[1.0, 2.0]", "[1.0]"))
    with pytest.raises(RunError, match="field 'schema' is 'gausim.record/0'"):
        load_record(path)


def test_whole_pages_of_one_record() -> None:
    made = record(Row(["a"], [1.0]), columns=[Column("l2", 1)])
    made.made.test = "Looked at once."
    assert "# Title\n\nLooked at once.\n\n* Recorded: 2026-01-01" in results_page(made)
    assert "Looked at once." in results_latex(made)


# ------------------------------------------------------------ LaTeX, by its text: no LaTeX is needed to run this


def check(text: str) -> None:
    """What TeX would refuse: unknown commands, groups and environments that do not nest, specials as text."""
    body = re.sub(r"(?m)(?<!\\)%.*$", "", text)
    assert set(re.findall(r"\\([A-Za-z]+)", re.sub(r"\\\\", "", body))) <= KNOWN
    bare = re.sub(r"\\[&%$#_{}\\]", "", body)  # without what is escaped
    depth, environments = 0, []
    for brace, kind, name in re.findall(r"([{}])|\\(begin|end)(?=\{(\w+))", bare):
        depth += {"{": 1, "}": -1}.get(brace, 0)
        assert depth >= 0
        if kind == "begin":
            environments.append(name)
        elif kind:
            assert environments.pop() == name
    assert depth == 0 and environments == []
    assert not set("$^_#~%") & set(re.sub(r"\$[^$\n]*\$", "", bare))
    assert "&" not in re.sub(r"\\begin\{tabular\}.*?\\end\{tabular\}", "", bare, flags=re.S)


@pytest.fixture
def latex(sweep: Path) -> str:
    evaluate(write_run(sweep / "other", config(name=HOSTILE), model=None), make_curves(2.0, name=HOSTILE))
    page_of(sweep, pictures=False)
    return (sweep / "report" / "tables.tex").read_text()


def test_everything_nests_and_is_escaped(latex: str) -> None:
    check(latex)
    assert "etc/passwd" in latex  # the hostile name is there, as text
    assert not [c for c in re.sub(r"(?m)(?<!\\)%.*$", "", latex) if ord(c) > 126]


def test_rows_fill_their_columns_between_rules_of_booktabs(latex: str) -> None:
    tables = re.findall(r"\\begin\{tabular\}\{(lc+)\}\n(.*?)\\end\{tabular\}", latex, re.S)
    assert len(tables) == latex.count(r"\begin{table*}") == latex.count(r"\caption{") > 6
    for columns, table in tables:
        assert re.findall(r"^\\(top|mid|bottom)rule$", table, re.M) == ["top", "mid", "bottom"]
        rows = [line for line in table.splitlines() if not line.endswith("rule")]
        assert all(row.endswith(r" \\") and len(re.split(r"(?<!\\)&", row)) == len(columns) for row in rows)
    labels = re.findall(r"\\label\{(.*?)\}", latex)
    assert len(set(labels)) == len(labels) and all(re.fullmatch(r"tab:[A-Za-z0-9-]+", label) for label in labels)
    assert (
        r"\textbf{11.00 $\pm$ 1.41 ($\pm$ 5.52)}" in latex
        and "% Without figures: no_hierarchy/seed_0 (failed)" in latex
    )
    assert all(package in latex.splitlines()[0] for package in ("booktabs", "graphicx", "T1"))


# ---------------------------------------------------------------------------------------- the repository's own figures


def test_the_page_of_results_is_what_its_records_give() -> None:
    assert (ROOT / "docs" / "results.md").read_text() == page(ROOT / "docs" / "results"), "run `make results`"


def test_the_table_of_the_readme_is_of_the_record() -> None:
    """Its rows are some of the record's, in the record's order."""
    found = re.search(r"\[start:results\] -->\n(\|.*?)\n\n", (ROOT / "README.md").read_text(), re.DOTALL)
    table = load_record(ROOT / "docs" / "results" / "comparison.json").table("summary")
    assert found is not None
    shown, whole = found[1].splitlines(), markdown_table(table).splitlines()
    assert shown[:2] == whole[:2] and len(shown) > 4 and shown == [line for line in whole if line in shown]


def test_no_figure_is_typed_into_the_template() -> None:
    """Every decimal of the page comes from a record: the template has integers and settings only."""
    text = (ROOT / "docs" / "results" / "page.md").read_text()
    prose = re.sub(r"\{\{.*?\}\}|`[^`]*`|\]\([^)]*\)", "", text)
    assert not re.findall(r"(?<![\w.])\d*\.\d+", prose)
