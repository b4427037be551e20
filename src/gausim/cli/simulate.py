"""`gausim simulate RUN`: videos, space-time slices, error plots and trajectories of a run's predictions."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from gausim.cli.arguments import UPS, add_data_option, add_scene_options, command_parser, parse_background, positive
from gausim.core.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from gausim.compose.build import LoadedRun
    from gausim.compose.predict import RunObject
    from gausim.core import Trajectory
    from gausim.data.records import SequenceRecord


def main(argv: list[str]) -> int:
    """Runs the command; returns the exit status."""
    from gausim.interaction.words import has_forces

    arguments = _parser().parse_args(argv)
    parse_background(arguments.background)  # raises on a wrong value before the simulation
    if (arguments.run is None) == (arguments.scene is None):
        raise ConfigError("expected a RUN, or --scene SCENE.ply and the run whose network moves it, --from RUN.")
    if arguments.scene is not None:
        from gausim.cli.simulate_forces import simulate_scene

        return simulate_scene(arguments)
    from gausim.cli.end import end, push
    from gausim.compose.build import load_run
    from gausim.compose.data_paths import data_option
    from gausim.compose.predict import run_objects, state_of

    run = load_run(arguments.run, data=data_option(arguments.data))
    state_of(run)
    folder = arguments.out or run.run_dir / "simulation"
    if arguments.session or has_forces(arguments):
        from gausim.cli.simulate_forces import simulate_forces

        return simulate_forces(run, arguments, folder)
    items = run_objects(run, arguments.object)
    sentences = [_simulate_object(run, item, arguments, folder / item.data.name) for item in items]
    first = items[0].data.name
    push_it = push(arguments.run, first if len(run.objects) > 1 else None)
    end(sentences, "videos", folder if len(items) > 1 else folder / first, ["view", arguments.run], push_it)
    return 0


def _parser() -> argparse.ArgumentParser:
    from gausim.interaction.words import EPILOG, add_force_options

    parser = command_parser(
        "simulate",
        "\nPer sequence: trajectory.safetensors, errors.png, and per view an MP4 (ground truth |\n"
        "prediction | error), space-time slices and a contact sheet. With forces or a session:\n"
        "trajectory.safetensors, session.json, and per view an MP4 with the forces drawn, and a sheet.",
        epilog=EPILOG,
    )
    add = parser.add_argument
    add("run", metavar="RUN", nargs="?", type=Path, help="run directory of `gausim train`")
    add("--object", nargs="+", metavar="NAME", help="only these objects")
    add("--sequence", nargs="+", metavar="NAME", help="sequences, or `all`; default the first of each object")
    add("--frames", type=positive, metavar="N", help="frames to predict; default as many as were recorded")
    add("--view", nargs="+", metavar="NAME", help="cameras; default the first trained and the first held-out one")
    add_data_option(parser)
    add("--out", metavar="DIR", type=Path, help="folder to write; default RUN/simulation")
    add("--background", default="black", metavar="COLOR", help="black, white or R,G,B in 0..1 (default: black)")
    add("--brighten", type=float, default=1.0, metavar="GAIN", help="gain of the pictures; numbers are never touched")
    add("--slow", type=float, default=1.0, metavar="FACTOR", help="slow motion of the videos, e.g. 3")
    add("--gif", action="store_true", help="write GIFs besides")
    add("--verbose", action="store_true", help="list the files that are written")
    add_force_options(parser)
    group = add_scene_options(parser)
    group.add_argument(
        "--scene", metavar="SCENE.ply", type=Path, help="3DGS scene; give --from, and pins if it has none"
    )
    group.add_argument("--up", choices=UPS, default="z", help="vertical axis of the scene (write --up=-y; default: z)")
    group.add_argument("--azimuth", type=float, default=0.0, metavar="DEGREES", help="of the camera (default: 0)")
    return parser


def _simulate_object(run: LoadedRun, item: RunObject, arguments: argparse.Namespace, folder: Path) -> str:
    """Writes all results on an object's sequences; returns a sentence on their errors."""
    from gausim.cli.bars import named_bar
    from gausim.cli.end import error_sentences
    from gausim.cli.simulate_forces import write_trajectory
    from gausim.compose.predict import TrainedPrediction, scene_of, sequence_of
    from gausim.evaluation.evaluation import evaluate_object
    from gausim.report.pictures.figures import error_figure
    from gausim.results.summary import summarise

    names = arguments.sequence or [item.data.sequences[0].name]
    names = [record.name for record in item.data.sequences] if names == ["all"] else names
    views = arguments.view or [*item.data.train_views[:1], *item.data.heldout_views[:1]]
    for name in names:
        sequence_of(item, name).camera_indices(views)  # raises on an unknown sequence or view before the simulation
    predict = TrainedPrediction(run, item, frames=arguments.frames or 0)
    with named_bar(len(names) * (1 + len(views)), f"simulate {item.data.name}") as advance:
        curves = evaluate_object(
            item.data, scene_of(run, item), {run.module.method_name: predict}, run.renderer, sequences=names,
            advance=advance,
        )  # fmt: skip
        for name in names:
            record = item.data.record(sequence_of(item, name).name)
            trajectory = predict(record, arguments.frames)
            error_figure(curves, folder / name / "errors.png", sequence=name)
            write_trajectory(run, item, name, trajectory, folder / name)
            for view in views:
                _write_view(run, item, record, trajectory, view, arguments, folder / name)
                advance(f"{name} {view}")
    if arguments.verbose:
        for name in names:
            print("\n".join(f"wrote {path}" for path in sorted((folder / name).iterdir())))
    of = names[0] if len(names) == 1 else f"{len(names)} sequences"
    return error_sentences({f"{item.data.name} {of}": summarise(curves)})[0]


def _write_view(
    run: LoadedRun,
    item: RunObject,
    record: SequenceRecord,
    trajectory: Trajectory,
    view: str,
    arguments: argparse.Namespace,
    folder: Path,
) -> None:
    from gausim.compose.predict import scene_of
    from gausim.io.video import write_gif, write_video
    from gausim.render.draw import film
    from gausim.report.pictures.figures import contact_sheet, slice_figure
    from gausim.report.pictures.frames import Timeline, brighten, video_frame

    background, scene = parse_background(arguments.background), scene_of(run, item)
    drawn = film(
        run.renderer, scene, trajectory, record.cameras_of([view]), background=background, mask=scene.foreground
    )
    prediction = brighten(drawn[:, 0].cpu().numpy(), arguments.brighten)
    truth = brighten(_truth(record, view, min(trajectory.frames, record.count), background), arguments.brighten)
    unseen, title = item.data.train_frames.stop, f"{item.data.name} {record.name} {view}"
    fps, timeline = item.data.fps / arguments.slow, Timeline(trajectory.frames, unseen)

    def compared() -> Iterator[np.ndarray]:
        for number, image in enumerate(prediction):
            yield video_frame(truth[number] if number < len(truth) else None, image, number, timeline, title)

    write_video(folder / f"{view}.mp4", compared(), fps)
    if arguments.gif:
        write_gif(folder / f"{view}.gif", compared(), fps)
    slice_figure(truth, prediction, folder / f"{view}_slices.png", title=title, first_unseen=unseen)
    contact_sheet(truth, prediction, folder / f"{view}_sheet.png", title=title, first_unseen=unseen)


def _truth(record: SequenceRecord, view: str, frames: int, background: Tensor | None) -> np.ndarray:
    import numpy as np

    from gausim.data.images import composite
    from gausim.render.draw import to_bytes

    # In chunks: as floats a whole sequence takes sixteen times its memory in bytes.
    pieces = [range(start, min(start + 16, frames)) for start in range(0, frames, 16)]
    parts = [to_bytes(composite(record.frames(piece, [view])[:, 0], background)[0]).numpy() for piece in pieces]
    return np.concatenate(parts)
