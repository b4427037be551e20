"""Reports of bodies that fall or are moved by hands: the reference's name, bounces and errors by frames ahead."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from helpers.report_runs import config, evaluate, make_curves, write_run

from gausim.report.gather.runs import find_runs
from gausim.report.gather.study import Study, make_study
from gausim.report.opening import first_table
from gausim.report.records.measure import measured_record
from gausim.report.tables.motion import bounce_sheets, horizon_sheets
from gausim.report.tables.verdict import outcome, sentences

BOUNCE = {"height": 0.5, "rise": 0.2, "height_error": 0.1, "rise_error": 0.25, "depth": 0.3}


def study(root: Path, reference: str = "ballistic") -> Study:
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
    return make_study(find_runs([root]))


def test_bounces_of_methods_references_and_the_truth(tmp_path):
    (sheet,) = bounce_sheets(study(tmp_path))
    rows = {line.label: [entry.text for entry in line.entries] for line in sheet.lines}
    assert rows["gausim"] == ["0.450", "10.0 %", "0.200", "25.0 %", "0.30"]
    assert rows["ballistic"][2] == "–" and rows["truth"][1] == "0.0 %"


def test_records_have_the_bounce_with_its_deviation_over_seeds(tmp_path):
    table = measured_record(study(tmp_path), "Falling").table("toy_bunny_bounce")
    rows = {row.label[0]: row.cells for row in table.rows}
    assert [cell.mean for cell in rows["gausim"]] == pytest.approx([0.45, 10.0, 0.2, 25.0, 0.3])
    assert rows["gausim"][0].seeds == [0.4, 0.5] and rows["ballistic"][2] is None and rows["truth"][3].mean == 0.0


def test_errors_by_frames_ahead(tmp_path):
    (sheet,) = horizon_sheets(study(tmp_path))
    assert sheet.columns == (("", ("+1", "+2", "+5", "+10", "+20", "+30")),)
    rows = {line.label: [entry.text for entry in line.entries] for line in sheet.lines}
    # 100 times the l2 of 2e-3, five times that in unseen frames; twice that with the second seed.
    assert rows["gausim"] == ["1.50"] * 6 and rows["ballistic"] == ["4.00"] * 6


@pytest.mark.parametrize(
    ("reference", "words"),
    [("ballistic", "rigid flight"), ("follow hands", "the hands' motion alone"), ("static", "no motion")],
)
def test_sentences_and_first_table_name_the_reference(tmp_path, reference, words):
    found = study(tmp_path, reference)
    (group,) = found.groups
    entries = [entry for _, entry in group.entries("toy_bunny")]
    assert f"a model that predicts {words}" in sentences(outcome(entries, "gausim"))[0]
    table = first_table(found, group, "toy_bunny")
    assert f"3D error ÷ {reference} ↓" in table.head and any(row[0] == words for row in table.rows)
    assert words in table.title


def test_still_bodies_have_no_bounces(tmp_path):
    evaluate(write_run(tmp_path / "seed_0", config(0)), make_curves(1.0))
    assert bounce_sheets(make_study(find_runs([tmp_path]))) == []
