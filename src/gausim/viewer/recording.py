"""Export of a trajectory as a `.viser` recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from gausim.core import DataError, GaussianScene, SteppedFrame, Trajectory
from gausim.io.files import write_durably
from gausim.io.motion import check_trajectory
from gausim.viewer.access import Access
from gausim.viewer.coloring import BASE, VIEW, Painter
from gausim.viewer.server import GuardedServer
from gausim.viewer.splats import SIZE, Placing, add_splats, pack

# Largest size of the buffers of all frames, which are in memory at once [bytes].
_LARGEST = 1 << 30
_EYE = {"x": (0.3, 1.0, 0.4), "y": (0.4, 0.3, 1.0), "z": (0.4, -1.0, 0.3)}


def record(
    scene: GaussianScene,
    trajectory: Trajectory,
    path: Path | str,
    *,
    every: int = 1,
    up: str = "z",
    colors: Literal["base", "view"] = "base",
) -> Path:
    """Writes a trajectory for viser's player, which plays it at its frame rate, in a loop; returns the path.

    Kept: positions (float32), covariances (float16, with the object scaled to :data:`SIZE` units), colours and
    opacities (8 bit). Lost: view-dependent colours (one colour per kernel and frame: ``base``, or the ``view`` of
    the initial camera), masks, masses, the hierarchy. Takes every ``every``-th frame.

    Raises:
        DataError: the trajectory is of another scene or too long, or ``every`` is not positive.
        DivergenceError: a frame is not finite.
        ConfigError: viser has another version than 1.1.1.
    """
    numbers = _frames(scene, trajectory, every)
    server = GuardedServer(Access(port=0), label=scene.name)
    try:
        serializer = _recorded(server, scene, trajectory, numbers, up, VIEW if colors == "view" else BASE)
        write_durably(Path(path), serializer.serialize())
    finally:
        server.stop()
    return Path(path)


def _frames(scene: GaussianScene, trajectory: Trajectory, every: int) -> range:
    if every < 1:
        raise DataError(f"every: expected at least 1, got {every}.")
    numbers = range(0, trajectory.frames, every)
    size = len(numbers) * scene.count * 32
    if size > _LARGEST:
        raise DataError(
            f"{scene.name}: {len(numbers)} frames of {scene.count} kernels take {size / 2**30:.1f} GiB, expected "
            f"at most {_LARGEST >> 30}. Take every {-(-size * every // _LARGEST)}th frame, or export PLY files."
        )
    check_trajectory(scene, trajectory)
    return numbers


@torch.no_grad()
def _recorded(
    server: GuardedServer, scene: GaussianScene, trajectory: Trajectory, numbers: range, up: str, mode: str
) -> Any:
    """Serialiser of the recording: the first frame is the scene, every later one a new buffer after a pause."""
    placing, sign = Placing.of(scene), -1.0 if up.startswith("-") else 1.0
    axis = up.removeprefix("-")
    vertical = np.array([name == axis for name in "xyz"])
    eye = np.array(_EYE[axis]) * 1.2 * SIZE * np.where(vertical, sign, 1.0)
    painter = Painter(scene, (), torch.ones(scene.count))
    server.scene.set_up_direction(f"{'-' if sign < 0 else '+'}{axis}")  # type: ignore[arg-type]
    server.scene.world_axes.visible = False
    camera = server.initial_camera
    camera.position, camera.look_at, camera.up = eye, np.zeros(3), sign * vertical
    still, seen_from = torch.zeros(scene.count), placing.to_scene(torch.tensor(eye, dtype=torch.float32))

    def buffer(number: int) -> np.ndarray:
        frame = SteppedFrame(
            trajectory.positions[number].float(), trajectory.deformation_gradients[number].float(),
            trajectory.rotations[number].float(),
        )  # fmt: skip
        covars, rgb, _ = painter(frame, trajectory.unit_of_kernel, still, mode, seen_from)
        return pack(frame.positions, covars, rgb, painter.opacities, placing)

    node = add_splats(server.scene, "/splats", buffer(numbers[0]))
    serializer, seconds = server.get_scene_serializer(), numbers.step / trajectory.fps
    for number in numbers[1:]:
        serializer.insert_sleep(seconds)
        node.buffer = buffer(number)
    serializer.insert_sleep(seconds)
    return serializer
