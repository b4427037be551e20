"""One command runs the stages that a file lists, hands results on, and stops where one fails."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
from helpers import toy_object

from data_prep import dataset as command
from data_prep.dataset import Job, plan, prepare
from gausim.core import ConfigError
from gausim.data.verify import verify


def _config(folder: Path, text: str) -> Path:
    path = folder / "object.yaml"
    path.write_text(text)
    return path


def test_options_become_arguments_and_results_are_handed_on(tmp_path: Path) -> None:
    (tmp_path / "takes").mkdir()
    config = _config(
        tmp_path,
        """
        work: work
        stages:
          ingest: {films: takes, sync: auto, start: 1.5}
          segment-films: {pictures: "{ingest}/sequences", backend: chroma, no_grabcut: true, floor: 0.1, plate: false}
          select: {scene: "a b.ply", pinned: "below z=0.33", point: [1, 2]}
        """,
    )
    work = tmp_path / "work"
    assert plan(config) == [
        Job("ingest", "ingest", (str(tmp_path / "takes"), "--sync", "auto", "--start", "1.5",
                                 "--out", str(work / "ingest"))),
        Job("segment-films", "segment", (f"{work / 'ingest'}/sequences", "--backend", "chroma", "--no-grabcut",
                                         "--floor", "0.1", "--out", str(work / "segment-films"))),
        Job("select", "select", ("a b.ply", "--pinned", "below z=0.33", "--point", "1", "2",
                                 "--out", str(work / "select"))),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("work: [", "cannot be read as YAML"),
        ("stages: {pack: {}}", "expected the fields 'work'"),
        ("{work: w, stages: {}}", "field 'stages'"),
        ("{work: w, stages: {bake: {}}}", "no stage 'bake'"),
        ("{work: w, stages: {segment-../x: {}}}", "no stage 'segment-../x'"),
        ("{work: w, stages: {3: {}}}", "no stage '3'"),
        ("{work: w, stages: {pack: 3}}", "stages.pack: expected a mapping"),
        ("{work: w, stages: {pack: {root: {a: 1}}}}", "stages.pack.root: expected a text"),
        ("{work: w, stages: {pack: {root: '{poses}'}, poses: {}}}", "stages.pack.root.*'poses'.*before this one: none"),
        ("{work: w, stages: {pack: {root: '{0}'}}}", "stages.pack.root"),
    ],
)
def test_broken_configurations_are_named(tmp_path: Path, text: str, what: str) -> None:
    with pytest.raises(ConfigError, match=what):
        plan(_config(tmp_path, text))


def test_a_real_stage_runs_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    toy_object.write_toy_object(tmp_path / "toy", frames=9)
    config = _config(tmp_path, "{work: work, stages: {pack: {root: toy, margin: 1}}}")
    assert command.main([str(config)]) == 0 and "made: 2 sequences" in capsys.readouterr().out
    assert verify(tmp_path / "work" / "pack") == []
    assert command.main([str(config)]) == 0 and "there already" in capsys.readouterr().out
    config.write_text(config.read_text().replace("margin: 1", "margin: 2"))
    assert command.main([str(config)]) == 2 and "--force" in capsys.readouterr().err
    assert command.main([str(config), "--force"]) == 0


def test_it_stops_where_a_stage_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran = []

    def load(name: str) -> SimpleNamespace:
        def run(argv: list[str]) -> int:
            ran.append((name, argv[-1]))
            return 2 if name == "data_prep.poses" else 0

        return SimpleNamespace(main=run)

    monkeypatch.setattr(command, "importlib", SimpleNamespace(import_module=load))
    config = _config(tmp_path, "{work: w, stages: {ingest: {films: x}, poses: {}, pack: {root: '{poses}'}}}")
    assert prepare(config) == 2
    assert [name for name, _ in ran] == ["data_prep.ingest", "data_prep.poses"]
