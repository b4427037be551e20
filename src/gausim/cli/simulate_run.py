"""What `gausim simulate` does: predictions beside the truth, and objects under forces."""

import argparse
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from msgspec.structs import replace
from PIL import Image
from torch import Tensor

from gausim.cli.arguments import parse_background
from gausim.cli.output import end, named_bar, push
from gausim.compose.build import LoadedRun, load_run
from gausim.compose.data_paths import data_option
from gausim.compose.live import REST, open_interaction
from gausim.compose.predict import RunObject, run_object, run_objects, state_of
from gausim.core import Cameras, GaussianScene, Renderer, Trajectory
from gausim.core.errors import ConfigError, DataError
from gausim.data.images import composite
from gausim.data.records import SequenceRecord
from gausim.evaluation.evaluation import evaluate_object, results_of
from gausim.interaction.arrows import Arrow, arrows_of, draw_arrows
from gausim.interaction.interaction import STANDARD_GRAVITY, Interaction
from gausim.interaction.replay import replay
from gausim.interaction.session import ForceSession, load_session, save_session
from gausim.interaction.words import entries_of, has_forces
from gausim.io.trajectory import save_trajectory
from gausim.io.video import write_gif, write_video
from gausim.pictures.figures import error_figure, picture_grid
from gausim.pictures.frames import PANEL_HEIGHT, brighten, comparison, contact_sheet, label_bar
from gausim.render.draw import film, to_bytes
from gausim.report.verdict import first_sentences


def simulate_run(arguments: argparse.Namespace) -> int:
    """Simulates objects of a run, under forces if there are any; returns the exit status."""
    run = load_run(arguments.run, data=data_option(arguments.data), device=arguments.device)
    state_of(run)
    folder = arguments.out or run.run_dir / "simulation"
    if arguments.session or has_forces(arguments):
        return _simulate_forces(run, arguments, folder)
    items = run_objects(run, arguments.objects)
    sentences = [_simulate_object(item, arguments, folder / item.data.name) for item in items]
    first = items[0].data.name
    push_it = push(arguments.run, first if len(run.objects) > 1 else None)
    end(sentences, "videos", folder if len(items) > 1 else folder / first, ["view", arguments.run], push_it)
    return 0


def _simulate_object(item: RunObject, arguments: argparse.Namespace, folder: Path) -> str:
    """Writes all results on an object's sequences; returns a sentence on their errors."""
    names = arguments.sequences or [item.data.sequences[0].name]
    names = [record.name for record in item.data.sequences] if names == ["all"] else names
    views = arguments.cameras or [*item.data.train_views[:1], *item.data.heldout_views[:1]]
    for name in names:
        item.sequence(name).camera_indices(views)  # raises on an unknown sequence or view before the simulation
    run, item.least_frames = item.run, arguments.frames or 0
    with named_bar(len(names) * (1 + len(views)), f"simulate {item.data.name}") as advance:
        curves = evaluate_object(
            item.data, item.scene, {run.module.method_name: item}, run.renderer, sequences=names,
            advance=advance,
        )  # fmt: skip
        for name in names:
            record = item.data.record(name)
            trajectory = item(record, arguments.frames)
            error_figure(curves, folder / name / "errors.png", sequence=name)
            _write_trajectory(item, name, trajectory, folder / name)
            for view in views:
                _write_view(item, record, trajectory, view, arguments, folder / name)
                advance(f"{name} {view}")
    for name in names:
        _list(folder / name, arguments)
    of = names[0] if len(names) == 1 else f"{len(names)} sequences"
    sentence = first_sentences(results_of([curves], {}))[0]
    return f"{item.data.name} {of}{sentence.removeprefix(item.data.name)}"


def _write_view(
    item: RunObject,
    record: SequenceRecord,
    trajectory: Trajectory,
    view: str,
    arguments: argparse.Namespace,
    folder: Path,
) -> None:
    background, scene = parse_background(arguments.background), item.scene
    drawn = film(
        item.run.renderer, scene, trajectory, record.cameras_of([view]), background=background, mask=scene.foreground
    )
    prediction = brighten(drawn[:, 0].cpu().numpy(), arguments.brighten)
    truth = brighten(_truth(record, view, min(trajectory.frames, record.count), background), arguments.brighten)
    unseen, title = item.data.train_frames.stop, f"{item.data.name} {record.name} {view}"
    compared = partial(comparison, truth, prediction, title, unseen)
    _write_videos(folder / view, compared, item.data.fps / arguments.slow, arguments)
    Image.fromarray(contact_sheet(truth, prediction, unseen)).save(folder / f"{view}_sheet.png")


def _truth(record: SequenceRecord, view: str, frames: int, background: Tensor | None) -> np.ndarray:
    # In chunks: as floats a whole sequence takes sixteen times its memory in bytes.
    pieces = [range(start, min(start + 16, frames)) for start in range(0, frames, 16)]
    parts = [to_bytes(composite(record.frames(piece, [view])[:, 0], background)[0]).numpy() for piece in pieces]
    return np.concatenate(parts)


def _simulate_forces(run: LoadedRun, arguments: argparse.Namespace, out: Path) -> int:
    """Simulates one object under forces; writes trajectory, session, videos and pictures; returns the exit status."""
    if arguments.session and has_forces(arguments):
        raise ConfigError("--session has its own forces: leave --force and the like out, or edit the session's file.")
    if len(arguments.objects or []) > 1 or len(arguments.sequences or []) > 1:
        raise ConfigError("forces act on one object from one state: name one of --objects and one of --sequences.")
    if not arguments.metre > 0:
        raise ConfigError(f"--metre {arguments.metre}: expected more than 0 scene units.")
    found = load_session(arguments.session) if arguments.session else None
    item, interaction = _opened(run, arguments, found)
    frames = arguments.frames or item.data.sequences[0].count
    session = _known(interaction, found, arguments) if found else _new_session(interaction, arguments, frames)
    views = arguments.cameras or [*item.data.train_views[:1], *item.data.heldout_views[:1]]
    item.data.sequences[0].camera_indices(views)  # raises on an unknown view before the simulation
    arrows: list[list[Arrow]] = []
    trajectory = replay(interaction, session, other_model=True, watch=lambda live: arrows.append(arrows_of(live)))
    folder = out / item.data.name / (Path(arguments.session).stem if arguments.session else "forces")
    _write_trajectory(item, session.made_with.initial, trajectory, folder)
    save_session(session, folder / "session.json")
    for view in views:
        cameras = _sharp(item.data.sequences[0].cameras_of([view]))
        _write_film(run.renderer, interaction.scene, trajectory, arrows, cameras, arguments, folder)
    _list(folder, arguments)
    replayed = ["simulate", arguments.run, "--session", folder / "session.json"]
    end(_sentences(interaction, trajectory), "videos", folder, ["view", arguments.run], replayed)
    return 0


def _list(folder: Path, arguments: argparse.Namespace) -> None:
    """Prints what was written, where ``--verbose`` asks for it."""
    if arguments.verbose:
        print("\n".join(f"wrote {path}" for path in sorted(folder.iterdir())))


def _opened(run: LoadedRun, arguments: argparse.Namespace, found: ForceSession | None) -> tuple[RunObject, Interaction]:
    """The named object and its interaction; by default the object of the session, or the first."""
    names = arguments.objects
    if names is None and found and found.made_with.scene in [item.data.name for item in run_objects(run)]:
        names = [found.made_with.scene]
    item = run_object(run, names[0] if names else None)
    start = arguments.sequences[0] if arguments.sequences else (found.made_with.initial if found else REST)
    return item, open_interaction(
        run, name=item.data.name, sequence=start, gravity=STANDARD_GRAVITY * arguments.metre,
        most_force=arguments.most_force,
    )  # fmt: skip


def _new_session(interaction: Interaction, arguments: argparse.Namespace, frames: int) -> ForceSession:
    steps = frames - 1
    entries = tuple(entries_of(arguments, interaction.scene))
    late = [entry.at for entry in entries if entry.at > steps]
    if late:
        raise ConfigError(f"at={late[0]}: expected 0 to {steps}, the last frame. Ask for more with --frames.")
    return ForceSession(interaction.made_with, interaction.fps, steps, entries, interaction.gravity)


def _known(interaction: Interaction, found: ForceSession, arguments: argparse.Namespace) -> ForceSession:
    """The session to replay, cut to the requested number of frames."""
    for text, allowed in found.differences(interaction.made_with, interaction.fps):
        if not allowed:
            raise DataError(f"{arguments.session}: {text}. Replay it with what it was made with.")
        print(f"warning: {arguments.session}: {text}; its forces act, its numbers differ.", file=sys.stderr)
    if not arguments.frames:
        return found
    steps = arguments.frames - 1
    return replace(found, steps=steps, entries=tuple(e for e in found.entries if e.at <= steps))


def _write_trajectory(item: RunObject, sequence: str, trajectory: Trajectory, folder: Path) -> None:
    facts = {"object": item.data.name, "sequence": sequence, "run": item.run.run_dir.name}
    save_trajectory(folder / "trajectory.safetensors", trajectory, facts=facts)


def _write_film(
    renderer: Renderer,
    scene: GaussianScene,
    trajectory: Trajectory,
    arrows: list[list[Arrow]],
    cameras: Cameras,
    arguments: argparse.Namespace,
    folder: Path,
) -> None:
    """Writes the video and the contact sheet of a motion and its forces in one view, named after the camera."""
    (view,), background = cameras.names, parse_background(arguments.background)
    drawn = film(renderer, scene, trajectory, cameras, background=background, mask=scene.foreground)
    images = brighten(drawn[:, 0].cpu().numpy(), arguments.brighten)
    fps, title = trajectory.fps / arguments.slow, f"{scene.name} {view}"

    def pictures() -> Iterator[np.ndarray]:
        for number, image in enumerate(images):
            shown = draw_arrows(image, arrows[number], cameras.viewmats[0], cameras.Ks[0])
            acting = ", ".join(dict.fromkeys(arrow.label for arrow in arrows[number]))
            text = f"{title}   {number}/{len(images) - 1}   {acting}"
            yield np.concatenate((shown, label_bar(text, shown.shape[1])))

    _write_videos(folder / view, pictures, fps, arguments)
    chosen = list(range(0, len(images), max(1, len(images) // 12)))[:12]
    picture_grid(
        [images[f] for f in chosen], [f"frame {f}" for f in chosen], folder / f"{view}_sheet.png", title=title,
        columns=6,
    )  # fmt: skip


def _write_videos(
    stem: Path, frames: Callable[[], Iterator[np.ndarray]], fps: float, arguments: argparse.Namespace
) -> None:
    write_video(stem.with_name(f"{stem.name}.mp4"), frames(), fps)
    if arguments.gif:
        write_gif(stem.with_name(f"{stem.name}.gif"), frames(), fps)


def _sharp(cameras: Cameras) -> Cameras:
    """The same views, enlarged to the size of a video panel if they are smaller."""
    zoom = max(1.0, PANEL_HEIGHT / cameras.height)
    Ks = cameras.Ks.clone()
    Ks[:, :2] *= zoom
    return Cameras(cameras.viewmats, Ks, round(cameras.width * zoom), round(cameras.height * zoom), cameras.names)


def _sentences(interaction: Interaction, trajectory: Trajectory) -> list[str]:
    """Sentences on the largest displacement and on limits that applied."""
    scene = interaction.scene
    away = (trajectory.positions - scene.means.to(trajectory.positions)).norm(dim=-1) / scene.diagonal
    held = ~scene.simulated | scene.pinned
    slipped = float(away[:, held].max()) if bool(held.any()) else 0.0
    sentences = [
        f"{scene.name}: {trajectory.frames} frames; it is farthest from rest at frame {int(away.amax(1).argmax())}, by "
        f"{float(away.max()):.3f} of its diagonal; what is pinned moved by {slipped:g}."
    ]
    if interaction.limited:
        sentences.append(
            f"In {interaction.limited} frames forces acted only in part: they would carry {scene.name} beyond what was "
            "learned."
        )
    return sentences
