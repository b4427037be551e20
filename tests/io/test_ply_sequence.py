"""Numbered PLY files come back bit for bit, and incomplete or mixed folders are refused."""

from pathlib import Path

import pytest
import torch
from helpers.random_scene import FIELDS, random_scene

from gausim.core import DataError, GaussianScene
from gausim.io.ply_sequence import load_ply_sequence, save_ply_sequence


def frames(count: int = 3) -> list[GaussianScene]:
    return [random_scene(20, seed=number) for number in range(count)]


def test_round_trip_is_exact(tmp_path: Path) -> None:
    made = frames(12)
    written = save_ply_sequence(tmp_path / "s", "cup_2", iter(made), 23.976)
    assert [p.name for p in written][::11] == ["cup_2_0001.ply", "cup_2_0012.ply"]
    assert {p.name for p in (tmp_path / "s").iterdir()} - {p.name for p in written} == {
        "cup_2.masks.npz", "cup_2.json"
    }  # fmt: skip
    scenes, count, fps = load_ply_sequence(tmp_path / "s")
    read = list(scenes)
    assert count == len(read) == 12 and fps == 23.976
    for a, b in zip(made, read, strict=True):
        assert all(torch.equal(getattr(a, n), getattr(b, n)) for n in FIELDS) and b.volume_scale == 37.5


def test_a_folder_of_others_needs_a_rate(tmp_path: Path) -> None:
    save_ply_sequence(tmp_path, "a", frames(), 24.0)
    (tmp_path / "a.json").unlink()
    (tmp_path / "a.masks.npz").unlink()
    with pytest.raises(DataError, match="frame rate is unknown. State it"):
        load_ply_sequence(tmp_path)
    scenes, _, fps = load_ply_sequence(tmp_path, fps=12)
    assert fps == 12.0 and bool(next(scenes).simulated.all())


@pytest.mark.parametrize("text", ["", "[]", '{"fps": "24"}', '{"fps": NaN}', '{"fps": 0}', '{"fps": true}'])
def test_broken_rates_are_refused(tmp_path: Path, text: str) -> None:
    save_ply_sequence(tmp_path, "a", frames(), 24.0)
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(DataError, match="a.json: .*(fps|JSON)"):
        load_ply_sequence(tmp_path)


def test_incomplete_and_mixed_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such folder"):
        load_ply_sequence(tmp_path / "none")
    with pytest.raises(DataError, match="expected files NAME_0001.ply"):
        load_ply_sequence(tmp_path)
    with pytest.raises(DataError, match="no frames to write"):
        save_ply_sequence(tmp_path / "e", "a", [], 24.0)
    written = save_ply_sequence(tmp_path / "s", "a", frames(4), 24.0)
    with pytest.raises(DataError, match="holds 'a_0001.ply' already"):
        save_ply_sequence(tmp_path / "s", "a", frames(1), 24.0)
    (tmp_path / "s" / "a_00002.ply").write_bytes(written[1].read_bytes())
    with pytest.raises(DataError, match="a number before 2 is missing, or stands there twice"):
        load_ply_sequence(tmp_path / "s")
    (tmp_path / "s" / "a_00002.ply").unlink()
    written[2].unlink()
    with pytest.raises(DataError, match="a number before 4 is missing"):
        load_ply_sequence(tmp_path / "s")
    save_ply_sequence(tmp_path / "s", "b", frames(1), 24.0)
    with pytest.raises(DataError, match="of one sequence, got ..a., .b.."):
        load_ply_sequence(tmp_path / "s")
