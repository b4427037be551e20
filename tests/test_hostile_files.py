"""Files that would run a program if their reader let them: every reader refuses and names them, and runs nothing."""

from __future__ import annotations

import io
import os
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from helpers.plain import Call
from helpers.toy_object import toy_scene

from data_prep.public.pickles import read_pickle
from gausim.cli.main import main
from gausim.core import GausSimError
from gausim.data.objects import ObjectData
from gausim.io.motion import load_motion
from gausim.io.npz import read_array
from gausim.io.ply import load_masks, load_scene
from gausim.io.trajectory import load_trajectory
from gausim.io.transforms import read_json, read_transforms
from gausim.metrics import LPIPS
from gausim.metrics.lpips_weights import convert
from gausim.results.curves import load_curves
from gausim.results.pictures import load_pictures
from gausim.results.summary import load_summary
from gausim.runs.checkpoint import read_checkpoint
from gausim.runs.directory import RunDirectory

# Every function of the product that reads a file of a format, and the name under which it expects it.
READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "checkpoint": ("last.ckpt", read_checkpoint),
    "run": ("config.yaml", lambda path: RunDirectory(path.parent).config()),
    "curves": ("metrics.npz", load_curves),
    "pictures": ("pictures.npz", load_pictures),
    "summary": ("metrics.json", load_summary),
    "array": ("ground_truth.npz", lambda path: read_array(path, "payload")),
    "object": ("dataset.json", lambda path: ObjectData(path.parent)),
    "json": ("any.json", read_json),
    "transforms": ("transforms.json", read_transforms),
    "scene": ("scene.ply", load_scene),
    "masks": ("scene.masks.npz", lambda path: load_masks(toy_scene(), path)),
    "trajectory": ("trajectory.safetensors", load_trajectory),
    "motion": ("m.motion.glb", load_motion),
    "public pickle": ("final_data.pkl", read_pickle),
    "lpips": ("lpips.safetensors", LPIPS),
    "lpips, jax": ("alexnet.ckpt", convert),
    "lpips, wheel": ("lpips.whl", convert),
}


def payload(canary: Path) -> Call:
    """Makes a file when it is unpickled."""
    return Call(os.system, f"touch '{canary}'")


def object_array(canary: Path) -> np.ndarray:
    return np.array([payload(canary)], dtype=object)


def saved(save: Callable[[io.BytesIO], object]) -> bytes:
    buffer = io.BytesIO()
    save(buffer)
    return buffer.getvalue()


CONTENTS: dict[str, Callable[[Path], bytes]] = {
    "pickle": lambda canary: pickle.dumps({"payload": payload(canary)}, protocol=2),
    "torch archive": lambda canary: saved(lambda f: torch.save({"payload": payload(canary)}, f)),
    "old torch file": lambda canary: saved(
        lambda f: torch.save({"payload": payload(canary)}, f, _use_new_zipfile_serialization=False)
    ),
    "npz of objects": lambda canary: saved(lambda f: np.savez(f, payload=object_array(canary))),
    "npy of objects": lambda canary: saved(lambda f: np.save(f, object_array(canary))),
    "npy of numbers": lambda canary: saved(lambda f: np.save(f, np.zeros(3))),
    "yaml": lambda canary: f"payload: !!python/object/apply:os.system [\"touch '{canary}'\"]\n".encode(),
    "torn archive": lambda canary: CONTENTS["torch archive"](canary)[:-100],
    "torn safetensors": lambda canary: (1 << 40).to_bytes(8, "little") + b'{"positions":',
    "nothing": lambda canary: b"",
}


@pytest.mark.parametrize("content", CONTENTS)
@pytest.mark.parametrize("reader", READERS)
def test_no_reader_runs_what_is_in_a_file(reader: str, content: str, tmp_path: Path) -> None:
    name, read = READERS[reader]
    path, canary = tmp_path / name, tmp_path / "canary"
    path.write_bytes(CONTENTS[content](canary))
    with pytest.raises(GausSimError) as caught:
        read(path)
    assert not canary.exists()
    assert str(path.parent) in str(caught.value), "the error names no file"


def careless(content: str, path: Path) -> None:
    if content.startswith("np"):
        file = np.load(path, allow_pickle=True)
        _ = file["payload"] if content.startswith("npz") else file
    elif content == "yaml":
        yaml.unsafe_load(path.read_text())
    elif content == "pickle":
        pickle.loads(path.read_bytes())
    else:
        torch.load(path, weights_only=False)


@pytest.mark.parametrize(
    "content", ["pickle", "torch archive", "old torch file", "npz of objects", "npy of objects", "yaml"]
)
def test_the_payloads_are_live(content: str, tmp_path: Path) -> None:
    path, canary = tmp_path / "file", tmp_path / "canary"
    path.write_bytes(CONTENTS[content](canary))
    careless(content, path)
    assert canary.exists()


SYSTEM = {"_target_": "os.system", "command": "touch canary"}
PROGRAM = {"_target_": "torch.distributed.run.main", "args": ["--standalone", "evil.py"]}
TEXT = {"_target_": "torch.fx.graph_module._exec_with_source", "src": "open('canary', 'w')", "globals": {}}
METHOD = {"_target_": "lightning.fabric.plugins.io.torch_io.TorchCheckpointIO.load_checkpoint", "self": None,
          "path": "evil.ckpt", "weights_only": False}  # fmt: skip


@pytest.mark.parametrize("node", [SYSTEM, PROGRAM, TEXT, METHOD], ids=lambda node: node["_target_"])
def test_a_run_of_other_people_builds_nothing_else(
    node: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("evil.py").write_text("open('canary', 'w')")
    torch.save(payload(Path("canary")), "evil.ckpt")
    parts = {name: {} for name in ("model", "loss", "optimizer", "render", "trainer", "paths")}
    parts["model"] = {"simulator": node, "initial_states": {}}
    config = {**parts, "seed": 0, "name": "evil", "data": node, "callbacks": {"evil": node}}
    Path("run").mkdir()
    Path("run/config.yaml").write_text(yaml.safe_dump(config))
    torch.save({"state_dict": {}, "gausim": {}}, "run/last.ckpt")
    assert main(["evaluate", "run"]) == 2
    assert "_target_: expected" in capsys.readouterr().err
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HYDRA_FULL_ERROR", "0")
        assert main(["train", "--config-dir", "run", "--config-name", "config", "hydra.run.dir=again/seed_0"]) == 2
    assert not Path("canary").exists()


LOGGING = {"version": 1, "root": {"handlers": ["evil"]}, "disable_existing_loggers": False}
HYDRA = {
    "callbacks": {"callbacks": {"evil": TEXT}},
    "launcher": {"launcher": {"_target_": TEXT["_target_"]}},
    "environment": {"job": {"env_set": {"PATH": "/evil"}}},
    "factory": {"job_logging": {**LOGGING, "handlers": {"evil": {"()": "os.system", "command": "touch canary"}}}},
    "alias": {
        "job_logging": {**LOGGING, "handlers": {"evil": {"class": "logging.os.system", "command": "touch canary"}}}
    },
    "object": {
        "job_logging": {**LOGGING, "handlers": {"evil": {"class": "logging.Handler", "level": "ext://os.system"}}}
    },
}


@pytest.mark.parametrize("attack", HYDRA)
def test_hydra_builds_nothing_else_for_itself(
    attack: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("conf").mkdir()
    content = {"defaults": ["train", "_self_"], "hydra": HYDRA[attack]}
    Path("conf/evil.yaml").write_text(yaml.safe_dump(content))
    assert main(["train", "--config-dir", "conf", "--config-name", "evil", "data.root=nowhere"]) == 2
    error = capsys.readouterr().err
    assert "hydra." in error and "expected" in error, error
    assert not Path("canary").exists() and not Path("outputs").exists()
