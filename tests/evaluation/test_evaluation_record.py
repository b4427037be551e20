"""What an evaluation records beside its figures: costs, sources, pictures, absent metrics."""

import hashlib
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import toy_object

import gausim
from gausim.core import Rendered
from gausim.data.objects import ObjectData
from gausim.evaluation.evaluation import absent_metrics, default_metrics, evaluate_object, write_evaluation
from gausim.evaluation.recorder import PictureRecorder
from gausim.metrics.lpips import expected_shapes
from gausim.render.reference import ReferenceRenderer
from gausim.results.pictures import load_pictures
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
    curves = evaluate_object(ObjectData(toy.root), toy.scene, methods, ReferenceRenderer())
    results = write_evaluation(tmp_path, [curves], {"name": "toy"})
    assert results.provenance["gausim"] == gausim.__version__
    found = {(e.row, e.metric): e.value for e in results.table if e.split == ""}
    assert found["oracle", "units"] == "36 → 4" and ("bare", "units") not in found
    assert found["oracle", "per_frame"] > 0 and found["oracle", "per_image"] > 0
    info = results.objects["toy"]
    for key, name in (("scene", "scene.ply"), ("manifest", "dataset.json")):
        expected = hashlib.sha256((toy.root / name).read_bytes()).hexdigest()
        assert info.sources[key] == {"file": name, "sha256": expected}
    (pictures,) = load_pictures(tmp_path / "pictures.npz")
    assert (pictures.sequence, pictures.views, pictures.heldout_views) == ("seq_000", toy_object.VIEWS, ("cam_2",))
    difference = pictures.truth.astype(int) - pictures.predictions["oracle"]
    assert pictures.truth.shape == (10, 3, 32, 32, 4) and np.abs(difference).max() <= 2
    assert pictures.background is None and info.absent == {"lpips": "no weights"}


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


def recorded(frames: int = 2, size: int = 8) -> torch.Tensor:
    """Straight alpha; the left half is the object, red; behind it the wall is blue, and grey where nothing ever is."""
    pixels = torch.zeros(frames, 3, size, size, 4, dtype=torch.uint8)
    pixels[..., 2] = 200
    pixels[..., : size // 2, :] = torch.tensor([255, 0, 0, 255], dtype=torch.uint8)
    return pixels


def test_pictures_keep_the_background_that_was_seen(toy):
    recorder = PictureRecorder(ObjectData(toy.root), "seq_000", toy_object.VIEWS)
    first, second = recorded(), recorded()
    second[:, :, :, 2:4] = torch.tensor([0, 0, 100, 0], dtype=torch.uint8)  # the object uncovers two columns
    drawn = {"ours": Rendered(torch.full((2, 3, 8, 8, 3), 0.5), torch.full((2, 3, 8, 8), 0.5))}
    recorder.add(first, drawn)
    recorder.add(second, drawn)
    pictures = recorder.finish()
    assert pictures.truth.shape == (4, 3, 8, 8, 4) and pictures.truth[0, 0, 0, 0].tolist() == [255, 0, 0, 255]
    assert pictures.truth[0, 0, 0, 7].tolist() == [0, 0, 0, 0]  # premultiplied
    assert pictures.predictions["ours"][3, 2, 0, 0].tolist() == [128] * 4
    blue = pictures.background[0, 0, :, 2].tolist()
    # Covered throughout: the mean of what was seen, weighted by how often; uncovered: 100; always free: 200.
    assert blue[2:] == [100, 100, 200, 200, 200, 200] and blue[0] == blue[1] == round((2 * 100 * 2 + 4 * 200 * 4) / 20)
