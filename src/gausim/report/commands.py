"""Commands of runs as few lines: those of jobs that differ by the values of one key are one sweep."""

from __future__ import annotations

import shlex
from collections.abc import Iterable

_TRAIN, _SWEEP = ["gausim", "train"], "-m"
_ROOT, _DEFAULT_ROOT = "output_root", "outputs"
_WITHOUT_EFFECT = (_ROOT, "trainer.progress", "trainer.threads")

# Values of a command by key, in the order of its words; a word without "=" has none.
Words = dict[str, list[str]]


def joined(commands: Iterable[str]) -> list[str]:
    """The commands without settings that change no figure, and jobs joined to sweeps.

    Jobs are joined as long as two commands differ by the values of a single key, so that the sweeps make the same runs
    and no other. Directories of runs are named below the default ``outputs``.
    """
    known = list(dict.fromkeys(commands))
    trains = [_parsed(command) for command in known if shlex.split(command)[:2] == _TRAIN]
    others = [command for command in known if shlex.split(command)[:2] != _TRAIN]
    keys = sorted({key: None for words in trains for key in words}, key=lambda key: key != "seed")  # seeds first
    count = -1
    while count != len(trains):
        count = len(trains)
        for key in keys:
            trains = _over(trains, key)
    return list(dict.fromkeys([*map(_text, trains), *others]))


def _parsed(command: str) -> Words:
    pairs = [word.lstrip("+").partition("=") for word in shlex.split(command)[2:]]
    root = next((value for key, _, value in pairs if key == _ROOT), _DEFAULT_ROOT).rstrip("/")
    return {
        key: _choices(value.replace(f"{root}/", f"{_DEFAULT_ROOT}/")) if equals else []
        for key, equals, value in pairs
        if key not in _WITHOUT_EFFECT
    }


def _choices(value: str) -> list[str]:
    """The choices of a sweep: commas within brackets or quotes do not divide them."""
    return [value] if set(value) & set("[{(\"'") else sorted(value.split(","))


def _over(commands: list[Words], key: str) -> list[Words]:
    """Joins commands that differ by the values of ``key`` alone."""
    same: dict[str, Words] = {}
    for words in commands:
        others = repr((key in words, sorted(pair for pair in words.items() if pair[0] not in (key, _SWEEP))))
        before = same.get(others, {})
        values = [*before.get(key, []), *(v for v in words.get(key, []) if v not in before.get(key, []))]
        same[others] = before | words | ({key: sorted(values)} if key in words else {})
    return list(same.values())


def _text(words: Words) -> str:
    told = [f"{key}={','.join(values)}" if values else key for key, values in words.items() if key != _SWEEP]
    is_sweep = _SWEEP in words or any(len(values) > 1 for values in words.values())
    return " ".join([*_TRAIN, *([_SWEEP] if is_sweep else []), *map(shlex.quote, told)])
