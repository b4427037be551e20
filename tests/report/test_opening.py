"""The first screen of a report: a video, two sentences, one table, and what stands there where one is missing."""

import base64
import html
import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.report_runs import config, evaluate, make_curves, page_of, write_run

from gausim.io.video import read_video
from gausim.pictures.frames import SEEN
from gausim.report.verdict import outcome, sentences
from gausim.results.curves import ImageMetricInfo
from gausim.results.pivot import Pivot
from gausim.results.table import NO_FORESIGHT, SCHEMA, Entry, Metric, ObjectInfo, Results

EVIL = "<script>alert(1)</script>&\"'|`"


def said(
    error: float | None = 0.3, seen: float | None = 0.2, energy: float | None = 0.9, *, views: str = "points",
    seeds: Sequence[float | None] = (), unseen: bool = True, repeats: bool = False,
) -> tuple[str, str]:  # fmt: skip
    """Sentences on an evaluation."""
    metric = "error_3d_ratio" if views == "points" else "l2_ratio"
    splits = {"seen": (0, 16)} | ({"unseen": (16, 50)} if unseen else {})
    table = []
    for split in splits:
        errors = (list(seeds) or [error]) if split == "unseen" else [seen]
        table += [Entry("m", "method", "o", split, views, metric, i, e) for i, e in enumerate(errors) if e is not None]
        if energy is not None:
            table.append(Entry("m", "method", "o", split, views, "motion_energy", None, energy))
    info = ObjectInfo(splits, methods=["m"], notes={"m": [NO_FORESIGHT] * repeats})
    metrics = {m: Metric(m) for m in (metric, "motion_energy")}
    pivot = Pivot(Results(SCHEMA, objects={"o": info}, metrics=metrics, table=table))
    return sentences(outcome(pivot, "o", "m", info))


@pytest.mark.parametrize(
    ("sentence", "error", "seen", "energy", "words"),
    [
        (0, 0.199, 0.1, 0.9, "it predicts most of the motion"),  # printed as 0.20
        (0, 0.97, 0.5, 0.9, "no better than predicting no motion, although it learned the frames it was trained on"),
        (0, 1.4, 0.95, 0.9, "worse than predicting no motion, and it learned no more of the frames it was trained on"),
        (1, 0.95, 0.2, 1.0, "it moves as much as the object, but not as the object does"),
        (1, 2.0, 0.2, 7.0, "it gains energy that the object does not have"),
    ],
)
def test_mediocre_failed_and_too_lively_runs_are_called_so(sentence, error, seen, energy, words):
    assert said(error, seen, energy)[sentence].endswith(f"{words}.")


def with_psnr(error: float, name: str = "toy_bunny") -> Any:
    """Curves with a PSNR that goes with their l2, and the second view held out (as their pictures have it)."""
    curves = make_curves(error, name=name)
    psnr = ImageMetricInfo("psnr", "PSNR", 1.0, "dB", True)
    for row in ("gausim", "static"):
        curves.values[row]["psnr"] = -10 * np.log10(curves.values[row]["l2"])
    return replace(curves, facts=replace(curves.facts, metrics=(*curves.facts.metrics, psnr)))


def first_screen(page: str) -> str:
    return page.split("<details", 1)[0]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    root = tmp_path_factory.mktemp("one")
    evaluate(write_run(root / "a", config()), with_psnr(1.0))
    return page_of(root)


def test_the_first_screen_is_a_video_two_sentences_and_a_small_table(page: str):
    first = first_screen(page)
    assert first.count("<video") == 1 and 'src="data:video/mp4;base64,' in first and "autoplay" in first
    text = re.search(r'<div class="sentences">(.*?)</div>', first, re.S)[1]
    assert len(re.findall(r"<p>[^<]+\.</p>", text)) == 2 and "0.25 times as far off" in text
    assert first.count("<table") == 1
    assert re.findall(r"<th>(.*?)</th>", first) == [
        "frames", "PSNR [dB]", "PSNR [dB], new views", "SSIM [1e-1]", "3D ÷ static", "motion energy", "seen 0–15",
        "unseen 16–49", "no motion",
    ]  # fmt: skip
    row = re.search(r"<th>unseen 16–49</th>.*?</tr>", first, re.S)[0]
    assert re.findall(r">([\d.]+)<", row) == ["20.62", "20.62", "9.90", "0.250", "0.50"]
    assert "LPIPS: its weights were not there" in first and page.count("<details") >= 5


def test_the_video_is_truth_prediction_and_error_in_the_view_never_trained_on(page: str, tmp_path: Path):
    assert "a in y (never trained on), at half speed" in page
    (tmp_path / "v.mp4").write_bytes(base64.b64decode(re.search(r'data:video/mp4;base64,([^"]+)', page)[1]))
    frames = list(read_video(tmp_path / "v.mp4"))
    assert len(frames) == 20 and frames[0].shape == (264 + 8, 3 * 352, 3)
    truth, prediction, error = (frames[10][:264, i * 352 : (i + 1) * 352].astype(int) for i in range(3))
    at = [float(np.nonzero((p[..., 0] > 180).any(0))[0].mean()) for p in (truth, prediction)]
    assert at[1] - at[0] == pytest.approx(22, abs=4)  # two pixels of 32, eleven times as large
    assert error.mean() < truth.mean() and error.max() > 150
    line = frames[10][-5].astype(int)
    assert np.abs(line[100] - SEEN).max() < 12 and line[500, 0] > 200 > line[500, 2]  # blue, then orange


def test_what_is_missing_is_named_with_the_command_that_makes_it(tmp_path: Path):
    trained = write_run(tmp_path / "my run", config())
    failed = write_run(tmp_path / "failed", config(conserve_mass=False), finished=False)
    (failed / "FAILED").write_text("RuntimeError: out of memory")
    first = html.unescape(first_screen(page_of(tmp_path)))
    assert "Nothing has been evaluated" in first and f"<code>gausim evaluate '{trained}'</code>" in first
    assert "failed (RuntimeError: out of memory)" in first and "<video" not in first

    (evaluate(trained, with_psnr(1.0)) / "evaluation" / "pictures.npz").unlink()
    first = html.unescape(first_screen(page_of(trained)))
    assert "There is no video:" in first and f"<code>gausim evaluate {trained}</code>" in first
    assert first.count("<table") == 1


def test_hostile_names_stay_text_on_the_first_screen(tmp_path: Path):
    name = EVIL.replace("/", "∕")
    curves = with_psnr(1.0, name)
    evil = replace(curves.pictures, object=name, sequence=EVIL, views=("x", EVIL), heldout_views=(EVIL,))
    run = evaluate(write_run(tmp_path / name, config(name=EVIL), model=EVIL), replace(curves, pictures=evil))
    summary = json.loads((run / "evaluation" / "metrics.json").read_text())
    summary["objects"][name]["heldout_views"] = [EVIL]
    (run / "evaluation" / "metrics.json").write_text(json.dumps(summary))
    write_run(tmp_path / "b", config(name=EVIL, conserve_mass=False), model=EVIL)
    page = page_of(tmp_path, title=EVIL)
    assert "<script" not in page and first_screen(page).count("&lt;script&gt;") >= 4 and "<video" in page
    assert "<script>" not in (tmp_path / "report" / "results.md").read_text().replace("\\<script\\>", "")
