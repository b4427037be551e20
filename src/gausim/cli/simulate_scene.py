"""`gausim simulate --scene SCENE --from RUN`: a scene that was never filmed, moved by the network of a trained run."""

from __future__ import annotations

import argparse
from pathlib import Path

from gausim.cli.arguments import opened_scene, pinned_by
from gausim.cli.end import end
from gausim.cli.simulate_forces import told, write_film
from gausim.compose.config import compose, instantiate
from gausim.core.errors import ConfigError
from gausim.interaction.arrows import Arrow, arrows_of
from gausim.interaction.interaction import STANDARD_GRAVITY, Interaction, replay
from gausim.interaction.session import ForceSession, save_session
from gausim.interaction.words import entries_of, has_forces
from gausim.io.ply import load_scene
from gausim.io.trajectory import save_trajectory
from gausim.ops.orbit import orbit_cameras

# Frames without --frames, and the initial motion without forces [diagonals per frame of the farthest kernel].
FRAMES, SWAY = 120, 0.02
SIZE = (480, 480)


def simulate_scene(arguments: argparse.Namespace) -> int:
    """Simulates a scene without a run; writes trajectory, session, video and pictures; returns the exit status.

    Without forces the scene begins with a sway along x.

    Raises:
        ConfigError: an option is missing or wrong.
        SceneError: the scene is unusable, or nothing of it is pinned.
        DivergenceError: a simulated position is not finite.
    """
    if arguments.base is None:
        raise ConfigError("--scene: its motion needs a trained network, --from RUN (a run of model=gausim).")
    if arguments.session:
        raise ConfigError("--session replays what was done to a run's object. With --scene give --force and the like.")
    scene = pinned_by(load_scene(arguments.scene), arguments)
    interaction = opened_scene(
        scene, arguments, sway=0.0 if has_forces(arguments) else SWAY, gravity=STANDARD_GRAVITY * arguments.metre,
        most_force=arguments.most_force,
    )  # fmt: skip
    session, arrows = _session(interaction, arguments), list[list["Arrow"]]()
    trajectory = replay(interaction, session, watch=lambda live: arrows.append(arrows_of(live)))
    folder = arguments.out or Path(f"{arguments.scene.stem}_simulation")
    save_trajectory(
        folder / "trajectory.safetensors", trajectory, facts={"object": scene.name, "run": arguments.base.name}
    )
    save_session(session, folder / "session.json")
    cameras = orbit_cameras(
        scene.means[scene.foreground], azimuths=[arguments.azimuth], up=arguments.up, size=SIZE
    )  # fmt: skip
    renderer = instantiate(compose("render/auto").render)
    write_film(renderer, scene, trajectory, arrows, cameras, arguments, folder)
    end(told(interaction, trajectory), "videos", folder)
    return 0


def _session(interaction: Interaction, arguments: argparse.Namespace) -> ForceSession:
    steps = (arguments.frames or FRAMES) - 1
    entries = tuple(entries_of(arguments, interaction.scene))
    late = [entry.at for entry in entries if entry.at > steps]
    if late:
        raise ConfigError(f"at={late[0]}: expected 0 to {steps}, the last frame. Ask for more with --frames.")
    return ForceSession(interaction.made_with, interaction.fps, steps, entries, interaction.gravity)
