from __future__ import annotations

from helpers import report_runs

from gausim.cli import main as cli


def test_the_whole_report(tmp_path, capsys):
    sweep = report_runs.write_sweep(tmp_path / "sweep")
    assert cli.main(["report", str(sweep)]) == 0
    shown = capsys.readouterr()
    files = ["report.html", "results.md", "tables.tex", "numbers.csv"]
    assert sorted(p.name for p in (sweep / "report").iterdir()) == sorted(files)
    lines = shown.out.splitlines()
    assert lines[-4] == f"page: {(sweep / 'report' / 'report.html').as_uri()}" and len(lines) == 6
    assert [line.split("gausim ")[1].split()[0] for line in lines[-3:]] == ["view", "simulate", "train"]
    assert lines[1].startswith(
        "toy_bunny, predicted by gausim: On frames never seen (16–49; mean of 2 seeds), its points"
    )
    assert (
        "wrote" not in shown.out
        and "5 runs: 3 evaluated, 1 failed, 1 unfinished" in shown.out
        and "pictures of toy_bunny" in shown.err
    )
    page = (sweep / "report" / "report.html").read_text()
    # Three pictures, three videos of runs with a poster each, and one of both rows side by side.
    kinds = [page.count(f"data:{kind};base64,") for kind in ("image/webp", "image/jpeg", "video/mp4")]
    assert kinds == [3, 3, 4]
    # The report does not take itself for a run.
    folders = [str(sweep / "full"), str(sweep / "no_mass")]
    out = tmp_path / "elsewhere"
    assert cli.main(["report", str(sweep), "--out", str(out), "--no-pictures"]) == 0
    assert "5 runs: 3 evaluated, 1 failed, 1 unfinished" in capsys.readouterr().out
    assert cli.main(["report", *folders, "--out", str(out), "--title", "Mine & yours", "--no-pictures"]) == 0
    page = (out / "report.html").read_text()
    assert "<h1>Mine &amp; yours</h1>" in page and "data:image" not in page
    assert not (sweep / "full" / "report").exists()
    assert cli.main(["report", str(tmp_path / "nowhere")]) == 2
    assert "no such directory" in capsys.readouterr().err
    assert not (tmp_path / "nowhere").exists()
