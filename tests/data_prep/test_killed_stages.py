"""Stages killed at any place: no half result, and the same command ends with what an uninterrupted one makes."""

import runpy
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers import public_sets
from helpers.plain import contents
from helpers.toy_runs import Server

from gausim.data.verify import verify

ROOT = Path(__file__).parents[2]
CAPTURE = runpy.run_path(str(Path(__file__).with_name("test_assemble.py")))["Capture"]
ROOM = runpy.run_path(str(Path(__file__).with_name("test_poses.py")))
Run = Callable[..., dict[str, Any]]
STAGES = ("ingest", "poses", "segment", "select", "assemble", "pack", "public", "poses-mapping",
          "synthesize")  # fmt: skip
SHARES = (0.0, 0.5, 1.0)


@pytest.fixture(scope="module")
def run() -> Iterator[Run]:
    """Runs a stage in a child of its own."""
    with Server(Path(__file__).with_name("killed_stages.py")) as server:
        yield server.ask


@pytest.fixture(scope="module")
def jobs(run: Run, tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[list[str], Path, int]]:
    """Per stage: its arguments but --out, what it makes when nobody kills it, and the places it passes."""
    folder = tmp_path_factory.mktemp("stages")
    capture = CAPTURE(folder / "capture")
    capture.write_films()
    from gausim.io.ply import save_scene

    save_scene(capture.toy.scene, folder / "rest" / "scene.ply")
    ROOM["write_photos"](folder / "room")
    public_sets.write_physdreamer(folder / "hat")
    whole = {stage: folder / "whole" / stage for stage in STAGES}
    arguments = {
        "ingest": [capture.folder / "takes", "--sync", "offsets", "--offsets", "cam_0=0,cam_1=2f,cam_2=0"],
        "poses": ["--transforms", capture.folder / "photos/calibration.json", "--sequences", whole["ingest"]],
        "segment": [whole["poses"], *"--backend chroma --key 00b140 --no-grabcut --components 0".split()],
        "select": [folder / "rest" / "scene.ply", "--pinned", "below z=0.1", "--size", "64"],
        "assemble": [whole["segment"], "--scene", whole["select"], "--name", "toy"],
        "pack": [whole["assemble"]],
        "public": ["physdreamer", folder / "hat", "--anchor", "0.4", "--video-masks", folder / "video_masks"],
        "poses-mapping": [
            "--images", folder / "room", *"--camera-model SIMPLE_PINHOLE --features 1500 --feature-size 320".split(),
        ],
        "synthesize": "--quick --objects pudding_soft --sequences 1 --frames 16 --resolution 24 --kernels 60 "
        "--workers 1".split(),
    }  # fmt: skip

    class Made(dict):
        """Makes a stage, and those whose results it reads, when it is asked for."""

        def __missing__(self, stage: str) -> tuple[list[str], Path, int]:
            for other, result in whole.items():
                if other != stage and other not in self and result in arguments[stage]:
                    self[other]
            argv = [str(value) for value in arguments[stage]]
            done = run(stage=stage, argv=[*argv, "--out", str(whole[stage])])
            assert done["status"] == 0, done["output"]
            self[stage] = (argv, whole[stage], done["places"])
            return self[stage]

    return Made()


def check(run: Run, stage: str, argv: list[str], whole: Path, places: int, share: float, folder: Path) -> None:
    out = folder / "result"
    command = [*argv, "--out", str(out)]
    killed = run(stage=stage, argv=command, die=min(places - 1, round(share * (places - 1))))
    assert killed["status"] == -signal.SIGKILL, killed["output"]
    if out.exists():  # killed after it had taken its name: then it is whole
        assert contents(out) == contents(whole)
    again = run(stage=stage, argv=command)
    assert again["status"] == 0, again["output"]
    assert contents(out) == contents(whole)
    assert [p.name for p in folder.iterdir()] == ["result"]  # nothing is left lying about


def test_a_stage_killed_in_its_middle_goes_on(run: Run, jobs: dict, tmp_path: Path) -> None:
    check(run, "public", *jobs["public"], 0.5, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_killed_at_three_places(run: Run, jobs: dict, tmp_path: Path, stage: str, share: float) -> None:
    check(run, stage, *jobs[stage], share, tmp_path)


@pytest.mark.slow
def test_every_place_near_the_end_of_a_stage(run: Run, jobs: dict, tmp_path: Path) -> None:
    """Where the manifest is written and the result takes its name, with and without a result that is replaced."""
    argv, whole, places = jobs["pack"]
    for place in range(places - 6, places):
        (tmp_path / f"new_{place}").mkdir()
        check(run, "pack", argv, whole, places, place / (places - 1), tmp_path / f"new_{place}")
    for back in range(1, 8):
        folder = tmp_path / f"force_{back}"
        assert run(stage="pack", argv=[*argv, "--margin", "0", "--out", str(folder / "result")])["status"] == 0
        before = contents(folder / "result")
        command = [*argv, "--overwrite", "--out", str(folder / "result")]
        # A replacement passes one place more than a first result: the old one steps aside.
        killed = run(stage="pack", argv=command, die=places + 1 - back)
        assert killed["status"] == -signal.SIGKILL
        if (folder / "result").exists():
            assert contents(folder / "result") in (before, contents(whole))
        assert [run(stage="pack", argv=command)["status"] for _ in range(2)] == [0, 0]
        assert contents(folder / "result") == contents(whole) and verify(folder / "result") == []
        assert [p.name for p in folder.iterdir()] == ["result"]
