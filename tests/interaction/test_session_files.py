"""Files of sessions: read and written without loss, and refused with the field's name where they are wrong."""

import json
from pathlib import Path

import pytest

from gausim.core import DataError
from gausim.interaction import session as do
from gausim.interaction.selections import Ball, Kernels, Unit, Whole
from gausim.interaction.session import load_session, parse_session, save_session

MADE = do.MadeWith("cup", "a1", "b2", "c3", "seq_000", "demo/seed_0")
ENTRIES = (
    do.Entry(0, do.Force(Unit(1, 7), (0.1, 1 / 3, -2e-7), 0.30000000000000004, frames=12, name="drag")),
    do.Entry(0, do.Force(Kernels((9, 3, 4, 5, 3, 100)), (1, 0, 0), 2)),
    do.Entry(3, do.Impulse(Ball((0.1, 0.2, -0.3), 0.05), (0.0, 0.0, 1.0), 0.2)),
    do.Entry(3, do.Wind((1.0, 1.0, 0.0), 0.5, gusts=0.25)), do.Entry(4, do.Gravity((0.0, 0.0, -1.0), 1.0)),
    do.Entry(5, do.Pin(Whole())), do.Entry(8, do.Unpin()), do.Entry(8, do.Release("drag")), do.Entry(9, do.Release()),
    do.Entry(20, do.Reset()),
)  # fmt: skip
SESSION = do.ForceSession(MADE, 23.976, 20, ENTRIES, 9.81, seed=4)


def test_what_is_written_is_read_back_exactly(tmp_path: Path) -> None:
    save_session(SESSION, tmp_path / "a" / "s.json")
    read = load_session(tmp_path / "a" / "s.json")
    assert read == SESSION and [p.name for p in (tmp_path / "a").iterdir()] == ["s.json"]
    text = (tmp_path / "a" / "s.json").read_text()
    assert len(text.splitlines()) == 10 + len(ENTRIES)  # one event a line
    assert '"kernels": "3-5, 9, 100"' in text and '"frames": 12' in text
    empty = do.ForceSession(MADE, 24.0, 0, (), 9.81)
    save_session(empty, tmp_path / "e.json")
    assert load_session(tmp_path / "e.json") == empty


def edited(tmp_path: Path, change) -> str:
    save_session(SESSION, tmp_path / "s.json")
    value = json.loads((tmp_path / "s.json").read_text())
    change(value)
    return json.dumps(value)


def put(*path_and_value):
    *path, value = path_and_value

    def change(target) -> None:
        for key in path[:-1]:
            target = target[key]
        target[path[-1]] = value

    return change


@pytest.mark.parametrize(("change", "message"), [
    (put("format", "gausim.session/9"), "field 'format': expected 'gausim.session/1', got 'gausim.session/9'"),
    (put("steps", 10), "event 9: field 'at': expected 9 to 10, got 20"),
    (put("made_with", "host", "x"), "madewith: Unexpected keyword argument .host."),
    (put("events", 4, "at", 2), "event 4: field 'at': expected 3 to 20, got 2"),
    (put("events", 0, "do", "explode"), "event 0: field 'do': expected one of force, release"),
    (put("events", 0, "direction", [0, 0, 0]), "event 0: field 'direction': expected a vector that is not zero"),
    (put("events", 0, "on", {"level": 1, "unit": -2}), "event 0: field 'index': expected int >= 0"),
    (put("events", 1, "on", {"kernels": "0-999999999"}), "event 1: field 'kernels': .*at most 10000000 kernels"),
])  # fmt: skip
def test_wrong_fields_are_named(tmp_path: Path, change, message: str) -> None:
    with pytest.raises(DataError, match=f"bad.json: .*{message}"):
        parse_session(edited(tmp_path, change), "bad.json")


@pytest.mark.parametrize(("text", "message"), [
    ("", "bad.json: Input data was truncated"),
    ("[]", "field 'format'"),
    ("[" * 200_000, "nested too deeply"),
    ('{"format": ' + "9" * 5000 + "}", "out of range"),
    ('{"format": 1e999}', "out of range"),
])  # fmt: skip
def test_what_is_no_session_is_refused(text: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        parse_session(text, "bad.json")
