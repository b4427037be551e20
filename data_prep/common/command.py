"""Common parts of the stages' command lines: options as fields of dataclasses, progress, results, errors."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

from data_prep.common.progress import Tick, bars
from gausim.core.errors import ConfigError, GausSimError, sentence

T = TypeVar("T", bound="Options")
_TYPES: dict[str, type] = {"int": int, "float": float, "Path": Path, "tuple[float,": float, "tuple[int,": int}


def option(
    default: Any, help: str, *, least: float = -math.inf, most: float = math.inf, interval: bool = False,
    **argument: Any,
) -> Any:  # fmt: skip
    """A field of an :class:`Options` that is an option of the command line.

    Args:
        default: its value unless it is given.
        help: text for the command line.
        least: smallest number that it may be.
        most: largest.
        interval: it is two numbers, LOW and HIGH, the smaller one first.
        argument: of ``add_argument``, where the field's type does not say it.
    """
    if interval:
        argument = {"nargs": 2, "metavar": ("LOW", "HIGH"), **argument}
    about = {"argument": {"help": help, **argument}, "range": (least, most), "interval": interval}
    return field(default=default, metadata=about)


@dataclass(frozen=True)
class Options:
    """Options of a stage; the fields that :func:`option` made are options of its command line."""

    def __post_init__(self) -> None:
        """Checks choices and numbers; a :class:`ConfigError` names the option."""
        for each in fields(self):
            value, (least, most) = getattr(self, each.name), each.metadata.get("range", (-math.inf, math.inf))
            choices = each.metadata.get("argument", {}).get("choices")
            for one in value if isinstance(value, tuple) else (value,):
                if choices and one not in choices:
                    raise ConfigError(f"{_flag(each.name)}: expected one of {', '.join(choices)}, got '{one}'.")
                if isinstance(one, (int, float)) and not (math.isfinite(one) and least <= one <= most):
                    expected = f"at least {least:g}" if most == math.inf else f"{least:g} to {most:g}"
                    raise ConfigError(f"{_flag(each.name)}: expected {expected}, got {one:g}.")
            if each.metadata.get("interval") and value is not None and value[0] > value[1]:
                raise ConfigError(f"{_flag(each.name)}: expected LOW <= HIGH, got {value[0]:g} {value[1]:g}.")


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def add_options(parser: argparse._ActionsContainer, kind: type[Options], *, unset: bool = False) -> None:
    """Adds the options of a stage; those that are not given are None with ``unset``, else what the fields say."""
    for each in (one for one in fields(kind) if one.metadata):
        argument = dict(each.metadata["argument"])
        kind_of = str(each.type).partition(" ")[0]
        if kind_of == "bool":
            argument["action"] = "store_true"
        elif kind_of in _TYPES:
            argument.setdefault("type", _TYPES[kind_of])
        default: Any = None if unset else each.default
        parser.add_argument(
            _flag(each.name), default=list(default) if isinstance(default, tuple) else default, **argument
        )


def given(kind: type[Options], arguments: argparse.Namespace) -> dict[str, Any]:
    """The arguments that have the names of a dataclass's fields, without those that were not given."""
    found = {each.name: getattr(arguments, each.name, None) for each in fields(kind)}
    return {name: tuple(v) if isinstance(v, list) else v for name, v in found.items() if v is not None}


def chosen(kind: type[T], arguments: argparse.Namespace) -> T:
    """The options of a stage from its arguments."""
    return kind(**given(kind, arguments))


def names(text: str) -> tuple[str, ...]:
    """Names between commas; ``none`` is none."""
    return () if text == "none" else tuple(name.strip() for name in text.split(",") if name.strip())


def cores() -> int:
    """Number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def stage_parser(name: str, text: str, *, epilog: str | None = None, result: bool = True) -> argparse.ArgumentParser:
    """The parser of `gausim prepare NAME`; with ``result`` it knows where the result goes and what it may replace."""
    parser = argparse.ArgumentParser(
        prog=f"gausim prepare {name}", description=text.replace("``", ""), epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    if result:
        parser.add_argument("--out", type=Path, required=True, help="write the result to this folder")
        parser.add_argument("--overwrite", action="store_true", help="replace a result of other inputs or settings")
    return parser


def run_command(
    parser: argparse.ArgumentParser, argv: list[str] | None, run: Callable[[argparse.Namespace, Tick], str],
    *, waiting: str | None = None,
) -> int:  # fmt: skip
    """Runs a stage with bars of its progress, prints what it returns, and turns what went wrong into a line.

    Returns:
        The exit code: 0, 2 after an error, 130 where the user has interrupted it.
    """
    arguments = parser.parse_args(argv)
    try:
        with bars(waiting) as tick:
            text = run(arguments, tick)
    except (GausSimError, OSError) as error:
        print(f"error: {sentence(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted. The same command goes on where it was.", file=sys.stderr)
        return 130
    print(text)
    return 0


def headline(out: Path, manifest: Mapping[str, Any]) -> str:
    """The first line that a stage prints when it is done."""
    return f"{out}: {'made' if manifest['made'] else 'there already'}"
