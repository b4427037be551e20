"""The test part of a data set: sealed in training, opened by a declared look, and said in every table."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from helpers.simulators import LEVELS
from omegaconf import OmegaConf

from gausim.cli import evaluate, report, simulate, train
from gausim.compose.train import check_protocol
from gausim.core import ConfigError, DataError, RunError
from gausim.data import frames as frames_of_files
from gausim.data import records
from gausim.data.datamodule import ReadyDataModule
from gausim.data.objects import ObjectData, reserved_part
from gausim.doctor.examine import examine
from gausim.results.looks import read_looks

RESERVED = "data.test={sequences: [seq_001]}"
TINY = (
    "model=gausim_paper", LEVELS, "model.simulator.network.layers=1", "model.simulator.network.hidden=8",
    "plan.epochs=1", "plan.repeats=1", "plan.batch_size=2", "plan.t_start=7", "plan.t_max=7",
    "trainer.progress=false", "trainer.threads=1", "trainer.accelerator=cpu", "render=cpu",
    "trainer.panel_epochs=1", "trainer.motion_epochs=1", "logger=none", "name=toy", "data=object", RESERVED,
)  # fmt: skip


class Spy:
    """Everything that is read of the sequences: the highest frame of each, and whose true motion."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.last: dict[str, int] = {}
        self.truth: set[str] = set()
        read_images, read_array = frames_of_files.read_rgba_into, records.read_array

        def images(paths: list[Path], *rest: Any, **options: Any) -> None:
            for path in paths:
                name = path.parts[-3]
                self.last[name] = max(self.last.get(name, 0), int(path.stem))
            read_images(paths, *rest, **options)

        def array(path: Path, field: str) -> Any:
            if path.name == "ground_truth.npz":
                self.truth.add(path.parent.name)
            return read_array(path, field)

        patch.setattr(frames_of_files, "read_rgba_into", images)
        patch.setattr(records, "read_array", array)


@pytest.fixture(scope="module")
def trained(toy: Path, tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """A run on a development and a test sequence with panels, motion watch and doctor, and what it read."""
    folder = tmp_path_factory.mktemp("protocol")
    with pytest.MonkeyPatch.context() as patch:
        spy = Spy(patch)
        assert train.main([f"data.root={toy}", f"output_root={folder}", *TINY]) == 0
    return SimpleNamespace(run=folder / "toy" / "seed_0", spy=spy)


@pytest.fixture
def run(trained: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("gausim.cli.evaluate_run.error_figure", lambda *unused, **options: None)
    return Path(shutil.copytree(trained.run, tmp_path / "run"))


def test_training_reads_no_frame_beyond_the_seen_ones_of_the_test_part_and_no_truth(trained: SimpleNamespace) -> None:
    assert trained.spy.last["seq_001"] == 7  # frames 0..7 are seen
    assert trained.spy.truth == {"seq_000"}
    assert trained.spy.last["seq_000"] == 19  # which the spy would have noticed: the doctor looks at all of these
    assert len((trained.run / "motion.csv").read_text().splitlines()) == 3  # a heading, epochs 0 and 1
    assert (trained.run / "panels").is_dir()


def test_a_sealed_sequence_refuses_what_is_not_seen(toy: Path) -> None:
    data = ObjectData(toy, test={"sequences": ["seq_001"]}, sealed=True)
    free, sealed = data.sequences
    assert (free.limit, sealed.limit, sealed.visible, sealed.count) == (None, 8, 8, 20)
    assert len(sealed.frames(range(8))) == 8 and data.ground_truth(free) is not None
    with pytest.raises(DataError, match=r"seq_001: frames .* only images of frames 0\.\.7 are shown.*--test"):
        sealed.frames(range(7, 9))
    with pytest.raises(DataError, match=r"ground_truth\.npz: true motion asked for, but"):
        data.ground_truth(sealed)
    evidence = examine(data, None).evidence
    assert evidence is not None and [len(item.rgb) for item in evidence.watched] == [20, 8]
    opened = ObjectData(toy, test={"sequences": ["seq_001"]})
    assert opened.sequences[1].limit is None and opened.test_part == {"seq_001"}


def test_declarations(toy: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(toy, tmp_path / "toy"))
    facts = json.loads((root / "dataset.json").read_text())

    def declared(seed: int | None = None, test: object = None, given: object = None) -> set[str]:
        extra = {"seed": seed} if seed is not None else {}
        (root / "dataset.json").write_text(json.dumps(facts | extra | ({"test": test} if test is not None else {})))
        return set(ObjectData(root, test=given).test_part)  # type: ignore[arg-type]

    every = {"seq_000", "seq_001"}
    assert declared() == set() and declared(test={"sequences": "all"}) == every == declared(test={})
    assert declared(test={"sequences": ["seq_000"]}, given={"sequences": ["seq_001"]}) == every
    assert declared(101, given={"seeds": [101, 102]}) == every and declared(0, given={"seeds": [101]}) == set()
    assert declared(101, given={"seeds": [101], "sequences": ["seq_001"]}) == {"seq_001"}
    with pytest.raises(DataError, match=r"'test\.sequences' reserves \['seq_9'\], the object has"):
        declared(test={"sequences": ["seq_9"]})
    with pytest.raises(DataError, match=r"dataset\.json: test: .*sequence.*Expected \{sequences"):
        declared(test={"sequence": ["seq_000"]})
    with pytest.raises(DataError, match=r"data\.test: "):
        reserved_part({"seeds": "all"}, "data.test")


def test_looks_are_declared_counted_and_said(run, capsys, monkeypatch) -> None:
    assert evaluate.main([str(run)]) == 0  # the development part
    found = json.loads((run / "evaluation" / "metrics.json").read_text())
    assert found["objects"]["toy"]["sequences"] == ["seq_000"] and found["run"]["part"] == "development"
    assert not (run / "evaluation" / "test.json").exists()
    with pytest.raises(ConfigError, match=r"--test: expected the number of trials.*--trials N.*trials=N"):
        evaluate.main([str(run), "--test"])
    with pytest.raises(DataError, match=r"\['seq_001'\] belong to the test part, which is evaluated with --test"):
        evaluate.main([str(run), "--sequences", "seq_001"])
    with pytest.raises(DataError, match="belongs to the test part"):
        simulate.main([str(run), "--sequences", "seq_001", "--out", str(run / "film")])
    assert not (run / "evaluation" / "test.json").exists()

    assert evaluate.main([str(run), "--test", "--trials", "5"]) == 0
    assert "test part: 5 trials declared; recorded in" in capsys.readouterr().out
    assert evaluate.main([str(run), "--test", "--trials", "6"]) == 0
    assert "6 trials declared, test evaluation 2" in capsys.readouterr().out
    looks = read_looks(run / "evaluation" / "test.json")
    assert [look["trials"] for look in looks] == [5, 6] and looks[0]["date"] <= looks[1]["date"]
    assert looks[0]["sequences"] == {"toy": ["seq_001"]}
    found = json.loads((run / "evaluation" / "metrics.json").read_text())
    assert found["objects"]["toy"]["sequences"] == ["seq_001"]
    assert {key: found["run"][key] for key in ("part", "trials", "looks")} == {"part": "test", "trials": 6, "looks": 2}
    assert "part test, trials 6, looks 2" in (run / "evaluation" / "table.md").read_text()

    before = json.loads((run / "evaluation" / "development" / "metrics.json").read_text())
    assert before["run"]["part"] == "development"
    assert evaluate.main([str(run)]) == 0  # does not take the place of the test part
    assert json.loads((run / "evaluation" / "metrics.json").read_text())["run"]["part"] == "test"

    assert report.main([str(run), "--no-pictures", "--out", str(run / "page")]) == 0
    assert report.main([str(run), "--out", str(run / "results"), "--no-pictures"]) == 0
    for name in ("page/report.html", "page/results.md", "page/tables.tex", "results/results.md", "results/tables.tex"):
        text = (run / name).read_text().replace("\\", "")
        tables = text.count("<table") or text.count("| ---") or text.count("begin{tabular}")
        assert tables and "Figures of the test part" in text and "6 trials, 2 test evaluations" in text, name


def test_a_damaged_record_of_looks_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "test.json"
    assert read_looks(path) == []
    for text in ('{"schema": "gausim.test/2", "looks": []}', "{}"):
        path.write_text(text)
        with pytest.raises(RunError, match=r"test\.json: expected the record"):
            read_looks(path)


def test_data_without_a_test_part_know_no_look(toy: Path, run: Path) -> None:
    def declare(*sequences: str) -> None:
        config = yaml.safe_load((run / "config.yaml").read_text())
        config["data"]["test"]["sequences"] = list(sequences)
        (run / "config.yaml").write_text(yaml.safe_dump(config))

    declare()
    assert ObjectData(toy).test_part == frozenset()
    with pytest.raises(ConfigError, match=r"--test, --trials: .* trained on data without a test part"):
        evaluate.main([str(run), "--test", "--trials", "1"])
    declare("seq_001")
    with pytest.raises(ConfigError, match="--trials: declares the trials before a test evaluation"):
        evaluate.main([str(run), "--trials", "1"])


@pytest.mark.parametrize(("part", "trials", "reserved", "message"), [
    ("exam", None, "seq_001", r"data\.part: expected null, development or test, got 'exam'"),
    ("test", None, "seq_001", r"trials: expected the number of trials made on the development part .* got None"),
    ("test", 8, "", r"sequences of any name asked for, it has 0 of the test part"),
    (None, None, "all", r"evaluate: all sequences of the data belong to the test part\. Set data\.part=test"),
    ("test", 8, "seq_001", ""),
    ("development", None, "seq_001", ""),
])  # fmt: skip
def test_an_evaluation_after_training_that_could_not_be_made_is_refused_before(part, trials, reserved, message, toy):
    names: Any = "all" if reserved == "all" else [name for name in [reserved] if name]
    data = ReadyDataModule(toy, part=part, test={"sequences": names})
    cfg = OmegaConf.create({"data": {"part": part}, "trials": trials, "evaluate": True})
    if not message:
        check_protocol(cfg, data)
        return
    with pytest.raises((ConfigError, DataError), match=message):
        check_protocol(cfg, data)
