"""Packed stores: the same images, cameras and samples as the files they were made of, in bounded memory."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import toy_object
from helpers.plain import edit_json

from data_prep.pack import pack
from gausim.data.dataset import SampleKey, SequenceIndex
from gausim.data.images import composite
from gausim.data.objects import ObjectData
from gausim.data.verify import verify
from gausim.io.packed import HEADER, bounding_box, read_packed


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return toy_object.write_toy_object(tmp_path_factory.mktemp("data") / "toy", frames=9).root


@pytest.fixture(scope="module")
def packed(toy: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    store = tmp_path_factory.mktemp("stores") / "toy"
    pack(toy, store, margin=0)
    return store


def test_a_packed_object_gives_the_same_samples(toy: Path, packed: Path) -> None:
    for frames in (range(9), range(3, 5)):
        for ours, theirs in zip(ObjectData(packed).sequences, ObjectData(toy).sequences, strict=True):
            views = ["cam_2", "cam_0"]
            found, expected = (composite(record.frames(frames, views)) for record in (ours, theirs))
            assert torch.equal(found[0], expected[0]) and torch.equal(found[1], expected[1])
            assert float(found[1].amax()) > 0
            a, b = ours.cameras_of(views), theirs.cameras_of(views)
            assert torch.equal(a.viewmats, b.viewmats) and torch.equal(a.Ks, b.Ks) and a.names == b.names
    samples = [SequenceIndex([ObjectData(root)])[SampleKey(1, 4)] for root in (packed, toy)]
    assert samples[0].facts == samples[1].facts
    assert torch.equal(composite(samples[0].frames)[0], composite(samples[1].frames)[0])


def test_only_the_foreground_is_stored_in_a_box_with_its_margin(toy: Path, packed: Path) -> None:
    share = json.loads((packed / "stage.json").read_text())["results"]["share"]
    assert 0.1 < share < 0.9  # the block fills most of these small images
    folder = packed / "sequences" / "seq_000"
    record = ObjectData(toy).sequences[0]
    for column, (top, left) in enumerate(read_packed(folder).corners):
        touched = (record.frames(range(9), [record.views[column]])[:, 0, ..., 3] > 0).any(0)
        rows, columns = touched.any(1).nonzero()[:, 0], touched.any(0).nonzero()[:, 0]
        assert (top, left) == (int(rows[0]), int(columns[0]))
        stored = np.load(folder / f"view_{column}.npy")
        assert stored.shape[1:3] == (int(rows[-1]) + 1 - top, int(columns[-1]) + 1 - left)
    names = {str(p.relative_to(toy)) for p in toy.rglob("*") if p.is_file() and "cam_" not in str(p)}
    kept = {str(p.relative_to(packed)) for p in packed.rglob("*") if p.is_file()}
    assert {n for n in names if "transforms.json" not in n or n.startswith("static")} <= kept
    alpha = np.zeros((3, 5, 7), np.uint8)
    assert alpha[0][bounding_box(alpha, 2)].size == 0
    alpha[1, 0, 6], alpha[2, 3, 4] = 1, 255
    assert bounding_box(alpha, 1) == (slice(0, 5), slice(3, 7))


@pytest.fixture
def store(toy: Path, tmp_path: Path) -> Path:
    pack(toy, tmp_path / "store")
    return tmp_path / "store"


def _header(change: Callable[[dict], object]) -> Callable[[Path], object]:
    return lambda store: edit_json(store / "sequences/seq_000" / HEADER, change)


FAULTS: dict[str, tuple[Callable[[Path], object], str, str]] = {
    "pixels cut": (lambda s: _cut(s / "sequences/seq_001/view_1.npy"), "seq_001", "view_1.npy: cannot be read"),
    "nan": (_header(lambda d: d["views"][1]["viewmat"][0].__setitem__(3, float("nan"))), "seq_000", "as JSON"),
    "corner": (_header(lambda d: d["views"][0].update(left=30)), "seq_000", "expected 9 frames inside"),
    "frames": (lambda s: np.save(s / "sequences/seq_000/view_2.npy", np.zeros((8, 1, 1, 4), np.uint8)), "seq_000",
               "got 8"),
    "fps": (_header(lambda d: d.update(fps=25)), "seq_000", "fps"),
    "view": (_header(lambda d: d["views"][0].update(name="cam_9")), "seq_000", "cam_9"),
    "facts": (lambda s: edit_json(s / "dataset.json", lambda d: d.update(fps=-1)), "dataset.json", "fps"),
    "stranger": (lambda s: (s / "notes.txt").write_text("x"), "notes.txt", "not in stage.json"),
    "no sequences": (lambda s: shutil.rmtree(s / "sequences"), "sequences", "holds no sequence"),
}  # fmt: skip


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_is_named(store: Path, name: str) -> None:
    assert verify(store) == []
    damage, where, what = FAULTS[name]
    damage(store)
    found = verify(store)
    assert any(where in fault.where and re.search(what, fault.what) for fault in found), found


def test_all_faults_at_once(store: Path) -> None:
    pixels = store / "sequences" / "seq_000" / "view_0.npy"
    data = pixels.read_bytes()
    pixels.write_bytes(data[:-1] + bytes([data[-1] ^ 255]))
    (store / "sequences" / "seq_001" / HEADER).unlink()
    (store / "scene.masks.npz").write_bytes(b"nothing")
    places = {fault.where for fault in verify(store)}
    assert {"sequences/seq_000/view_0.npy", "sequences/seq_001", "scene.ply"} <= places
    quick = {fault.where for fault in verify(store, quick=True)}
    assert "sequences/seq_001" in quick and "sequences/seq_000/view_0.npy" not in quick
