"""Options that mean the same have one spelling in every command and stage."""

from __future__ import annotations

import re

import pytest

from gausim.cli import main as cli
from gausim.cli.prepare import STAGES

HYDRA = ("train", "config")
COMMANDS = [[name] for name in cli.COMMANDS if name not in ("prepare", *HYDRA)]
EVERY = [*COMMANDS, *(["prepare", stage] for stage in STAGES)]
# Other words for the same: --objects, --sequences and --cameras of names, --overwrite, --pin, --device, --threads.
WRONG = {
    *("object", "sequence", "camera", "view", "replace", "clobber", "pin-below", "pin-above", "pins", "cuda", "gpu"),
    *("accelerator", "num-threads", "nthreads", "jobs"),
}
PRESENT = {
    "objects": ("evaluate", "simulate", "view", "export", "inspect"), "sequences": ("evaluate", "simulate", "adapt"),
    "cameras": ("evaluate", "simulate", "export"), "device": ("evaluate", "simulate", "view", "export"),
    "threads": ("evaluate", "simulate", "view", "export", "doctor", "reconstruct"), "overwrite": ("adapt",),
    "pin": ("inspect", "reconstruct", "doctor", "simulate", "view"),
}  # fmt: skip


def shown(argv: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("COLUMNS", "1000")
    with pytest.raises(SystemExit) as ended:
        cli.command(argv[0])([*argv[1:], "--help"])
    assert ended.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("argv", EVERY, ids=" ".join)
def test_each_meaning_has_its_spelling(argv: list[str], capsys, monkeypatch) -> None:
    text = shown(argv, capsys, monkeypatch)
    parts = re.split(r"^\s+(?:-\w, )?--(?=[a-z])", text, flags=re.MULTILINE)[1:]
    options = {re.match(r"[a-z-]+", part)[0]: part for part in parts}
    assert not WRONG & set(options), WRONG & set(options)
    assert "force" not in options or "KEY=VALUE" in options["force"]
    for name, commands in PRESENT.items():
        assert name in options or argv[0] not in commands, name
    for name in ("device", "threads"):
        assert argv[0] == "prepare" or name not in options or "default: " in options[name]
