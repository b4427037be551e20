import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from helpers.corpus import write_corpus
from safetensors.torch import load_file, save_file

from gausim.core import DataError
from gausim.data.corpus import MANIFEST, Corpus

SHARD, NAME = "shard_00001.safetensors", "beam2"


def test_a_body_is_read_as_it_was_written_and_missing_files_are_named(tmp_path: Path) -> None:
    corpus = Corpus(write_corpus(tmp_path / "corpus"))
    body, written = corpus.body(2), load_file(corpus.path / SHARD)
    assert len(corpus) == 3 and body.name == NAME and body.fps == 24 and body.record.shard == SHARD
    assert body.positions.shape == (2, 24, 81, 3) and body.pinned.dtype == torch.bool
    moved = (body.positions - body.rest) / body.record.diagonal
    torch.testing.assert_close(moved, written[f"{NAME}.displacement"].float(), rtol=0, atol=1e-6)
    assert moved.abs().max() > 0.01 and not moved[:, :, body.pinned].any()
    for field in ("rest", "scale", "stiffness", "density", "damping"):
        assert torch.equal(getattr(body, field), written[f"{NAME}.{field}"])
    with pytest.raises(DataError, match="manifest.json: not found. Make a corpus"):
        Corpus(tmp_path)
    root = write_corpus(tmp_path / "corpus")
    (root / SHARD).unlink()
    with pytest.raises(DataError, match=f"{SHARD}: not found, though"):
        Corpus(root)


def changed(field: str, change: Callable[[torch.Tensor], torch.Tensor | None]) -> Callable[[Path], None]:
    """Damage to one tensor; None removes it."""

    def damage(root: Path) -> None:
        tensors = load_file(root / SHARD)
        tensors[f"{NAME}.{field}"] = change(tensors[f"{NAME}.{field}"])
        save_file({name: tensor for name, tensor in tensors.items() if tensor is not None}, root / SHARD)

    return damage


def truncated(root: Path) -> None:
    (root / SHARD).write_bytes((root / SHARD).read_bytes()[:-9])


@pytest.mark.parametrize(("damage", "message"), [
    (changed("rest", lambda x: None), rf"{SHARD}: tensor '{NAME}.rest' is missing"),
    (changed("rest", lambda x: x[:-1]), rf"{NAME}.rest' is torch.float32 \(80, 3\), expected .* \(81, 3\)"),
    (changed("displacement", lambda x: x * torch.inf), "displacement' has values that are no finite"),
    (changed("stiffness", lambda x: -x), "stiffness' has values that are not positive"),
    (truncated, rf"{SHARD}: cannot be read as safetensors"),
])  # fmt: skip
def test_damaged_bodies_are_named(tmp_path: Path, damage: Callable[[Path], None], message: str) -> None:
    corpus = Corpus(write_corpus(tmp_path / "corpus"))
    damage(corpus.path)
    with pytest.raises(DataError, match=message):
        corpus.body(2)
    assert corpus.body(0).name == "beam0"  # in another shard


@pytest.mark.parametrize(("key", "value", "message"), [
    ("schema", "gausim.corpus/9", "field 'schema' is 'gausim.corpus/9', expected"),
    ("bodies", [], "bodies"),
])  # fmt: skip
def test_a_damaged_manifest_is_named(tmp_path: Path, key: str, value: object, message: str) -> None:
    path = write_corpus(tmp_path / "corpus") / MANIFEST
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    with pytest.raises(DataError, match=re.escape(str(path)) + ".*" + message):
        Corpus(path.parent)
