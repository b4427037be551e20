"""`gausim evaluate RUN`: measures a trained run on seen, unseen and held-out frames."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from gausim.cli.arguments import add_data_option, command_parser, positive
from gausim.core.errors import ConfigError

if TYPE_CHECKING:
    from gausim.cli.test_part import Chosen
    from gausim.compose.build import LoadedRun
    from gausim.data.objects import ObjectData
    from gausim.results.curves import ObjectCurves

WRITTEN = ("metrics.json", "metrics.npz", "pictures.npz", "table.md")


def main(argv: list[str]) -> int:
    """Runs the command; returns the exit status."""
    arguments = _parser().parse_args(argv)
    if arguments.endurance is not None and arguments.endurance < 300:
        raise ConfigError(f"--endurance: expected at least 300 frames, got {arguments.endurance}.")
    from rich.console import Console
    from rich.markdown import Markdown

    from gausim.cli.end import end, error_sentences
    from gausim.cli.test_part import choose, look
    from gausim.compose.build import is_pretrained, load_run
    from gausim.compose.data_paths import data_option
    from gausim.compose.predict import state_of
    from gausim.evaluation.evaluation import write_evaluation
    from gausim.report.pictures.figures import error_figure
    from gausim.report.pictures.motion import diagnosis_figure

    if is_pretrained(arguments.run):
        return _evaluate_bodies(arguments)
    run = load_run(arguments.run, data=data_option(arguments.data))
    facts = {"name": run.config.get("name"), "seed": run.config.get("seed"), "views": arguments.views, **state_of(run)}
    chosen = choose(run, arguments)
    if arguments.test:
        facts |= look(run, arguments, chosen, facts)
        run = load_run(arguments.run, data=data_option(arguments.data))  # now the test part is open
    elif chosen.part:
        facts |= {"part": chosen.part}
    results = _evaluate(run, arguments, chosen)
    whole, folder = _folder(run, arguments, chosen.part)
    summary = write_evaluation(folder, results, facts)
    drawn: list[str] = []
    for curves in results:
        name = curves.facts.name
        error_figure(curves, folder / f"errors_{name}.png")
        shown = diagnosis_figure(name, summary["objects"][name], folder / f"motion_{name}.png")
        drawn += [f"errors_{name}.png", *([f"motion_{name}.png"] if shown else [])]
    if arguments.endurance is not None:
        drawn += _endure(run, arguments, folder)
    if arguments.json:
        print((folder / "metrics.json").read_text(), end="")
        return 0
    if arguments.verbose:
        # Rich would truncate columns at 80 characters in files.
        Console(width=None if sys.stdout.isatty() else 200).print(Markdown((folder / "table.md").read_text()))
        print("\n".join(f"wrote {folder / name}" for name in [*WRITTEN, *drawn]))
    commands = [["report", arguments.run], ["simulate", arguments.run]] if whole else [["evaluate", arguments.run]]
    end(error_sentences(summary["objects"]), "tables", folder / "table.md", *commands)
    return 0


def _evaluate_bodies(arguments: argparse.Namespace) -> int:
    """Measures a run on a corpus: the motion, and where it was fitted the stiffness, of the bodies held out."""
    from gausim.cli.end import end
    from gausim.compose.build import load_corpus_run
    from gausim.compose.data_paths import data_option
    from gausim.evaluation.corpus import FILE, body_figures, sentences, write_figures

    parts = arguments.object or arguments.sequences or arguments.views != "all" or arguments.test
    if parts or arguments.endurance is not None:
        raise ConfigError(
            f"{arguments.run}: a run on a corpus is measured as a whole, on true points. Leave out --object, "
            "--sequences, --views, --test and --endurance."
        )
    folder = arguments.out or arguments.run / "evaluation"
    module, data = load_corpus_run(arguments.run, data=data_option(arguments.data))
    pretrained = _pretrained(arguments.run, data.trainable)
    whole = write_figures(folder, body_figures(module, data), seen=data.seen, pretrained=pretrained)
    if arguments.json:
        print((folder / FILE).read_text(), end="")
        return 0
    end(sentences(whole), "figures", folder / FILE)
    return 0


def _pretrained(run: Path, trainable: int) -> int | None:
    """Number of bodies that the network of a run on a corpus was trained on; None where its base is gone."""
    from gausim.runs.directory import RunDirectory

    config = RunDirectory(run).config()
    if config["data"]["part"] != "train":
        base = config.get("init_from")
        if base is None or not Path(base).is_dir():
            return 0 if base is None else None
        config = RunDirectory(base).config()
    bodies = config["data"].get("bodies")
    return trainable if bodies is None else int(bodies)


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("evaluate", " Writes metrics.json, metrics.npz, table.md and an error plot per object.")
    add = parser.add_argument
    add("run", metavar="RUN", type=Path, help="run directory of `gausim train`")
    add("--object", nargs="+", metavar="NAME", help="only these objects")
    add("--sequences", nargs="+", metavar="NAME", help="only these sequences (of every object)")
    add("--test", action="store_true", help="look at the test part of the data; counted in evaluation/test.json")
    add("--trials", type=positive, metavar="N", help="with --test: trials made of the method on the development part "
        "(default: protocol.trials of the run)")  # fmt: skip
    add("--views", default="all", choices=("all", "train", "heldout"), help="which cameras (default: all)")
    add_data_option(parser)
    add("--out", metavar="DIR", type=Path, help="folder to write; default RUN/evaluation, or RUN/evaluation/partial "
        "for a part")  # fmt: skip
    add(
        "--endurance", type=int, metavar="N",
        help="also roll N frames far, free and under random pushes in the first 240 (at least 300; 1000 is a good "
        "number); writes endurance.json and a figure per object",
    )  # fmt: skip
    add("--verbose", action="store_true", help="print all tables, and list the files that are written")
    add("--json", action="store_true", help="print metrics.json and nothing else")
    return parser


def _evaluate(run: LoadedRun, arguments: argparse.Namespace, chosen: Chosen) -> list[ObjectCurves]:
    from gausim.cli.bars import named_bar
    from gausim.compose.predict import TrainedPrediction, run_objects, scene_of
    from gausim.evaluation.evaluation import evaluate_object

    items = run_objects(run, list(chosen.sequences))
    with named_bar(sum(map(len, chosen.sequences.values())), "evaluate") as advance:
        return [
            evaluate_object(
                item.data,
                scene_of(run, item),
                {run.module.method_name: TrainedPrediction(run, item)},
                run.renderer,
                sequences=chosen.sequences[item.data.name],
                views=_views(item.data, arguments.views),
                advance=advance,
            )
            for item in items
        ]


def _endure(run: LoadedRun, arguments: argparse.Namespace, folder: Path) -> list[str]:
    """Evaluates long rollouts of each object's first sequence; returns the names of the written files."""
    from gausim.compose.predict import endurance, run_objects
    from gausim.report.pictures.motion import endurance_figure

    found = {item.data.name: endurance(run, item, arguments.endurance) for item in run_objects(run, arguments.object)}
    (folder / "endurance.json").write_text(json.dumps(found, indent=1) + "\n")
    for name, rollouts in found.items():
        endurance_figure(name, rollouts, folder / f"endurance_{name}.png")
        for kind, rollout in rollouts.items():
            growth, late = rollout["growth"], rollout["late"]
            print(f"{name}, {kind}: highest energy later over before {growth:.3f}, of the last tenth {late:.2g}")
    return ["endurance.json", *(f"endurance_{name}.png" for name in found)]


def _views(data: ObjectData, group: str) -> list[str]:
    from gausim.core.errors import DataError

    chosen = {"train": data.train_views, "heldout": data.heldout_views}.get(group, data.views)
    if not chosen:
        raise DataError(f"{data.root}: dataset.json names no held-out view. Use --views all or train.")
    return list(chosen)


def _folder(run: LoadedRun, arguments: argparse.Namespace, part: str | None) -> tuple[bool, Path]:
    """Whether the evaluation covers the whole run (a partial one never overwrites it), and its folder."""
    from gausim.cli.test_part import home

    whole = home(run.run_dir, part)
    partial = arguments.object or arguments.sequences or arguments.views != "all"
    folder = arguments.out or (whole / "partial" if partial else whole)
    return folder == run.run_dir / "evaluation", folder
