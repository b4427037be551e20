from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

from gausim.cli import main as cli

MADE = runpy.run_path(str(Path(__file__).parents[1] / "report" / "report_runs.py"))


@pytest.fixture
def sweep(tmp_path) -> Path:
    return MADE["write_sweep"](tmp_path / "sweep")


def test_the_whole_report(sweep, capsys):
    assert cli.main(["report", str(sweep)]) == 0
    shown = capsys.readouterr()
    files = ["report.html", "report.md", "tables.tex", "numbers.csv"]
    assert sorted(p.name for p in (sweep / "report").iterdir()) == sorted(files)
    assert all(f"wrote {sweep / 'report' / name}" in shown.out for name in files)
    assert "5 runs: 3 evaluated, 1 failed, 1 unfinished" in shown.out and "pictures of toy_bunny" in shown.err
    page = (sweep / "report" / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 4 and page.count("data:video/mp4;base64,") == 1
    # Made again, the report does not take itself for a run and comes out the same (but for the video's encoder).
    assert cli.main(["report", str(sweep)]) == 0
    again = (sweep / "report" / "report.html").read_text()
    assert re.sub(r"data:video[^\"]+", "", again) == re.sub(r"data:video[^\"]+", "", page)


def test_several_places_without_pictures(sweep, tmp_path, capsys):
    folders = [str(sweep / "full"), str(sweep / "no_mass")]
    out = tmp_path / "elsewhere"
    assert cli.main(["report", *folders, "--out", str(out), "--title", "Mine & yours", "--no-pictures"]) == 0
    page = (out / "report.html").read_text()
    assert "<h1>Mine &amp; yours</h1>" in page and "data:image" not in page
    assert not (sweep / "full" / "report").exists()


def test_nothing_there_is_an_error(tmp_path, capsys):
    assert cli.main(["report", str(tmp_path / "nowhere")]) == 2
    assert "no such directory" in capsys.readouterr().err
    assert not (tmp_path / "nowhere").exists()
