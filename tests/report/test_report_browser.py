"""The page of a report in Chromium: its video plays, runs are chosen without a script, nothing overflows a phone."""

import time
from pathlib import Path
from typing import Any

import numpy as np
from helpers import chromium, report_runs

from gausim.io.video import write_video

chromium, pytestmark = chromium.chromium, chromium.needs_chromium
PLAYING = "[...document.querySelectorAll('.film video')].map(v => !v.paused && v.currentTime > 0 && v.videoWidth > 0)"


def playing(page: Any) -> list[bool]:
    return page.run(PLAYING)


def test_the_page_plays_and_fits(tmp_path: Path) -> None:
    from gausim.report.write import write_report

    root = report_runs.write_sweep(tmp_path / "sweep")
    for run in root.rglob("config.yaml"):
        (run.parent / "page.html").touch()
    for film in root.rglob("film_*.mp4"):
        write_video(film, [np.full((32, 96, 3), 8 * f, np.uint8) for f in range(24)], 12)
    write_report([root], root / "report")
    with chromium(tmp_path, size=(400, 800)) as page:
        page.open((root / "report" / "report.html").as_uri())
        page.wait(lambda: playing(page) == [True, False, False], 30, "the first video plays, the hidden ones do not")
        assert page.run("document.documentElement.scrollWidth") == 400
        page.run("document.querySelector('label[for=choose-2]').click()")
        page.wait(lambda: playing(page)[1:] == [True, False], 30, "the second video plays once it is chosen")
        shown = page.run("[...document.querySelectorAll('.opening')].map(o => o.offsetParent !== null)")
        assert shown == [False, True, False]
        page.run("document.querySelectorAll('details').forEach(d => d.open = true)")
        time.sleep(0.3)
        assert page.run("document.documentElement.scrollWidth") == 400
        page.run("document.querySelectorAll('details').forEach(d => d.open = false)")
        assert page.run("[...document.querySelectorAll('.opening a')].some(a => a.href.endsWith('/page.html'))")
        assert not page.problems and all(r.startswith(("file:", "data:")) for r in page.requests)
