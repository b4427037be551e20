"""`gausim pack` and `gausim fetch`: from a trained run to a run that works elsewhere; where data lie."""

import json
import re
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import torch
from helpers.joint_runs import PAPER
from helpers.toy_object import write_toy_object

from gausim.cli import fetch, pack, simulate
from gausim.cli import train as command
from gausim.compose.build import load_run
from gausim.compose.data_paths import data_option, located, outside_files
from gausim.core import DataError, FetchError, RunError
from gausim.io.files import sha256


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A finished run as far as its files go, and the data set beside it."""
    folder = tmp_path / "bunny"
    (folder / "evaluation").mkdir(parents=True)
    (tmp_path / "toy").mkdir()
    (tmp_path / "toy" / "dataset.json").write_text('{"name": "toy"}')
    (folder / "config.yaml").write_text(f"name: toy\nseed: 0\ndata: {{root: {tmp_path}/toy}}\n")
    (folder / "FINISHED").write_text('{"last_epoch": {}}')
    (folder / "evaluation" / "table.md").write_text("| l2 | 0.012 |\n")
    torch.save({"state_dict": {}, "gausim": {"scenes": [{"name": "toy"}]}}, folder / "last.ckpt")
    (folder / "events.jsonl").write_text("names the machine")
    (tmp_path / "user").mkdir()
    monkeypatch.chdir(tmp_path / "user")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return folder


def test_a_run_comes_back_without_what_names_its_machine(run: Path) -> None:
    assert pack.main([str(run), "--licence", "MIT"]) == 0
    assert fetch.main(["bunny.zip", "--sha256", sha256(Path("bunny.zip"))]) == 0
    found = Path("outputs/fetched/bunny")
    names = {path.relative_to(found).as_posix() for path in found.rglob("*") if path.is_file()}
    assert names == {"FINISHED", "README.md", "config.yaml", "evaluation/table.md", "last.ckpt"}
    card = (found / "README.md").read_text()
    assert "MIT" in card and "| l2 | 0.012 |" in card
    with pytest.raises(FetchError, match="bunny: expected nothing there"):
        fetch.main(["bunny.zip", "--sha256", sha256(Path("bunny.zip"))])


def test_a_data_set_is_fetched_from_a_server_and_kept_in_the_cache(run: Path) -> None:
    pack.main([str(run.parent / "toy")])
    handler = partial(SimpleHTTPRequestHandler, directory=Path.cwd())
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}).start()
        url, known = f"http://127.0.0.1:{server.server_port}", sha256(Path("toy.zip"))
        try:
            with pytest.raises(FetchError, match="cannot be fetched .*404.* Check the address"):
                fetch.main([f"{url}/gone.zip", "--sha256", known])
            with pytest.raises(FetchError, match="cannot be fetched .*hash"):
                fetch.main([f"{url}/toy.zip", "--sha256", "0" * 64])
            assert fetch.main([f"{url}/toy.zip", "--sha256", known]) == 0
        finally:
            server.shutdown()
    assert json.loads(Path("data/toy/dataset.json").read_text()) == {"name": "toy"}
    assert fetch.main([f"{url}/toy.zip", "--sha256", known, "--out", "again"]) == 0


def test_a_changed_file_or_one_without_a_run_leaves_nothing(run: Path) -> None:
    pack.main([str(run)])
    data = bytearray(Path("bunny.zip").read_bytes())
    data[len(data) // 2] ^= 1
    Path("changed.zip").write_bytes(data)
    with pytest.raises(FetchError, match="changed.zip: expected SHA-256 .* Nothing was unpacked"):
        fetch.main(["changed.zip", "--sha256", sha256(Path("bunny.zip"))])
    with pytest.raises(FetchError, match="damaged"):
        fetch.main(["changed.zip", "--sha256", sha256(Path("changed.zip"))])
    (run / "last.ckpt").unlink()
    pack.main([str(run)])
    with pytest.raises(FetchError, match="last.ckpt missing"):
        fetch.main(["bunny.zip", "--sha256", sha256(Path("bunny.zip"))])
    assert sorted(path.name for path in Path().iterdir()) == ["bunny.zip", "changed.zip"]


def test_neither_unfinished_runs_nor_links_are_packed(run: Path) -> None:
    (run.parent / "toy" / "link").symlink_to("/etc/passwd")
    with pytest.raises(DataError, match="link: expected a file or a folder, found a link"):
        pack.main([str(run.parent / "toy")])
    (run / "FINISHED").unlink()
    with pytest.raises(RunError, match="expected a finished run"):
        pack.main([str(run)])


@pytest.mark.slow
def test_a_fetched_run_names_what_it_misses_and_works_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    toy = write_toy_object(tmp_path / "toy").root
    Path("apart").mkdir()
    for name in ("scene.ply", "scene.masks.npz"):
        (toy / name).rename(tmp_path / "apart" / name)
    asked = [f"data.root={toy}", f"data.scene={tmp_path}/apart/scene.ply", "hydra.run.dir=made", "name=made"]
    assert command.main([*PAPER, *asked, "plan.epochs=1"]) == 0
    assert pack.main(["made"]) == 0
    assert fetch.main(["made.zip", "--sha256", re.findall("--sha256 (.*)", capsys.readouterr().out)[0]]) == 0
    for name in ("toy", "apart"):
        Path(name).rename(f"{name}_moved")
    run = Path("outputs/fetched/made")
    with pytest.raises(DataError, match="field data.root names .*, expected a directory, .* --data DIR"):
        simulate.main([str(run)])
    assert simulate.main([str(run), "--data", "toy_moved", "--frames", "3", "--cameras", "cam_0"]) == 0
    assert load_run(run, data={"root": "toy_moved"}).objects[0].scene_path == run / "scenes" / "scene.ply"


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
