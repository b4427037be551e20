"""What an evaluation records beside its figures: costs, sources, pictures, absent metrics."""

import hashlib
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import toy_object

import gausim
from benchmarks.reference_renderer import ReferenceRenderer
from gausim.data.objects import ObjectData
from gausim.evaluation.evaluation import absent_metrics, default_metrics, evaluate_object, write_evaluation
from gausim.io.video import read_video
from gausim.metrics.lpips import expected_shapes
from gausim.pictures.frames import SEEN
from gausim.runs.provenance import code_provenance


@pytest.fixture(scope="module")
def toy(tmp_path_factory):
    return toy_object.write_toy_object(tmp_path_factory.mktemp("data") / "toy", frames=10)


class Oracle:
    levels = {"counts": [36, 4], "predicted": [1], "predictions": 3, "kernels": 36}

    def __init__(self, toy) -> None:
        self.toy = toy

    def __call__(self, record):
        return self.toy.truth(record.name)


def test_an_evaluation_says_what_it_cost_and_where_it_comes_from(toy, tmp_path):
    methods = {"oracle": Oracle(toy), "bare": lambda record: toy.truth(record.name)}
    curves = evaluate_object(ObjectData(toy.root), toy.scene, methods, ReferenceRenderer(), films=tmp_path)
    results = write_evaluation(tmp_path, [curves], {"name": "toy"})
    assert results.provenance["gausim"] == gausim.__version__
    found = {(e.row, e.metric): e.value for e in results.table if e.split == ""}
    assert found["oracle", "units"] == "36 → 4" and ("bare", "units") not in found
    assert found["oracle", "per_frame"] > 0 and found["oracle", "per_image"] > 0
    info = results.objects["toy"]
    for key, name in (("scene", "scene.ply"), ("manifest", "dataset.json")):
        expected = hashlib.sha256((toy.root / name).read_bytes()).hexdigest()
        assert info.sources[key] == {"file": name, "sha256": expected}
    assert info.absent == {"lpips": "no weights"}


def test_the_film_is_truth_prediction_and_error_in_the_view_held_out(toy, tmp_path):
    data, methods = ObjectData(toy.root), {"oracle": Oracle(toy)}
    curves = evaluate_object(data, toy.scene, methods, ReferenceRenderer(), films=tmp_path)
    assert curves.info.film.startswith("seq_000 in cam_2 (held out).")
    frames = list(read_video(tmp_path / "film_toy.mp4"))
    assert len(frames) == 10 and frames[0].shape == (24 + 480 + 24 + 8, 3 * 480, 3)
    truth, prediction, error = (frames[5][24:504, i * 480 : (i + 1) * 480].astype(int) for i in range(3))
    assert np.abs(truth - prediction).mean() < 3 < truth.std() and error.mean() < 10
    line = frames[9][-5].astype(int)
    assert np.abs(line[100] - SEEN).max() < 16 and line[-100, 0] > 200 > line[-100, 2]  # blue, then orange


def test_lpips_is_measured_where_its_weights_are(monkeypatch, tmp_path):
    from safetensors.torch import save_file

    assert [m.key for m in default_metrics()] == ["l2", "l2_foreground", "psnr", "psnr_foreground", "ssim"]
    save_file({n: torch.ones(s) for n, s in expected_shapes().items()}, tmp_path / "w.safetensors")
    monkeypatch.setenv("GAUSIM_LPIPS_WEIGHTS", str(tmp_path / "w.safetensors"))
    assert [m.key for m in default_metrics()][-1] == "lpips" and absent_metrics(31) == {}
    assert absent_metrics(30) == {"lpips": "images under 31 pixels"} and len(default_metrics(30)) == 5


def git(folder: Path, *arguments: str) -> str:
    identity = ["-c", "user.name=t", "-c", "user.email=t@example.org"]
    command = ["git", "-C", str(folder), *identity, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def test_the_commit_of_the_package_and_whether_it_was_changed(tmp_path):
    package = tmp_path / "src" / "gausim"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    assert code_provenance(package)["commit"] is None
    git(tmp_path, "init", "-q")
    assert code_provenance(package)["commit"] is None  # in a repository that does not hold it
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-q", "-m", "first")
    found = code_provenance(package)
    assert (found["commit"], found["modified"]) == (git(tmp_path, "rev-parse", "HEAD"), False)
    (package / "__init__.py").write_text("x = 1")
    assert code_provenance(package)["modified"] is True
