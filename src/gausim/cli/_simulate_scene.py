"""`gausim simulate --scene`: a scene without a run under an untrained network, to try whether it can be simulated."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from gausim.core import Cameras, Dynamics, GaussianScene, Renderer, SimState, Trajectory

AZIMUTHS = (0.0, 120.0, 240.0)


def simulate_scene(arguments: argparse.Namespace) -> int:
    """Simulates a bare scene and writes its trajectory, its last frame, pictures and a video.

    Args:
        arguments: of `gausim simulate` with --scene.

    Returns:
        The exit status.

    Raises:
        ConfigError: --random-weights is missing, or the model config is unusable.
        SceneError: the scene is unusable or nothing is pinned.
        DivergenceError: the simulation left the finite numbers.
    """
    import torch

    from gausim.cli._config import compose, instantiate
    from gausim.cli._end import OWN_OBJECT, end
    from gausim.cli.inspect import pinned_by
    from gausim.cli.simulate import parse_background
    from gausim.core.errors import ConfigError
    from gausim.io.ply import load_scene
    from gausim.ops.orbit import orbit_cameras
    from gausim.ops.selection import require_pinned

    if not arguments.random_weights:
        raise ConfigError("--scene has no trained network: add --random-weights, or simulate a RUN of that scene.")
    background = parse_background(arguments.background)
    scene = require_pinned(pinned_by(load_scene(arguments.scene), arguments.pin_below, arguments.pin_above))
    config, render = compose(f"model/{arguments.model}").model, compose("render/cpu").render
    torch.manual_seed(arguments.seed)
    build = instantiate(config.simulator)
    model = build(scenes=[scene], fps=[arguments.fps])
    trajectory, seconds = _timed_rollout(model.dynamics(0), initial_sway(scene, arguments.kick), arguments.steps)
    folder = Path(arguments.out) if arguments.out else Path(f"{arguments.scene.stem}_simulation")
    size = (arguments.size, arguments.size)
    cameras = orbit_cameras(scene.means[scene.foreground], azimuths=AZIMUTHS, up=arguments.up, size=size)
    _write(folder, scene, trajectory, instantiate(render), cameras, background)
    if arguments.verbose:
        print("\n".join(f"wrote {path}" for path in sorted(folder.iterdir())))
    end(_told(scene, trajectory, seconds), "video", folder / "video.mp4", OWN_OBJECT)
    return 0


def initial_sway(scene: GaussianScene, fraction: float) -> SimState:
    """The rest state, about to sway: every free kernel moves along x, farther from the roots faster.

    Args:
        scene: with at least one pinned kernel.
        fraction: displacement per frame of the kernel farthest from the roots [bounding-box diagonals].
    """
    import torch

    from gausim.core import SimState

    free = scene.simulated & ~scene.pinned
    root = scene.means[scene.pinned].mean(0)
    distance = torch.where(free, (scene.means - root).norm(dim=-1), torch.zeros(()))
    shift = torch.zeros_like(scene.means)
    shift[:, 0] = fraction * scene.diagonal * distance / distance.max().clamp_min(1e-12)
    return SimState(scene.means, scene.means - shift)


def _timed_rollout(dynamics: Dynamics, initial: SimState, steps: int) -> tuple[Trajectory, float]:
    start = time.perf_counter()
    trajectory = dynamics.rollout(initial, steps)
    return trajectory, time.perf_counter() - start


def _write(
    folder: Path,
    scene: GaussianScene,
    trajectory: Trajectory,
    renderer: Renderer,
    cameras: Cameras,
    background: Tensor | None,
) -> None:
    from gausim.io.ply import save_scene
    from gausim.io.trajectory import save_trajectory
    from gausim.io.video import write_video
    from gausim.ops.deformed_scene import deformed_scene
    from gausim.render.draw import film
    from gausim.report.figures import picture_grid

    folder.mkdir(parents=True, exist_ok=True)
    save_trajectory(folder / "trajectory.safetensors", trajectory, facts={"object": scene.name})
    last = trajectory.frames - 1
    state = trajectory.positions[last], trajectory.gradients[last], trajectory.rotations[last]
    save_scene(deformed_scene(scene, *state, trajectory.unit_of_kernel), folder / "last_frame.ply")

    def images(which: list[int], views: Cameras) -> np.ndarray:
        from dataclasses import replace

        part = replace(
            trajectory, positions=trajectory.positions[which], gradients=trajectory.gradients[which],
            rotations=trajectory.rotations[which],
        )  # fmt: skip
        return film(renderer, scene, part, views, background=background, mask=scene.foreground).cpu().numpy()

    ends = images([0, last], cameras)
    labels = [f"frame {f}, {name}" for f in (0, last) for name in cameras.names]
    picture_grid([*ends[0], *ends[1]], labels, folder / "pictures.png", title=scene.name, columns=len(AZIMUTHS))
    write_video(folder / "video.mp4", images(list(range(last + 1)), cameras.select([0]))[:, 0], trajectory.fps)


def _told(scene: GaussianScene, trajectory: Trajectory, seconds: float) -> list[str]:
    import torch

    from gausim.metrics import motion_energy

    moved = (trajectory.positions - scene.means).norm(dim=-1)
    held = ~scene.simulated | scene.pinned
    steps, units = trajectory.frames - 1, trajectory.gradients.shape[1]
    finite = all(bool(torch.isfinite(x).all()) for x in (trajectory.positions, trajectory.gradients))
    farthest, slipped = float(moved.max()) / scene.diagonal, float(moved[:, held].max())
    energy = motion_energy(trajectory.positions)
    kept = float(energy[-1] / energy[0].clamp_min(1e-30))
    return [
        f"{scene.name}: {scene.count} kernels, {int(held.sum())} of them held, in {units} units.",
        f"{steps} steps in {seconds:.1f} s ({1000 * seconds / steps:.0f} ms per step); all finite: {finite}.",
        f"Farthest from rest {farthest:.3f} diagonals, held kernels {slipped:g}; the last step has {kept:.3g} of the "
        "first one's energy.",
    ]
