"""Names, paths, numbers and YAML of strangers: obeyed, or refused in a sentence before anything is written."""

from pathlib import Path

import pytest
import yaml

from gausim.cli.main import main
from gausim.compose.command import quoted, with_data_directories
from gausim.compose.config import compose
from gausim.compose.targets import check_hydra, check_seed
from gausim.core import ConfigError, DataError
from gausim.io.files import read_yaml, safe_name
from gausim.report.write import spreadsheet_cells

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


@pytest.mark.parametrize("levels", [6, 9, 60])
def test_nested_aliases_are_bounded(tmp_path: Path, levels: int) -> None:
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, levels)]
    (tmp_path / "a.yaml").write_text("\n".join(lines))
    with pytest.raises(ValueError, match="when its aliases are written out"):
        read_yaml(tmp_path / "a.yaml")


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
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 9)]
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
