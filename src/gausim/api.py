"""The Python interface: a learned object in a few lines.

sim = gausim.load("outputs/demo/seed_0")
sim.apply_force("tip", direction=(1, 0, 0), weights=3, frames=8)
sim.step(24)
image = sim.render("cam_0")  # (H, W, 3) uint8
sim.save_session("push.json")
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from gausim.compose.build import load_run
from gausim.compose.live import REST, open_interaction
from gausim.compose.predict import run_objects
from gausim.core import Cameras, Renderer, SteppedFrame, Trajectory
from gausim.interaction.interaction import Interaction, replay
from gausim.interaction.selections import Ball, Kernels, Unit, Whole
from gausim.interaction.session import Event, Force, Release, load_session, save_session
from gausim.interaction.words import parse_direction, parse_part
from gausim.ops.orbit import orbit_cameras
from gausim.render.draw import SceneAppearance, draw, to_bytes

if TYPE_CHECKING:
    import numpy as np


class Simulation:
    """A learned object that can be pushed, watched and drawn; made by :func:`load`.

    Attributes:
        interaction: what is behind it: its state, what acts on it, its session.
        cameras: those of the data set.
        renderer: what draws it.
    """

    def __init__(self, interaction: Interaction, cameras: Cameras, renderer: Renderer) -> None:
        self.interaction, self.cameras, self.renderer = interaction, cameras, renderer
        self._look: SceneAppearance | None = None

    @property
    def frame(self) -> SteppedFrame:
        """The latest frame: positions, gradients and rotations."""
        return self.interaction.frame

    @property
    def trajectory(self) -> Trajectory:
        """All frames since the session began, the initial one first."""
        return self.interaction.trajectory()

    def step(self, n: int = 1) -> SteppedFrame:
        """Makes ``n`` steps and returns the latest frame.

        Raises:
            DivergenceError: the simulation went wrong; :meth:`reset` begins again.
        """
        for _ in range(n):
            self.interaction.step()
        return self.frame

    def apply_force(
        self,
        on: str | Whole | Unit | Kernels | Ball = "whole",
        *,
        direction: str | tuple[float, float, float],
        weights: float,
        frames: int | None = None,
        name: str = "force",
    ) -> None:
        """Pushes from now on.

        Args:
            on: a part in words (``whole``, ``tip``, ``unit:1/7``, ``ball:X,Y,Z,R``, ``kernels:0-9``) or a selection.
            direction: ``x``, ``-z``, ... or a vector of any length.
            weights: size of the force [weights of the part].
            frames: how long; None: until :meth:`release`.
            name: a force of the same name takes the place of the last one.

        Raises:
            ConfigError: the part has nothing that can move, or the force is too large.
        """
        part = parse_part(on, self.interaction.scene) if isinstance(on, str) else on
        x, y, z = parse_direction(direction) if isinstance(direction, str) else direction
        self.act(Force(part, (float(x), float(y), float(z)), float(weights), frames, name))

    def release(self, name: str | None = None) -> None:
        """Ends the force of a name, or all of them."""
        self.act(Release(name))

    def act(self, event: Event) -> None:
        """Does any event of :mod:`gausim.interaction.session`: an impulse, wind, gravity, a pin.

        Raises:
            ConfigError: it cannot be done.
        """
        self.interaction.act(event)

    def reset(self) -> None:
        """Back to the initial state with nothing acting; the session goes on."""
        self.interaction.reset()

    def render(
        self, camera: str | float | Cameras | None = None, *, background: tuple[float, float, float] | None = None
    ) -> np.ndarray:
        """Draws the latest frame, (H, W, 3) uint8.

        Args:
            camera: name of a view of the data set, the azimuth of an orbit about z [degree], or a camera (the first
                of them is taken); the data set's first when None.
            background: RGB in 0..1; black when None.

        Raises:
            DataError: there is no view of this name.
        """
        views, frame = self._camera(camera), self.frame
        if self._look is None:
            self._look = SceneAppearance.of(self.interaction.scene, self.interaction.scene.foreground)
        color = None if background is None else torch.tensor(background, dtype=frame.positions.dtype)
        with torch.no_grad():
            drawn = draw(
                self.renderer, self._look, frame.positions[None], frame.deformation_gradients[None],
                frame.rotations[None], self.interaction.unit_of_kernel, views, background=color,
            )  # fmt: skip
        pixels: np.ndarray = to_bytes(drawn.rgb[0, 0]).cpu().numpy()
        return pixels

    def _camera(self, camera: str | float | Cameras | None) -> Cameras:
        if isinstance(camera, Cameras):
            return camera.select([0])
        if isinstance(camera, int | float):
            scene, size = self.interaction.scene, (self.cameras.width, self.cameras.height)
            return orbit_cameras(scene.means[scene.foreground], azimuths=[float(camera)], size=size)
        names = self.cameras.names
        if camera is not None and camera not in names:
            from gausim.core import DataError

            raise DataError(f"view '{camera}': expected one of {list(names)}, an azimuth [degree] or a camera.")
        return self.cameras.select([0 if camera is None else names.index(camera)])

    def save_session(self, path: Path | str) -> None:
        """Writes what was done so far, to be replayed with :meth:`replay` or `gausim simulate --session`."""
        save_session(self.interaction.session(), path)

    def replay(self, path: Path | str) -> Trajectory:
        """Begins anew and does what a session says; bit for bit what was recorded.

        Raises:
            DataError: the session is broken, or was made with something else.
        """
        return replay(self.interaction, load_session(path))


def load(
    run: Path | str,
    *,
    object: str | None = None,  # noqa: A002 - what the command line calls it
    sequence: str = REST,
    gravity: float | None = None,
    most_force: float | None = None,
    keep: int | None = None,
    data: Mapping[str, Any] | None = None,
) -> Simulation:
    """Loads an object of a trained run.

    Args:
        run: directory of the run.
        object: its name; the first one when None.
        sequence: whose beginning is the initial state, or ``rest``.
        gravity: acceleration that makes a weight of a mass [scene units / s^2]; 9.81 when None.
        most_force: the largest force [weights]; 10 when None.
        keep: so many of the latest frames are kept for the trajectory; None keeps all.
        data: keys of the run's data configuration to replace, e.g. ``{"root": "/elsewhere"}``.

    Raises:
        RunError: there is no run, or it holds another scene than it was trained on.
        DataError: there is no such object or sequence.
    """
    loaded = load_run(run, data=data)
    interaction = open_interaction(
        loaded, name=object, sequence=sequence, gravity=gravity, most_force=most_force, keep=keep
    )
    item = run_objects(loaded, None if object is None else [object])[0]
    return Simulation(interaction, item.data.sequences[0].cameras, loaded.renderer)
