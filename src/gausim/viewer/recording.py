"""Export of a trajectory as a `.viser` recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from gausim.core import DataError, Frame, GaussianScene, Trajectory
from gausim.io.files import write_durably
from gausim.io.motion import check_trajectory
from gausim.viewer.access import Access
from gausim.viewer.coloring import BASE, Painter
from gausim.viewer.server import GuardedServer
from gausim.viewer.splats import SIZE, Placing, add_splats, pack

# Largest size of the buffers of all frames, which are in memory at once [bytes].
_LARGEST = 1 << 30
# Direction of the initial view from the object, by the vertical axis.
_EYE = {"y": (0.4, 0.3, 1.0), "z": (0.4, -1.0, 0.3)}


def record(scene: GaussianScene, trajectory: Trajectory, path: Path, *, up: str = "z") -> None:
    """Writes a trajectory for viser's player, which plays it at its frame rate, in a loop.

    Kept: positions (float32), covariances (float16, with the object scaled to :data:`SIZE` units), colours and
    opacities (8 bit). Lost: view-dependent colours, masks, masses, the hierarchy.

    Raises:
        DataError: the trajectory is of another scene or too long.
        DivergenceError: a frame is not finite.
        ConfigError: viser has another version than 1.1.1.
    """
    size = trajectory.frames * scene.count * 32
    if size > _LARGEST:
        raise DataError(
            f"{scene.name}: {trajectory.frames} frames of {scene.count} kernels take {size / 2**30:.1f} GiB, expected "
            f"at most {_LARGEST >> 30}. Take fewer (--every {-(-size // _LARGEST)}), or export PLY files."
        )
    check_trajectory(scene, trajectory)
    server = GuardedServer(Access(port=0), label=scene.name)
    try:
        write_durably(path, _recorded(server, scene, trajectory, up).serialize())
    finally:
        server.stop()


@torch.no_grad()
def _recorded(server: GuardedServer, scene: GaussianScene, trajectory: Trajectory, up: str) -> Any:
    """Serialiser of the recording: the first frame is the scene, every later one a new buffer after a pause."""
    placing, painter = Placing.of(scene), Painter(scene, (), torch.ones(scene.count))
    server.scene.set_up_direction(f"+{up}")  # type: ignore[arg-type]
    server.scene.world_axes.visible = False
    camera = server.initial_camera
    camera.position, camera.look_at = 1.2 * SIZE * np.array(_EYE[up]), np.zeros(3)
    camera.up = np.array([float(axis == up) for axis in "xyz"])
    still, eye = torch.zeros(scene.count), torch.zeros(3)  # base colours depend on neither

    def buffer(number: int) -> np.ndarray:
        frame = Frame(
            trajectory.positions[number].float(), trajectory.deformation_gradients[number].float(),
            trajectory.rotations[number].float(),
        )  # fmt: skip
        covars, rgb, _ = painter(frame, trajectory.unit_of_kernel, still, BASE, eye)
        return pack(frame.positions, covars, rgb, painter.opacities, placing)

    node = add_splats(server.scene, "/splats", buffer(0))
    serializer, seconds = server.get_scene_serializer(), 1 / trajectory.fps
    for number in range(1, trajectory.frames):
        serializer.insert_sleep(seconds)
        node.buffer = buffer(number)
    serializer.insert_sleep(seconds)
    return serializer
