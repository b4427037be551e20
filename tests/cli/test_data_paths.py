"""Where the data of a run lie: its configuration, and what ``--data`` says."""

from __future__ import annotations

from pathlib import Path

import pytest

from gausim.compose.data_paths import data_option, located
from gausim.core import ConfigError, DataError


def test_data_words_become_keys_and_entries_keep_what_else_they_say(tmp_path: Path) -> None:
    assert data_option([]) == {}
    assert data_option(["a"]) == {"root": "a"}
    assert data_option(["a", "root=b=c", "scene=s.ply"]) == {"root": ["a", "b=c"], "scene": "s.ply"}
    assert data_option(["odd=name"]) == {"root": "odd=name"}
    with pytest.raises(ConfigError, match="--data masks=b: masks is given twice"):
        data_option(["masks=a", "masks=b"])
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    own = {"root": ["/gone", {"root": "/gone/too", "selections": {"pinned": "z=0.1"}}], "names": ["x"]}
    found = located(tmp_path, own, data_option([str(tmp_path / "a"), str(tmp_path / "b")]))
    assert found["root"] == [str(tmp_path / "a"), {"root": str(tmp_path / "b"), "selections": {"pinned": "z=0.1"}}]
    assert found["names"] == ["x"]
    with pytest.raises(DataError, match="field data.root names /gone/too"):
        located(tmp_path, {"root": [str(tmp_path / "a"), own["root"][1]]}, {})
    (tmp_path / "set").mkdir()
    entry = {"root": str(tmp_path / "set"), "scene": "/gone/bunny.ply"}
    own = {"root": [entry], "scene": None, "masks": None}
    with pytest.raises(DataError, match=r"field data.root\[0\].scene names /gone/bunny.ply, expected a file"):
        located(tmp_path, own, {})
