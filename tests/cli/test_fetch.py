"""`gausim fetch`: from a trained run through an archive and a server to a run that works elsewhere; where data lie."""

from __future__ import annotations

import errno
import io
import json
import os
import re
import shutil
import tarfile
from contextlib import redirect_stdout
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from helpers.joint_runs import PAPER, weights
from helpers.local_server import serving
from helpers.toy_object import write_toy_object

from gausim.cli import card, fetch, simulate
from gausim.cli import train as command
from gausim.compose.build import load_run
from gausim.compose.data_paths import data_option, located, outside_files
from gausim.core import BusyError, ConfigError, DataError, FetchError, RunError
from gausim.io import download
from gausim.io.files import sha256
from gausim.runs.files import sole_writer


def publish(home: Path, mirror: Path) -> Path:
    """Packs ``home/run`` and ``home/toy`` into a mirror with a registry, and moves them from where they were made."""
    asked = [(home / "run", "toy", "--licence", "MIT", "--data", "toy-data"), (home / "toy", "toy-data")]
    texts = []
    for source, name, *more in asked:
        said = io.StringIO()
        with redirect_stdout(said):
            argv = ["--pack", str(source), "--name", name, "--out", str(mirror), *(more or ["--licence", "CC0-1.0"])]
            assert fetch.main(argv) == 0
        texts.append(said.getvalue().replace("addresses = []", f'addresses = ["{name}.tar"]'))
    (mirror / "registry.toml").write_text('schema = "gausim.registry/1"\n' + "\n".join(texts))
    os.replace(home, home.with_name("moved"))
    return mirror


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A mirror of a data set, and of a run as far as its files go: nothing in it was trained."""
    home = tmp_path_factory.mktemp("bare") / "home"
    (home / "run").mkdir(parents=True)
    (home / "toy").mkdir()
    (home / "toy" / "dataset.json").write_text('{"name": "toy"}')
    (home / "run" / "config.yaml").write_text(f"name: toy\nseed: 0\ndata: {{root: {home}/toy}}\n")
    (home / "run" / "FINISHED").write_text('{"last_epoch": {}}')
    torch.save(
        {"state_dict": {"a": torch.arange(9000.0)}, "gausim": {"scenes": [{"name": "toy"}]}}, home / "run" / "last.ckpt"
    )
    (home / "run" / "events.jsonl").write_text("whose machine it was")
    return publish(home, tmp_path_factory.mktemp("mirror"))


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """A mirror of the toy and a run whose scene lay apart from it."""
    home = tmp_path_factory.mktemp("trained") / "home"
    toy = write_toy_object(home / "toy").root
    (home / "apart").mkdir()
    for name in ("scene.ply", "scene.masks.npz"):
        os.replace(toy / name, home / "apart" / name)
    asked = [f"data.root={toy}", f"data.scene={home}/apart/scene.ply", f"hydra.run.dir={home}/run"]
    assert command.main([*PAPER, *asked, "trainer.max_epochs=1"]) == 0
    assert card.main([str(home / "run"), "--licence", "MIT"]) == 0
    return ["--registry", str(publish(home, tmp_path_factory.mktemp("mirror")) / "registry.toml")]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(download, "PAUSE", 0.0)
    (tmp_path / "user").mkdir()
    monkeypatch.chdir(tmp_path / "user")


@pytest.fixture
def mirror(published: Path, tmp_path: Path) -> Path:
    """A copy of the mirror, to be changed."""
    return Path(shutil.copytree(published, tmp_path / "mirror"))


def asked(mirror: Path, *more: str) -> list[str]:
    return ["toy", "--registry", str(mirror / "registry.toml"), *more]


def left() -> list[str]:
    return sorted(path.as_posix() for path in Path().rglob("*") if path.is_file())


def rewrite(mirror: Path, **fields: object) -> None:
    """Changes fields of the first entry."""
    path = mirror / "registry.toml"
    text = path.read_text()
    for key, value in fields.items():
        text = re.sub(rf"(?m)^{key} = .*$", f"{key} = {json.dumps(value)}", text, count=1)
    path.write_text(text)


@pytest.mark.slow
def test_a_fetched_run_names_what_it_misses_and_works_with_it(trained: list[str], capsys) -> None:
    assert fetch.main(["toy", *trained]) == 0
    shown = capsys.readouterr().out
    assert "licence MIT" in shown and "gausim fetch toy-data" in shown and "--data data/toy-data" in shown
    run = Path("outputs/fetched/toy")
    assert {"config.yaml", "last.ckpt", "FINISHED", "README.md", "scenes", "FETCHED"} <= {p.name for p in run.iterdir()}
    missing = r"toy/config.yaml: field data.root names .*, expected a directory, found none on this"
    with pytest.raises(DataError, match=missing + " machine. `gausim fetch toy-data` .* --data DIR .* data.root=DIR"):
        simulate.main([str(run)])
    assert fetch.main(["toy-data", *trained]) == 0
    assert simulate.main([str(run), "--data", "data/toy-data", "--frames", "3", "--view", "cam_0"]) == 0
    assert list(run.glob("simulation/toy/*/trajectory.safetensors"))
    assert load_run(run, data={"root": "data/toy-data"}).objects[0].scene_path == run / "scenes" / "scene.ply"
    asked = ["data.root=data/toy-data", f"data.scene={run}/scenes/scene.ply", "trainer.max_epochs=1"]
    assert command.main([*PAPER, *asked, f"init_from={run}", "freeze=network"]) == 0
    first, second = (weights(path) for path in (run, Path("outputs/toy/seed_0")))
    network = [name for name in first if ".network" in name]
    assert network and all(torch.equal(first[name], second[name]) for name in network)
    shutil.rmtree(run / "scenes")
    with pytest.raises(DataError, match=r"field data.scene names .*, expected a file, .* --data scene=FILE"):
        load_run(run, data={"root": "data/toy-data"})


def test_it_is_fetched_whole_and_says_where_from(published: Path) -> None:
    assert fetch.main(asked(published)) == 0
    assert left() == [f"outputs/fetched/toy/{name}" for name in ("FETCHED", "FINISHED", "config.yaml", "last.ckpt")]
    note = json.loads(Path("outputs/fetched/toy/FETCHED").read_text())
    assert note["sha256"] == sha256(published / "toy.tar") and note["licence"] == "MIT" and note["data"] == "toy-data"
    with pytest.raises(DataError, match="data.root names .* found none on this machine. `gausim fetch toy-data`"):
        simulate.main(["outputs/fetched/toy"])
    before = Path("outputs/fetched/toy/last.ckpt").stat().st_mtime_ns
    assert fetch.main(asked(published)) == 0
    assert Path("outputs/fetched/toy/last.ckpt").stat().st_mtime_ns == before


def test_an_interrupted_download_goes_on_when_asked_again(published: Path, monkeypatch) -> None:
    monkeypatch.setattr(download, "ATTEMPTS", 1)
    size = (published / "toy.tar").stat().st_size
    with serving(published, cut_after=[size + 1, 20_000]) as server:
        words = ["toy", "--registry", f"{server.url}/registry.toml"]
        with pytest.raises(FetchError, match=f"after 20000 of {size} bytes.*The 20000 bytes that came are kept"):
            fetch.main(words)
        assert not Path("outputs/fetched/toy").exists()
        assert fetch.main(words) == 0
    assert server.asked[-1] == ("/toy.tar", "bytes=20000-")
    assert os.listdir("outputs/fetched") == ["toy"]


def test_a_tampered_file_is_refused_before_it_is_unpacked(published: Path, mirror: Path) -> None:
    data = bytearray((mirror / "toy.tar").read_bytes())
    data[len(data) // 2] ^= 1
    good = sha256(mirror / "toy.tar")
    (mirror / "toy.tar").write_bytes(data)
    told = f"toy.tar: expected SHA-256 {good}, found {sha256(mirror / 'toy.tar')}. The file was removed, nothing was"
    with pytest.raises(FetchError, match=told):
        fetch.main(asked(mirror))
    assert left() == []
    # The next address has it; a mirror replaces them all.
    rewrite(mirror, addresses=["toy.tar", str(published / "toy.tar")])
    with pytest.raises(FetchError, match="SHA-256"):
        fetch.main(asked(mirror, "--mirror", str(mirror)))
    assert fetch.main(asked(mirror)) == 0


@pytest.mark.parametrize(
    ("name", "what"), [("../../../escaped", "leaves the folder"), ("toy/readme", "expected a run, found none: config")]
)
def test_a_hostile_archive_leaves_nothing(mirror: Path, name: str, what: str) -> None:
    with tarfile.open(mirror / "toy.tar", "w") as tar:
        tar.addfile(tarfile.TarInfo(name))
    rewrite(mirror, sha256=sha256(mirror / "toy.tar"), size=(mirror / "toy.tar").stat().st_size)
    with pytest.raises(FetchError, match=what):
        fetch.main(asked(mirror))
    assert left() == [] and not list(mirror.parent.rglob("escaped"))


def test_a_full_disk_is_left_clean(published: Path, monkeypatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(fetch.shutil, "disk_usage", lambda path: SimpleNamespace(free=1))
        with pytest.raises(FetchError, match=r"expected \d+ bytes of free space for toy, found 1. Make room"):
            fetch.main(asked(published))
    write = Path.open

    def full(self, mode="r", *args, **options):
        if "x" in mode and self.name == "last.ckpt":
            raise OSError(errno.ENOSPC, "No space left on device", str(self))
        return write(self, mode, *args, **options)

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(FetchError, match=r"the disk is full .*What was written was removed again"):
        fetch.main(asked(published))
    assert left() == [] and os.listdir("outputs/fetched") == []


def test_what_is_there_or_another_process_makes_is_not_touched(published: Path) -> None:
    Path("mine").mkdir()
    Path("mine", "thesis.txt").write_text("years")
    with pytest.raises(FetchError, match="mine: expected nothing there, found something else. .*--out DIR"):
        fetch.main(asked(published, "--out", "mine"))
    assert left() == ["mine/thesis.txt"]
    with sole_writer(Path(".here.fetching/.lock")), pytest.raises(BusyError, match="is fetching here"):
        fetch.main(asked(published, "--out", "here"))


def test_no_address_or_no_network_names_a_way_out(published: Path, mirror: Path) -> None:
    rewrite(mirror, addresses=[])
    with pytest.raises(FetchError, match="entry.toy: has no address. Give a copy of toy.tar with --mirror"):
        fetch.main(asked(mirror))
    with serving(published) as server:
        url = server.url
    rewrite(mirror, addresses=[f"{url}/toy.tar"])
    with pytest.raises(FetchError, match="refused.*Check the connection.*--mirror DIR"):
        fetch.main(asked(mirror))
    assert fetch.main(asked(mirror, "--mirror", str(mirror))) == 0


def test_the_list_shows_what_there_is(published: Path, capsys) -> None:
    assert fetch.main(["--list", "--registry", str(published / "registry.toml")]) == 0
    shown = capsys.readouterr().out
    assert all(word in shown for word in ("toy-data", "CC0-1.0", "MIT", "run", "data"))
    assert fetch.main(["--list"]) == 0 and "lists nothing yet" in capsys.readouterr().out


def test_only_what_others_can_use_is_packed(published: Path, capsys) -> None:
    fetch.main(["toy", "toy-data", "--registry", str(published / "registry.toml")])
    with pytest.raises(FetchError, match="under which licence may others use it"):
        fetch.main(["--pack", "data/toy-data", "--name", "again"])
    with pytest.raises(FetchError, match="--name two words: expected"):
        fetch.main(["--pack", "data/toy-data", "--name", "two words", "--licence", "MIT"])
    facts = json.loads(Path("data/toy-data/dataset.json").read_text())
    Path("data/toy-data/dataset.json").write_text(json.dumps({**facts, "licence": "CC-BY-4.0"}))
    assert fetch.main(["--pack", "data/toy-data", "--name", "again", "--out", "p"]) == 0
    assert 'licence = "CC-BY-4.0"' in capsys.readouterr().out
    os.remove("outputs/fetched/toy/FINISHED")
    with pytest.raises(RunError, match="expected a finished run"):
        fetch.main(["--pack", "outputs/fetched/toy", "--name", "again", "--licence", "MIT"])


def test_words_become_keys_of_the_data_configuration():
    assert data_option([]) == {}
    assert data_option(["a"]) == {"root": "a"}
    assert data_option(["a", "root=b=c", "scene=s.ply"]) == {"root": ["a", "b=c"], "scene": "s.ply"}
    assert data_option(["odd=name"]) == {"root": "odd=name"}
    with pytest.raises(ConfigError, match="--data masks=b: masks is given twice"):
        data_option(["masks=a", "masks=b"])


def test_entries_keep_what_else_they_say(tmp_path: Path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    own = {"root": ["/gone", {"root": "/gone/too", "selections": {"pinned": "z=0.1"}}], "names": ["x"]}
    found = located(tmp_path, own, data_option([str(tmp_path / "a"), str(tmp_path / "b")]))
    assert found["root"] == [str(tmp_path / "a"), {"root": str(tmp_path / "b"), "selections": {"pinned": "z=0.1"}}]
    assert found["names"] == ["x"]
    with pytest.raises(DataError, match="field data.root names /gone/too"):
        located(tmp_path, {"root": [str(tmp_path / "a"), own["root"][1]]}, {})


def test_a_scene_that_is_gone_is_taken_from_the_run(tmp_path: Path):
    (tmp_path / "set").mkdir()
    entry = {"root": str(tmp_path / "set"), "scene": "/gone/bunny.ply"}
    own = {"root": [entry], "scene": None, "masks": None}
    with pytest.raises(DataError, match=r"field data.root\[0\].scene names /gone/bunny.ply, expected a file"):
        located(tmp_path, own, {})
    (tmp_path / "scenes").mkdir()
    for name in ("bunny.ply", "bunny.masks.npz"):
        (tmp_path / "scenes" / name).write_text("")
    assert located(tmp_path, own, {})["root"][0]["scene"] == str(tmp_path / "scenes" / "bunny.ply")
    assert outside_files(tmp_path, own) == [tmp_path / "scenes" / n for n in ("bunny.ply", "bunny.masks.npz")]
