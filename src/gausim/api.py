"""The Python interface to learned objects.

sim = gausim.load("outputs/demo/seed_0")
sim.apply_force("tip", direction=(1, 0, 0), weights=3, frames=8)
sim.step(24)
image = sim.render("cam_0")  # (H, W, 3) uint8
sim.save_session("push.json")
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from gausim.compose.build import load_run
from gausim.compose.live import REST, open_interaction
from gausim.compose.predict import run_object
from gausim.core import Cameras, DataError, Frame, Renderer, Trajectory
from gausim.interaction.interaction import Interaction
from gausim.interaction.replay import replay
from gausim.interaction.selections import Ball, Kernels, Unit, Whole
from gausim.interaction.session import Event, Force, Release, load_session, save_session
from gausim.interaction.words import parse_direction, parse_part
from gausim.ops.orbit import orbit_cameras
from gausim.render.draw import SceneAppearance, draw, to_bytes

if TYPE_CHECKING:
    import numpy as np


class Simulation:
    """A learned object that can be pushed, simulated and rendered; made by :func:`load`.

    Attributes:
        interaction: state of the object, forces on it, and its session.
        cameras: cameras of the data set.
        renderer: renderer of the object.
    """

    def __init__(self, interaction: Interaction, cameras: Cameras, renderer: Renderer) -> None:
        self.interaction, self.cameras, self.renderer = interaction, cameras, renderer
        self._look: SceneAppearance | None = None

    @property
    def frame(self) -> Frame:
        """The latest frame: positions, deformation gradients and rotations."""
        return self.interaction.frame

    @property
    def trajectory(self) -> Trajectory:
        """All frames since the session began, the initial one first."""
        return self.interaction.trajectory()

    def step(self, n: int = 1) -> Frame:
        """Takes ``n`` steps and returns the latest frame.

        Raises:
            DivergenceError: a position is not finite; :meth:`reset` restarts the simulation.
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
        """Applies a force from now on.

        Args:
            on: a part in words (``whole``, ``tip``, ``unit:1/7``, ``ball:X,Y,Z,R``, ``kernels:0-9``) or a selection.
            direction: ``x``, ``-z``, ... or a vector of any length.
            weights: size of the force [weights of the part].
            frames: duration [frames]; None: until :meth:`release`.
            name: name of the force; it replaces an earlier force of the same name.

        Raises:
            ConfigError: the part has no free kernel, or the force is too large.
        """
        part = parse_part(on, self.interaction.scene) if isinstance(on, str) else on
        x, y, z = parse_direction(direction) if isinstance(direction, str) else direction
        self.act(Force(part, (float(x), float(y), float(z)), float(weights), frames, name))

    def release(self, name: str | None = None) -> None:
        """Ends the force of this name, or all forces."""
        self.act(Release(name))

    def act(self, event: Event) -> None:
        """Applies any event of :mod:`gausim.interaction.session`: an impulse, wind, gravity, a pin.

        Raises:
            ConfigError: the event is invalid for this object.
        """
        self.interaction.act(event)

    def reset(self) -> None:
        """Returns to the initial state without forces; the session continues."""
        self.interaction.reset()

    def render(
        self, camera: str | float | Cameras | None = None, *, background: tuple[float, float, float] | None = None
    ) -> "np.ndarray":
        """Renders the latest frame, (H, W, 3) uint8.

        Args:
            camera: name of a view of the data set, the azimuth of an orbit about z [degree], or cameras, of
                which the first is used; None: the first camera of the data set.
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
            raise DataError(f"view '{camera}': expected one of {list(names)}, an azimuth [degree] or a camera.")
        return self.cameras.select([0 if camera is None else names.index(camera)])

    def save_session(self, path: Path | str) -> None:
        """Writes the session so far, for :meth:`replay` or `gausim simulate --session`."""
        save_session(self.interaction.session(), path)

    def replay(self, path: Path | str) -> Trajectory:
        """Restarts and replays a recorded session; the result is equal bit for bit.

        Raises:
            DataError: the session is malformed, or was recorded with another run or scene.
        """
        return replay(self.interaction, load_session(path))


def load(
    run: Path | str,
    *,
    object: str | None = None,  # noqa: A002 - its name on the command line
    sequence: str = REST,
    gravity: float | None = None,
    most_force: float | None = None,
    keep: int | None = None,
    data: Mapping[str, Any] | None = None,
    device: str = "auto",
) -> Simulation:
    """Loads an object of a trained run.

    Args:
        run: directory of the run.
        object: name of the object; the first one when None.
        sequence: sequence that gives the initial state, or ``rest``.
        gravity: acceleration that defines the unit of weight [scene units / s^2]; 9.81 when None.
        most_force: the largest force [weights]; 10 when None.
        keep: number of latest frames kept for the trajectory; None keeps all.
        data: keys of the run's data configuration to replace, e.g. ``{"root": "/elsewhere"}``.
        device: ``auto`` (the GPU where there is one), ``cpu``, ``cuda`` or ``cuda:N``.

    Raises:
        ConfigError: there is no such device.
        RunError: there is no run, or its scene differs from the one it was trained on.
        DataError: the object or sequence does not exist.
    """
    loaded = load_run(run, data=data, device=device)
    interaction = open_interaction(
        loaded, name=object, sequence=sequence, gravity=gravity, most_force=most_force, keep=keep
    )
    return Simulation(interaction, run_object(loaded, object).data.sequences[0].cameras, loaded.renderer)
