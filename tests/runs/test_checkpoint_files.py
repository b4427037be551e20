import errno
import io
import os
import pickle
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import nn

from gausim.core import GaussianScene, RunError
from gausim.runs.checkpoint import AtomicCheckpointIO, check_scenes, fingerprints, load_weights, read_checkpoint
from gausim.runs.directory import RunDirectory


def scene(shift: float = 0.0) -> GaussianScene:
    means = torch.arange(12.0).reshape(4, 3) + shift
    return GaussianScene.create(
        means=means, log_scales=torch.zeros(4, 3), quats=torch.ones(4, 4), opacity_logits=torch.zeros(4),
        sh=torch.zeros(4, 1, 3), pinned=means[:, 0] < 1, name="block",
    )  # fmt: skip


def checkpoint(value: float = 1.0) -> dict:
    own: dict = {"scenes": fingerprints([scene()])}
    return {"state_dict": {"weight": torch.full((2, 3), value)}, "gausim": own}


def _no_space(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def weight(path: Path) -> float:
    """The constant of a written :func:`checkpoint`."""
    return float(read_checkpoint(path)["state_dict"]["weight"][0, 0])


def test_checkpoints_are_read_without_running_code_and_others_named(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "last.ckpt"
    AtomicCheckpointIO().save_checkpoint(checkpoint(2.0), path)
    assert float(torch.load(path, weights_only=True)["state_dict"]["weight"].sum()) == 12.0
    assert [p.name for p in path.parent.iterdir()] == ["last.ckpt"]
    path = tmp_path / "last.ckpt"
    with pytest.raises(RunError, match="no such checkpoint"):
        read_checkpoint(path)
    path.write_bytes(pickle.dumps({"state_dict": os.getcwd}, protocol=2))
    with pytest.raises(RunError, match="nothing in it was executed"):
        AtomicCheckpointIO().load_checkpoint(path)
    torch.save({"state_dict": {}}, path)
    with pytest.raises(RunError, match="expected a checkpoint of gausim"):
        read_checkpoint(path)


@pytest.mark.parametrize("failing", ["os.fsync", "os.replace", "os.open", "pathlib.Path.open"])
def test_a_failed_save_is_an_error_and_keeps_the_last_good_file(failing, tmp_path, monkeypatch) -> None:
    path = tmp_path / "last.ckpt"
    AtomicCheckpointIO().save_checkpoint(checkpoint(2.0), path)
    with monkeypatch.context() as patch:
        patch.setattr(failing, _no_space)
        with pytest.raises(RunError, match=rf"last\.ckpt: .* could not be written .*{os.strerror(errno.ENOSPC)}"):
            AtomicCheckpointIO().save_checkpoint(checkpoint(3.0), path)
    # Only where the name was taken already, and its entry in the directory could not be flushed, is it the new one.
    assert weight(path) == (3.0 if failing == "os.open" else 2.0)
    assert list(tmp_path.glob(".*")) == []


@pytest.mark.parametrize("links", [True, False])
def test_the_last_checkpoint_leaves_its_predecessor_and_others_do_not(links, tmp_path, monkeypatch) -> None:
    if not links:
        monkeypatch.setattr(os, "link", _no_space)
    for value in (1.0, 2.0, 3.0):
        for name in ("last.ckpt", "epoch_0001.ckpt"):
            AtomicCheckpointIO().save_checkpoint(checkpoint(value), tmp_path / name)
    kept = {p.name: weight(p) for p in tmp_path.iterdir()}
    assert kept == {"last.ckpt": 3.0, "last.previous.ckpt": 2.0, "epoch_0001.ckpt": 3.0}


def test_what_is_damaged_on_its_way_or_needs_code_to_read_is_not_kept(tmp_path, monkeypatch) -> None:
    path = tmp_path / "last.ckpt"
    AtomicCheckpointIO().save_checkpoint(checkpoint(2.0), path)
    with pytest.raises(RunError, match="could not be written .*nothing in it was executed"):
        AtomicCheckpointIO().save_checkpoint({**checkpoint(), "module": nn.Linear(2, 2)}, path)
    save = torch.save

    def flipped(content: object, file: io.BytesIO) -> None:
        save(content, file)
        whole = bytearray(file.getvalue())
        whole[whole.index(torch.full((2, 3), 3.0).numpy().tobytes())] ^= 1
        file.seek(0)
        file.write(whole)

    monkeypatch.setattr(torch, "save", flipped)
    with pytest.raises(RunError, match="checksum"):
        AtomicCheckpointIO().save_checkpoint(checkpoint(3.0), path)
    assert weight(path) == 2.0 and list(tmp_path.iterdir()) == [path]


def damage(path: Path, how: str) -> None:
    whole = path.read_bytes()
    at = whole.index(torch.full((2, 3), 3.0).numpy().tobytes()) + 5
    flipped = whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :]
    halves = {"truncated": whole[:-300], "empty": b"", "garbage": bytes(range(256)) * 40, "flipped": flipped}
    path.write_bytes(halves[how])


@pytest.mark.parametrize("how", ["truncated", "empty", "garbage", "flipped"])
def test_a_damaged_checkpoint_is_told_and_the_one_before_it_serves(how: str, tmp_path: Path) -> None:
    run = RunDirectory(tmp_path)
    run.prepare({"seed": 0})
    for value in (2.0, 3.0):
        AtomicCheckpointIO().save_checkpoint(checkpoint(value), run.checkpoint)
    damage(run.checkpoint, how)
    with pytest.raises(RunError, match=r"last\.ckpt: cannot be read as a checkpoint"):
        read_checkpoint(run.checkpoint)
    names = r"(?s)last\.ckpt: cannot be read.*Resuming from .*last\.previous\.ckpt.*last\.damaged\.ckpt"
    with pytest.warns(UserWarning, match=names):
        resume = run.prepare({"seed": 0})
    assert resume == tmp_path / "last.previous.ckpt"
    assert weight(resume) == 2.0
    # The next save must not put the damaged file in the good one's place.
    AtomicCheckpointIO().save_checkpoint(checkpoint(4.0), run.checkpoint)
    assert weight(resume) == 2.0
    for path in (run.checkpoint, resume):
        path.write_bytes(b"")
    with pytest.raises(RunError, match=r"(?s)no checkpoint here is whole.*last\.ckpt.*last\.previous\.ckpt.*overwrite"):
        run.prepare({"seed": 0})


def test_a_second_process_is_kept_out_and_leftovers_of_a_killed_one_are_removed(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "run")
    with run.writing():
        with pytest.raises(RunError, match=rf"another process \(process {os.getpid()}\) is training here"):
            with RunDirectory(tmp_path / "run").writing():
                pytest.fail("two processes in one directory")
        (run.path / ".last.ckpt.4711.tmp").write_bytes(b"torn")
        (run.path / ".notes.tmp").write_bytes(b"mine")
        run.prepare({"seed": 0})
    assert sorted(p.name for p in run.path.iterdir()) == [".lock", ".notes.tmp", "config.yaml", "events.jsonl"]
    with RunDirectory(tmp_path / "run").writing():
        pass


def test_errors_of_the_disk_become_named_and_others_stay(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "run")
    for error in (OSError(errno.ENOSPC, "No space left"), OSError(f"{run.path}/panels/x.png: cannot be written")):
        with pytest.raises(RunError, match="run: cannot be written or read"):
            with run.writing():
                raise error
    with pytest.raises(ConnectionResetError):
        with run.writing():
            raise ConnectionResetError(errno.ECONNRESET, "not the disk")


def test_weights_load_into_equal_parameters_of_the_same_scenes_only() -> None:
    check_scenes(checkpoint(), [scene()], "run/last.ckpt")
    other = replace(scene(shift=0.5), name="vase")
    with pytest.raises(RunError, match=r"run/last\.ckpt was trained on 'block'.*'vase'"):
        check_scenes(checkpoint(), [other], "run/last.ckpt")
    module, other = nn.Linear(3, 2), nn.Linear(3, 2)
    load_weights(other, {"state_dict": module.state_dict()})
    assert torch.equal(other.weight, module.weight)
    with pytest.raises(RunError, match="does not fit"):
        load_weights(nn.Linear(4, 2), {"state_dict": module.state_dict()})
