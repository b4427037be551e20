"""`gausim simulate RUN --force ...` and `--session FILE`: an object that is pushed."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gausim.core.errors import ConfigError, DataError

if TYPE_CHECKING:
    import numpy as np

    from gausim.compose.build import LoadedRun
    from gausim.compose.predict import RunObject
    from gausim.core import Cameras, Trajectory
    from gausim.interaction.arrows import Arrow
    from gausim.interaction.interaction import Interaction
    from gausim.interaction.session import ForceSession


def simulate_forces(run: LoadedRun, arguments: argparse.Namespace) -> int:
    """Pushes one object of a run and writes its trajectory, session, videos and pictures.

    Args:
        run: the loaded run.
        arguments: of `gausim simulate` with forces or a session.

    Returns:
        The exit status.

    Raises:
        ConfigError: options that do not go together, or an event that cannot be done.
        DataError: a session that is broken or of another scene; an object, sequence or view that is not there.
        DivergenceError: the simulation left the finite numbers.
    """
    from gausim.cli.end import end
    from gausim.compose.predict import run_objects
    from gausim.interaction.arrows import arrows_of
    from gausim.interaction.interaction import replay

    session, interaction, item = _prepared(run, arguments)
    views = arguments.view or [*item.data.train_views[:1], *item.data.heldout_views[:1]]
    item.data.sequences[0].camera_indices(views)  # an unknown view ends it before the long work
    arrows: list[list[Arrow]] = []
    trajectory = replay(interaction, session, other_model=True, watch=lambda live: arrows.append(arrows_of(live)))
    base = Path(arguments.out) if arguments.out else Path(run.run_dir) / "simulation"
    label = Path(arguments.session).stem if arguments.session else "forces"
    folder = base / item.data.name / label
    _write(run, run_objects(run, [item.data.name])[0], session, trajectory, folder)
    for view in views:
        _write_view(run, item, trajectory, arrows, view, arguments, folder)
    if arguments.verbose:
        print("\n".join(f"wrote {path}" for path in sorted(folder.iterdir())))
    replayed = ["simulate", arguments.run, "--session", folder / "session.json"]
    end(_told(interaction, trajectory), "videos", folder, ["view", arguments.run], replayed)
    return 0


def _prepared(run: LoadedRun, arguments: argparse.Namespace) -> tuple[ForceSession, Interaction, RunObject]:
    """What to do, with what, and to which object."""
    from msgspec.structs import replace

    from gausim.compose.live import REST, open_interaction
    from gausim.compose.predict import run_objects
    from gausim.interaction.interaction import STANDARD_GRAVITY, differences
    from gausim.interaction.session import ForceSession, load_session
    from gausim.interaction.words import entries_of, has_forces

    if arguments.session and has_forces(arguments):
        raise ConfigError("--session has its own forces: leave --force and the like out, or edit the session's file.")
    found = load_session(arguments.session) if arguments.session else None
    if len(arguments.object or []) > 1 or len(arguments.sequence or []) > 1:
        raise ConfigError("forces act on one object from one initial state: name one --object and one --sequence.")
    names = [item.data.name for item in run_objects(run)]
    name = arguments.object[0] if arguments.object else None
    if name is None:
        name = found.made_with.scene if found and found.made_with.scene in names else names[0]
    item = run_objects(run, [name])[0]
    if not arguments.metre > 0:
        raise ConfigError(f"--metre {arguments.metre}: expected more than 0 scene units.")
    start = arguments.sequence[0] if arguments.sequence else (found.made_with.initial if found else REST)
    interaction = open_interaction(
        run, name=name, sequence=start, gravity=STANDARD_GRAVITY * arguments.metre, most_force=arguments.most_force
    )
    if found is None:
        steps = (arguments.frames or item.data.sequences[0].count) - 1
        entries = tuple(entries_of(arguments, interaction.scene))
        late = [entry.at for entry in entries if entry.at > steps]
        if late:
            raise ConfigError(f"at={late[0]}: expected 0 to {steps}, the last frame. Ask for more with --frames.")
        return (
            ForceSession(interaction.made_with, interaction.fps, steps, entries, interaction.gravity),
            interaction,
            item,
        )
    if arguments.frames:
        steps = arguments.frames - 1
        found = replace(found, steps=steps, entries=tuple(e for e in found.entries if e.at <= steps))
    for text, allowed in differences(interaction, found):
        if allowed:
            print(f"warning: {arguments.session}: {text}; its forces act, its numbers differ.", file=sys.stderr)
        else:
            raise DataError(f"{arguments.session}: {text}. Replay it with what it was made with.")
    return found, interaction, item


def _write(run: LoadedRun, item: RunObject, session: ForceSession, trajectory: Trajectory, folder: Path) -> None:
    from gausim.interaction.session import save_session
    from gausim.io.trajectory import save_trajectory

    facts = {"object": item.data.name, "sequence": session.made_with.initial, "run": Path(run.run_dir).name}
    save_trajectory(folder / "trajectory.safetensors", trajectory, facts=facts)
    save_session(session, folder / "session.json")


def _write_view(
    run: LoadedRun,
    item: RunObject,
    trajectory: Trajectory,
    arrows: Sequence[Sequence[Arrow]],
    view: str,
    arguments: argparse.Namespace,
    folder: Path,
) -> None:
    from gausim.cli.arguments import parse_background
    from gausim.compose.predict import scene_of
    from gausim.io.video import write_gif, write_video
    from gausim.render.draw import film
    from gausim.report.pictures.figures import picture_grid
    from gausim.report.pictures.frames import brighten

    scene, record = scene_of(run, item), item.data.sequences[0]
    cameras = _sharp(record.cameras_of([view]))
    drawn = film(
        run.renderer, scene, trajectory, cameras,
        background=parse_background(arguments.background), mask=scene.foreground,
    )  # fmt: skip
    images = brighten(drawn[:, 0].cpu().numpy(), arguments.brighten)
    fps = item.data.fps / arguments.slow
    title = f"{item.data.name} {view}"

    def pictures() -> Iterator[np.ndarray]:
        return _pictures(images, arrows, cameras, title)

    write_video(folder / f"{view}.mp4", pictures(), fps)
    if arguments.gif:
        write_gif(folder / f"{view}.gif", pictures(), fps)
    every = max(1, len(images) // 12)
    chosen = list(range(0, len(images), every))[:12]
    picture_grid(
        [images[f] for f in chosen], [f"frame {f}" for f in chosen], folder / f"{view}_sheet.png", title=title,
        columns=6,
    )  # fmt: skip


def _sharp(cameras: Cameras) -> Cameras:
    """The same views with as many pixels as a video's panel has, where the data set's have fewer."""
    from gausim.core import Cameras
    from gausim.report.pictures.frames import PANEL_HEIGHT

    zoom = max(1.0, PANEL_HEIGHT / cameras.height)
    Ks = cameras.Ks.clone()
    Ks[:, :2] *= zoom
    return Cameras(cameras.viewmats, Ks, round(cameras.width * zoom), round(cameras.height * zoom), cameras.names)


def _pictures(
    images: np.ndarray, arrows: Sequence[Sequence[Arrow]], cameras: Cameras, title: str
) -> Iterator[np.ndarray]:
    import numpy as np

    from gausim.interaction.arrows import draw_arrows
    from gausim.report.pictures.frames import label_bar

    for number, image in enumerate(images):
        shown = draw_arrows(image, arrows[number], cameras.viewmats[0], cameras.Ks[0])
        acting = ", ".join(dict.fromkeys(arrow.label for arrow in arrows[number]))
        text = f"{title}   {number}/{len(images) - 1}   {acting}"
        yield np.concatenate((shown, label_bar(text, shown.shape[1])))


def _told(interaction: Interaction, trajectory: Trajectory) -> list[str]:
    """How far it went, and what kept it from going further."""
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
