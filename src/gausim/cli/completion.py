"""Completions of a command line of `gausim`, called by the scripts in shells/.

This module does not load torch, so that completion is fast.
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Iterator, Sequence
from pathlib import Path

from gausim.cli.main import COMMANDS

# Part of the name of arguments that take Hydra's overrides.
OVERRIDES = "KEY=VALUE"


def complete(words: Sequence[str]) -> list[str]:
    """Completions of the last of the words after `gausim` (empty after a space); none for files and free text."""
    *before, word = words or [""]
    if not before:
        offered = [*COMMANDS, *(("--help", "--version") if word.startswith("-") else ())]
    elif before[0] in COMMANDS:
        module = importlib.import_module(f"gausim.cli.{before[0]}")
        make = getattr(module, "_parser", _hydra_parser)  # Hydra parses the arguments of `gausim train`
        offered = list(_arguments(make(), before[1:], word))
    else:
        offered = []
    return [choice for choice in offered if choice.startswith(word)]


def _hydra_parser() -> argparse.ArgumentParser:
    from hydra._internal.utils import get_args_parser

    parser = get_args_parser()
    for action in parser._actions:
        if action.dest == "overrides":
            action.metavar = OVERRIDES
    return parser


def _arguments(parser: argparse.ArgumentParser, before: Sequence[str], word: str) -> Iterator[str]:
    """Arguments that a parser, or the sub-command in ``before``, accepts next."""
    places = [action for action in parser._actions if not action.option_strings]
    taking: argparse.Action | None = None  # the option that the words after it belong to
    taken = 0
    for index, said in enumerate(before):
        if said in parser._option_string_actions:
            taking, taken = parser._option_string_actions[said], 0
        elif taking is not None and taken < _most(taking):
            taken += 1
        elif places and isinstance(places[0], argparse._SubParsersAction):
            if said in places[0].choices:
                yield from _arguments(places[0].choices[said], before[index + 1 :], word)
            return
        elif places and _most(places[0]) == 1:
            places.pop(0)
    if taking is not None and taken < _most(taking):
        yield from _values(taking, before, word)
        if taken or taking.nargs in ("*", "?"):
            yield from _options(parser, word)
        return
    if places and not word.startswith("-"):
        yield from _values(places[0], before, word)
    yield from _options(parser, word)


def _most(action: argparse.Action) -> float:
    """Largest number of words of an argument."""
    return action.nargs if isinstance(action.nargs, int) else float("inf") if action.nargs in ("*", "+") else 1


def _options(parser: argparse.ArgumentParser, word: str) -> Iterator[str]:
    if word.startswith("-"):
        yield from (option for option in parser._option_string_actions if option.startswith("--") or len(word) == 1)


def _values(action: argparse.Action, before: Sequence[str], word: str) -> Iterator[str]:
    yield from map(str, action.choices or ())
    if OVERRIDES in str(action.metavar):
        yield from _overrides(before, word)


def _overrides(before: Sequence[str], word: str) -> list[str]:
    """Groups, their files, keys and values that Hydra offers given the other overrides; of a list, its last entry."""
    import hydra
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from hydra.plugins.completion_plugin import DefaultCompletionPlugin
    from omegaconf.errors import OmegaConfBaseException

    from gausim.compose.places import spelled
    from gausim.compose.root import HYDRA_VERSION_BASE, conf_dir

    key, _, value = word.partition("=")
    listed, comma, last = value.rpartition(",")
    asked = f"{key}={last}" if comma else word
    begun = key.rpartition(".")[0]
    chosen = [said for said in before if "=" in said and "," not in said]
    with hydra.initialize_config_dir(str(conf_dir()), version_base=HYDRA_VERSION_BASE):
        plugin = DefaultCompletionPlugin(GlobalHydra.instance().config_loader())
        try:
            found = plugin._query("train", " ".join([*spelled(chosen), asked]) if asked else f"{' '.join(chosen)} ")
            if begun and plugin._query("train", " ".join([*spelled(chosen), f"{begun}."])):
                found = sorted({*found, *_more(key, asked)})
        except (HydraException, OmegaConfBaseException):  # an earlier word is wrong, or a value is missing
            return []
    if comma:
        return [f"{key}={listed},{choice.removeprefix(f'{key}=')}" for choice in found]
    return [also for choice in found for also in _either(choice) if _is_for_people(also, word)]


def _more(key: str, asked: str) -> list[str]:
    """Settings that Hydra does not list: those with this prefix, or the value of the requested one."""
    from gausim.compose.places import more_settings

    more = more_settings()
    if "=" in asked:
        return [f"{key}={str(more[key]).lower()}"] if isinstance(more.get(key), bool) else []
    return [f"{name}=" for name in more if name.startswith(key) and "." not in name[len(key) :]]


def _either(choice: str) -> tuple[str, ...]:
    """Both truth values, where Hydra offers only the current one; for a directory its content."""
    key, _, value = choice.partition("=")
    if value.startswith(("/", ".")) and Path(value).is_dir():
        return (f"{choice}/",)
    return (f"{key}=true", f"{key}=false") if value in ("true", "false") else (choice,)


def _is_for_people(choice: str, word: str) -> bool:
    """Whether a completion is offered: not Hydra's internal keys, unless the word begins like one."""
    name, begun = choice.partition("=")[0].rpartition(".")[2], word.rpartition(".")[2]
    return (not name.startswith("_") or begun.startswith("_")) and (choice != "hydra")
