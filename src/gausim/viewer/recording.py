"""A trajectory as a `.viser` recording, or as one HTML page that plays it offline."""

from __future__ import annotations

import html
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from gausim.core import DataError, DivergenceError, GaussianScene, SteppedFrame, Trajectory
from gausim.io.files import write_durably
from gausim.viewer.coloring import BASE, VIEW, Painter
from gausim.viewer.guard import Door
from gausim.viewer.server import GuardedServer
from gausim.viewer.splats import SIZE, Placing, pack

# Buffers of all frames are held at once, and a page holds them in base64 [bytes].
_LARGEST = 1 << 30
_EYE = {"x": (0.3, 1.0, 0.4), "y": (0.4, 0.3, 1.0), "z": (0.4, -1.0, 0.3)}
# The page may load nothing from anywhere: all of it is in the file.
_POLICY = (
    "default-src 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' data: blob:; connect-src data: blob:; "
    "worker-src data: blob:; form-action 'none'; base-uri 'none'"
)


def record(
    scene: GaussianScene,
    trajectory: Trajectory,
    path: Path | str,
    *,
    kind: Literal["viser", "html"] = "html",
    every: int = 1,
    up: str = "z",
    colors: Literal["base", "view"] = "base",
    dark: bool = False,
) -> Path:
    """Writes a trajectory that plays in a browser, in its own time, and starts again at its end.

    Kept: positions (float32), covariances (float16, after the object was scaled to :data:`SIZE` units), colours and
    opacities (8 bit). Lost: view-dependent colours (one colour per kernel and frame), masks, masses, the hierarchy.

    Args:
        scene: the rest scene.
        trajectory: what is played.
        path: the file, which is replaced.
        kind: ``viser`` (for viser's own player) or ``html`` (opens from a disk, without a network).
        every: take every so many frames.
        up: vertical axis: x, y, z, -x, -y or -z.
        colors: ``base`` (the same from every side) or ``view`` (as the first camera sees them).
        dark: a dark page.

    Returns:
        The path.

    Raises:
        DataError: the trajectory is of another scene or too long, or ``every`` is not positive.
        DivergenceError: a frame is not finite.
        ConfigError: viser is of another version.
    """
    numbers = _frames(scene, trajectory, every)
    server = GuardedServer(Door(port=0), label=scene.name)
    try:
        data = _recorded(server, scene, trajectory, numbers, every / trajectory.fps, up, colors, kind, dark)
    finally:
        server.stop()
    if isinstance(data, str):
        data = _sealed(data, scene.name).encode()
    path = Path(path)
    write_durably(path, data)
    return path


def _frames(scene: GaussianScene, trajectory: Trajectory, every: int) -> range:
    if every < 1:
        raise DataError(f"every: expected at least 1, got {every}.")
    if trajectory.positions.shape[1] != scene.count:
        raise DataError(
            f"{scene.name}: has {scene.count} kernels, the trajectory {trajectory.positions.shape[1]}. Give the scene "
            "that it was made with."
        )
    numbers = range(0, trajectory.frames, every)
    size = len(numbers) * scene.count * 32
    if size > _LARGEST:
        raise DataError(
            f"{scene.name}: {len(numbers)} frames of {scene.count} kernels take {size / 2**30:.1f} GiB, expected "
            f"at most {_LARGEST >> 30}. Take every {-(-size * every // _LARGEST)}th frame, or export PLY files."
        )
    for values in (trajectory.positions, trajectory.deformation_gradients):
        bad = ~torch.isfinite(values).reshape(trajectory.frames, -1).all(-1)
        if bool(bad.any()):
            raise DivergenceError(f"{scene.name}: frame {int(bad.nonzero()[0])} is not finite; it cannot be shown.")
    return numbers


@torch.no_grad()
def _recorded(
    server: GuardedServer,
    scene: GaussianScene,
    trajectory: Trajectory,
    numbers: range,
    seconds: float,
    up: str,
    colors: str,
    kind: str,
    dark: bool,
) -> bytes | str:
    """The serialized recording: the first frame is the scene, every later one a new buffer after a pause."""
    placing, sign = Placing.of(scene), -1.0 if up.startswith("-") else 1.0
    axis = up.removeprefix("-")
    eye = np.array(_EYE[axis]) * 1.2 * SIZE * np.where(np.array(list("xyz")) == axis, sign, 1.0)
    painter = Painter(scene, (), torch.ones(scene.count))
    server.scene.set_up_direction(f"{'-' if sign < 0 else '+'}{axis}")  # type: ignore[arg-type]
    server.scene.world_axes.visible = False
    camera = server.initial_camera
    camera.position, camera.look_at, camera.up = eye, np.zeros(3), sign * (np.array(list("xyz")) == axis)
    still = torch.zeros(scene.count)

    def buffer(number: int) -> np.ndarray:
        frame = SteppedFrame(
            trajectory.positions[number].float(), trajectory.deformation_gradients[number].float(),
            trajectory.rotations[number].float(),
        )  # fmt: skip
        mode, seen_from = VIEW if colors == "view" else BASE, placing.to_scene(torch.tensor(eye, dtype=torch.float32))
        covars, rgb, _ = painter(frame, trajectory.unit_of_kernel, still, mode, seen_from)
        return pack(frame.positions, covars, rgb, painter.opacities, placing)

    first = np.zeros((scene.count, 3))
    node = server.scene.add_gaussian_splats(
        "/splats", centers=first, covariances=np.tile(np.eye(3), (scene.count, 1, 1)), rgbs=first,
        opacities=first[:, :1],
    )  # fmt: skip
    node.buffer = buffer(numbers[0])
    serializer = server.get_scene_serializer()
    for number in numbers[1:]:
        serializer.insert_sleep(seconds)
        node.buffer = buffer(number)
    serializer.insert_sleep(seconds)
    return serializer.as_html(dark_mode=dark) if kind == "html" else serializer.serialize()


def _sealed(page: str, name: str) -> str:
    """The page with its title, and a policy by which the browser refuses it any request."""
    policy = f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}" />'
    head = page.index("<head>") + len("<head>")
    start = page.index("<title>", head) + len("<title>")
    end = page.index("</title>", start)
    return page[:head] + policy + page[head:start] + html.escape(f"{name} - gausim") + page[end:]
