"""What `gausim evaluate RUN` does: the development and the test part of the data, tables, figures, long rollouts."""

import argparse
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markdown import Markdown

from gausim.cli.output import end, named_bar
from gausim.compose.build import LoadedRun, load_run
from gausim.compose.data_paths import data_option
from gausim.compose.predict import run_objects, state_of
from gausim.core.errors import ConfigError, DataError
from gausim.data.objects import ObjectData
from gausim.evaluation.evaluation import evaluate_object, write_evaluation
from gausim.pictures.figures import error_figure
from gausim.report.verdict import first_sentences
from gausim.results.curves import ObjectCurves
from gausim.results.looks import DEVELOPMENT, TEST_PART, record_look
from gausim.runs.names import TEST
from gausim.runs.provenance import code_provenance

WRITTEN = ("metrics.json", "metrics.npz", "table.md")


def evaluate(arguments: argparse.Namespace) -> int:
    """Measures a run by the options of the command; returns the exit status."""
    run = load_run(arguments.run, data=data_option(arguments.data), device=arguments.device)
    facts = {**{key: run.config.get(key) for key in ("name", "seed")}, "views": arguments.cameras, **state_of(run)}
    part, sequences = _choose(run, arguments)
    if arguments.test:
        facts |= _look(run, arguments, sequences, facts)
        # Now the test part is open.
        run = load_run(arguments.run, data=data_option(arguments.data), device=arguments.device)
    elif part:
        facts |= {"part": part}
    whole = _home(run.run_dir, part)
    partial = arguments.objects or arguments.sequences or arguments.cameras != "all"  # never overwrites the whole
    folder = arguments.out or (whole / "partial" if partial else whole)
    results = _evaluate(run, arguments, sequences, folder)
    written = write_evaluation(folder, results, facts)
    drawn: list[str] = []
    for curves in results:
        error_figure(curves, folder / f"errors_{curves.name}.png")
        drawn += [f"film_{curves.name}.mp4", f"errors_{curves.name}.png"]
    if arguments.json:
        print((folder / "metrics.json").read_text(), end="")
        return 0
    if arguments.verbose:
        # Rich would truncate columns at 80 characters in files.
        Console(width=None if sys.stdout.isatty() else 200).print(Markdown((folder / "table.md").read_text()))
        print("\n".join(f"wrote {folder / name}" for name in [*WRITTEN, *drawn]))
    commands = ["report", "simulate"] if folder == run.run_dir / "evaluation" else ["evaluate"]
    following = [[command, arguments.run] for command in commands]
    end(first_sentences(written), "tables", folder / "table.md", *following)
    return 0


def _evaluate(
    run: LoadedRun, arguments: argparse.Namespace, sequences: dict[str, list[str]], folder: Path
) -> list[ObjectCurves]:
    items = run_objects(run, list(sequences))
    with named_bar(sum(map(len, sequences.values())), "evaluate") as advance:
        return [
            evaluate_object(
                item.data,
                item.scene,
                {run.module.method_name: item},
                run.renderer,
                sequences=sequences[item.data.name],
                views=_views(item.data, arguments.cameras),
                advance=advance,
                films=folder,
            )
            for item in items
        ]


def _views(data: ObjectData, group: str) -> list[str]:
    chosen = {"train": data.train_views, "heldout": data.heldout_views}.get(group, data.views)
    if not chosen:
        raise DataError(f"{data.root}: dataset.json names no held-out view. Use --cameras all or train.")
    return list(chosen)


def _choose(run: LoadedRun, arguments: argparse.Namespace) -> tuple[str | None, dict[str, list[str]]]:
    """The part to evaluate (None where the data declare no test part), and names of its sequences by object."""
    items = run_objects(run, arguments.objects)
    declared = any({r.name for r in item.data.sequences} & item.data.test_part for item in items)
    if not declared and (arguments.test or arguments.trials):
        raise ConfigError(
            f"--test, --trials: {run.run_dir} was trained on data without a test part. Leave the options out, or "
            "declare one (field 'test' of dataset.json, or data.test)."
        )
    if arguments.trials and not arguments.test:
        raise ConfigError("--trials: declares the trials before a test evaluation; give --test with it.")
    found = {}
    for item in items:
        names = arguments.sequences or [record.name for record in item.data.sequences]
        own = [item.sequence(name).name for name in names]
        fitting = [name for name in own if (name in item.data.test_part) == arguments.test]
        if arguments.sequences and len(fitting) < len(own):
            other = [name for name in own if name not in fitting]
            part, how = ("development", "without") if arguments.test else ("test", "with")
            raise DataError(f"{item.data.root}: {other} belong to the {part} part, which is evaluated {how} --test.")
        if fitting:
            found[item.data.name] = fitting
    if not found:
        raise ConfigError(
            f"{run.run_dir}: every sequence of it belongs to the test part. When all decisions are made, evaluate it "
            f"with `gausim evaluate {run.run_dir} --test --trials N`, N: the trials made on the development part."
            if not arguments.test
            else f"{run.run_dir}: no sequence of the chosen objects belongs to the test part. Leave --test out."
        )
    return (TEST_PART if arguments.test else DEVELOPMENT) if declared else None, found


def _look(
    run: LoadedRun, arguments: argparse.Namespace, sequences: dict[str, list[str]], state: dict[str, Any]
) -> dict[str, Any]:
    """Records a look at the test part; returns what the summary says of it."""
    trials = arguments.trials or run.config.get("trials")
    if not trials:
        raise ConfigError(
            "--test: expected the number of trials that were made of the method on the development part. Declare it "
            "with --trials N, or train with trials=N."
        )
    path, folder = run.run_dir / TEST, run.run_dir / "evaluation"
    if not path.is_file() and (folder / "metrics.json").is_file():  # an earlier evaluation of the development part
        (folder / DEVELOPMENT).mkdir(exist_ok=True)
        for file in sorted(file for file in folder.iterdir() if file.is_file()):
            file.replace(folder / DEVELOPMENT / file.name)
    looks = record_look(path, trials=trials, provenance=code_provenance(), state=state, sequences=sequences)
    again = f", test evaluation {looks}" if looks > 1 else ""
    print(f"test part: {trials} trials declared{again}; recorded in {path}")
    return {"part": TEST_PART, "trials": trials, "looks": looks}


def _home(run_dir: Path, part: str | None) -> Path:
    """Folder of a whole evaluation: that of the development part makes room for the test part once it was looked at."""
    folder = run_dir / "evaluation"
    return folder / DEVELOPMENT if part == DEVELOPMENT and (run_dir / TEST).is_file() else folder
