"""The first screen of a report: a film and a sentence, and what stands there where one is missing."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path

from helpers.report_runs import config, evaluate, make_curves, page_of, study_of, write_run

from gausim.report.media import error_curves
from gausim.report.opening import MOST_OPENINGS, make_openings

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
