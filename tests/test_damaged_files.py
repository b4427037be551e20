"""Damaged, hostile and strange files, names and numbers: obeyed or refused by name, and nothing in them runs."""

import io
import json
import os
import pickle
import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from helpers import colmap_files, toy_object
from helpers.plain import Call

from data_prep.common.colmap import read_colmap
from data_prep.pack import pack
from gausim.cli.main import main
from gausim.compose.command import quoted, with_data_directories
from gausim.compose.config import compose
from gausim.compose.targets import check_hydra, check_seed
from gausim.core import ConfigError, DataError, GausSimError
from gausim.data.objects import ObjectData
from gausim.interaction.selections import Ball
from gausim.interaction.session import Entry, Force, ForceSession, MadeWith, Reset, load_session, save_session
from gausim.io.files import read_yaml, safe_name
from gausim.io.npz import read_array
from gausim.io.ply import load_masks, load_scene
from gausim.io.trajectory import load_trajectory, save_trajectory
from gausim.io.transforms import read_transforms
from gausim.metrics import LPIPS
from gausim.report.write import spreadsheet_cells
from gausim.results.curves import load_curves
from gausim.results.table import ObjectInfo, load_results
from gausim.runs.checkpoint import AtomicCheckpointIO, read_checkpoint
from gausim.runs.directory import RunDirectory

SCENE = toy_object.toy_scene()


def whole(path: Path) -> object:
    """Reads all of the object that a file belongs to."""
    data = ObjectData(next(p for p in path.parents if (p / "dataset.json").is_file()))
    record = data.sequences[0]
    return record.cameras, record.frames(range(1)), data.ground_truth(record), data.rest_points


READERS: dict[str, Callable[[Path], object]] = {
    "last.ckpt": read_checkpoint, "config.yaml": lambda path: RunDirectory(path.parent).config(),
    "metrics.npz": lambda path: load_curves(path, {"toy": ObjectInfo()}), "metrics.json": load_results,
    "lpips.safetensors": LPIPS,
    "ground_truth.npz": lambda path: read_array(path, "payload"), "transforms.json": read_transforms,
    "scene.ply": load_scene, "scene.masks.npz": lambda path: load_masks(SCENE, path),
    "trajectory.safetensors": load_trajectory, "dataset.json": whole, "session.json": load_session,
}  # fmt: skip


def saved(save: Callable[[io.BytesIO], object]) -> bytes:
    buffer = io.BytesIO()
    save(buffer)
    return buffer.getvalue()


CONTENTS: dict[str, Callable[[Call], bytes]] = {
    "pickle": lambda call: pickle.dumps({"payload": call}, protocol=2),
    "torch": lambda call: saved(lambda f: torch.save({"payload": call}, f)),
    "npz": lambda call: saved(lambda f: np.savez(f, payload=np.array([call], dtype=object))),
    "yaml": lambda call: f'payload: !!python/object/apply:os.system ["{call.call[1][0]}"]\n'.encode(),
    "nothing": lambda call: b"",
}


@pytest.mark.parametrize("content", CONTENTS)
@pytest.mark.parametrize("name", READERS)
def test_no_reader_runs_what_is_in_a_file(name: str, content: str, tmp_path: Path) -> None:
    path, canary = tmp_path / name, tmp_path / "canary"
    path.write_bytes(CONTENTS[content](Call(os.system, f"touch '{canary}'")))
    with pytest.raises(GausSimError, match=str(tmp_path)):
        READERS[name](path)
    assert not canary.exists()


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, Callable[[Path], object]]:
    """Files that can be read, and their readers."""
    root = tmp_path_factory.mktemp("good")
    toy = toy_object.write_toy_object(root / "toy", frames=8)
    pack(toy.root, root / "store")
    truth = toy.truth("seq_000", 3)
    save_trajectory(root / "trajectory.safetensors", truth)
    push = Force(on=Ball((0.0, 0.0, 1.0), 0.2), direction=(1.0, 0.0, 0.0), weights=2.0, frames=3)
    made = MadeWith("toy", "0" * 64, "1" * 64, "2" * 64)
    save_session(ForceSession(made, 24.0, 8, (Entry(1, push), Entry(6, Reset())), 9.81), root / "session.json")
    found = {root / name: READERS[name] for name in ("trajectory.safetensors", "session.json")}
    found |= {toy.root / "scene.ply": load_scene, toy.root / "scene.masks.npz": READERS["scene.masks.npz"]}
    inside = ("dataset.json", "sequences/seq_000/transforms.json", "sequences/seq_000/ground_truth.npz")
    found |= {toy.root / name: whole for name in inside}
    found |= {root / "store/sequences/seq_000" / name: whole for name in ("frames.json", "view_0.npy")}
    for kind in ("binary", "text"):
        getattr(colmap_files, f"write_{kind}")(root / kind, *colmap_files.small_model())
        found |= {path: lambda p: read_colmap(p.parent) for path in (root / kind).iterdir()}
    return found


def damaged(data: bytes, rng: random.Random) -> bytes:
    """The bytes cut, doubled, overwritten, or with a number of a text replaced."""
    at, size = rng.randrange(len(data)), rng.choice((1, 4, 8, 64))
    at = at if rng.random() < 0.5 else at % min(len(data), 256)
    word = rng.choice((b"\xff" * 8, b"\0" * 8, b"\0\0\xc0\x7f", b"NaN", b"-1", b"1e999", b"9" * 30, b'"x"', b"[]"))
    changed = rng.choice((word, rng.randbytes(size)))
    rest = rng.choice((data[at:], data[at + 1 :], data[at + len(changed) :]))
    return rng.choice((data[:at], data[:at] + changed + rest, data[: at + size] + data[at:]))


def test_damage_is_refused_by_name_or_harmless(good: dict[Path, Callable[[Path], object]]) -> None:
    refused = 0
    for path, read in good.items():
        content, rng = path.read_bytes(), random.Random(path.name)
        read(path)
        for _ in range(40):
            path.write_bytes(damaged(content, rng))
            try:
                read(path)
            except GausSimError as error:
                assert str(path.parent) in str(error)
                refused += 1
        path.write_bytes(content)
    assert refused > 20 * len(good)


SYSTEM = {"_target_": "os.system", "command": "touch canary"}
TEXT = {"_target_": "torch.fx.graph_module._exec_with_source", "src": "open('canary', 'w')", "globals": {}}
HANDLER = {"version": 1, "handlers": {"evil": {"()": "os.system", "command": "touch canary"}}}


@pytest.mark.parametrize("node", [SYSTEM, TEXT], ids=lambda node: node["_target_"])
def test_a_run_of_others_builds_nothing_else(node: dict, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    parts = {name: {} for name in ("model", "loss", "optimizer", "render", "trainer", "paths")}
    parts["model"] = {"simulator": node, "initial_states": {}}
    config = {**parts, "seed": 0, "name": "evil", "data": node, "callbacks": {"evil": node}}
    Path("run").mkdir()
    Path("run/config.yaml").write_text(yaml.safe_dump(config))
    AtomicCheckpointIO().save_checkpoint({"state_dict": {}, "gausim": {}}, "run/last.ckpt")
    assert main(["evaluate", "run"]) == 2 and "_target_: expected" in capsys.readouterr().err
    assert not Path("canary").exists()


FILE = {"handlers": {"file": {"class": "logging.FileHandler", "filename": "canary", "mode": "w"}}}
LINES = {"formatters": {"simple": {"format": "touch canary"}}}
HTTP = {"handlers": {"web": {"class": "logging.handlers.HTTPHandler", "host": "localhost", "url": "/"}}}


@pytest.mark.parametrize("part", [{"callbacks": {"callbacks": {"evil": TEXT}}}, {"job_logging": HANDLER},
                                  {"job_logging": FILE}, {"hydra_logging": LINES}, {"job_logging": HTTP},
                                  {"job": {"name": "../canary"}},
                                  {"job": {"env_set": {"PATH": "/evil"}}}], ids=json.dumps)  # fmt: skip
def test_hydra_builds_nothing_else_for_itself(part: dict, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    Path("experiment").mkdir()
    Path("experiment/evil.yaml").write_text("# @package _global_\n" + yaml.safe_dump({"hydra": part}))
    assert main(["train", "--config-dir", ".", "experiment=evil", "data.root=nowhere"]) == 2
    assert "hydra." in capsys.readouterr().err and not Path("canary").exists()


NAMES = ["é", "data (1)", "a#b", "a=b", "a, b", "it's", "名前", "a{b}", "back~", "[1]", "two  spaces"]


@pytest.mark.parametrize("name", NAMES)
def test_any_path_may_be_a_value(tmp_path: Path, name: str, monkeypatch) -> None:
    (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path)
    for path in (name if name[0] != "[" else f"./{name}", f"{tmp_path}/{name}"):
        config = compose(quoted(["data=object", f"data.root={path}", f"output_root={path}", "name=x"]))
        assert config.data.root == config.output_root == path
    config = compose(quoted(with_data_directories([f"data={tmp_path / name}", "name=x"])))
    assert config.data.root == str(tmp_path / name)


def test_a_home_is_expanded_and_an_interpolation_refused(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "é").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path))
    assert compose(quoted(["data=object", "data.root=~/é", "name=x"])).data.root == str(tmp_path / "é")
    kept = ["seed=0,1", "name='a b'", "data.sequences=[seq_000,seq_001]", "plan.epochs=3", "~logger", "data.test=null"]
    assert quoted(kept) == kept
    (tmp_path / "${x}").mkdir()
    with pytest.raises(ConfigError, match="Rename the folder"):
        with_data_directories([f"data={tmp_path}/${{x}}"])


@pytest.mark.parametrize("seed", [-1, 2**32, True, 1.5])
def test_a_seed_out_of_range_is_refused(seed: object) -> None:
    with pytest.raises(ConfigError, match="seed: expected a whole number from 0 to 4294967295, got"):
        check_seed(seed)
    check_seed(0)
    check_seed(2**32 - 1)


@pytest.mark.parametrize("name", ["../x", "/etc/x", "a/../../b", "..", "a\\..\\b", "C:\\x", "a\nb", "x" * 300])
def test_a_name_that_leaves_its_folder_is_refused(name: str) -> None:
    with pytest.raises(DataError, match="is a path, not a name"):
        safe_name(name, "dataset.json: field 'name'")


@pytest.mark.parametrize("name", ["", "bunny", "1e3", "ä b (1)", "a..b", "set/bunny"])
def test_other_names_are_taken(name: str) -> None:
    assert safe_name(name, "here") == name


def test_a_yaml_that_contains_itself_or_is_huge_is_refused_and_common_aliases_are_not(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("a: &a\n  b: *a\n")
    with pytest.raises(ValueError, match="aliases"):
        read_yaml(tmp_path / "a.yaml")
    (tmp_path / "b.yaml").write_text("a: " + "x" * (1 << 22))
    with pytest.raises(ValueError, match="bytes, more than"):
        read_yaml(tmp_path / "b.yaml")
    shared = [1, 2]
    (tmp_path / "c.yaml").write_text(yaml.safe_dump({"a": shared, "b": shared}))
    assert read_yaml(tmp_path / "c.yaml") == {"a": [1, 2], "b": [1, 2]}


@pytest.mark.parametrize("place", ["config.yaml", "experiment/evil.yaml", "data/test/evil.yaml"])
def test_aliases_of_a_run_of_others_are_bounded(tmp_path: Path, place: str, capsys) -> None:
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 60 if place == "config.yaml" else 9)]
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / place).write_text("\n".join(lines))
    assert main(["train", "--config-dir", str(tmp_path), "--config-name", "config"]) == 2
    assert "when its aliases are written out" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["=cmd|' /C calc'!A0", "+1+1", "-2+3", "@SUM(A1)"])
def test_a_name_is_no_formula(text: str) -> None:
    assert spreadsheet_cells({"object": text, "value": -1.0}) == {"object": f"'{text}", "value": -1.0}
    assert spreadsheet_cells({"object": "bunny", "split": "+10"}) == {"object": "bunny", "split": "+10"}


@pytest.mark.parametrize("choice", ["default", "none", "disabled", "stdout"])
def test_hydras_own_logging_is_taken(choice: str) -> None:
    check_hydra(compose(["name=x", f"hydra/job_logging={choice}"], with_hydra=True).hydra)
