"""A motion in one HTML page that plays it: WebGL 2, no library, no network."""

from __future__ import annotations

import base64
import html
import json
import math
from importlib.resources import files
from pathlib import Path

import torch
from jaxtyping import Float
from jinja2 import Template
from torch import Tensor

from gausim.core import Cameras, GaussianScene, Trajectory
from gausim.io.files import write_durably
from gausim.io.motion import motion_glb


def save_player(
    path: Path | str,
    scene: GaussianScene,
    trajectory: Trajectory,
    camera: Cameras,
    *,
    up: str = "z",
    background: Float[Tensor, " 3"] | None = None,
) -> None:
    """Writes a page with time bar, speed, loop and orbit; in it is the file of :func:`gausim.io.motion.save_motion`.

    The page begins with place and field of view of the one ``camera``, looking at the point of its axis that is
    nearest to the scene's middle. The vertical axis ``up`` is x, y or z, with a minus sign where it points down. It
    is replaced atomically.

    Raises:
        DataError: the trajectory is of another scene, or goes beyond half floats.
        DivergenceError: a frame is not finite.
    """
    settings = {
        "camera": _first_view(scene, camera, up),
        "background": [0.0, 0.0, 0.0] if background is None else background.tolist(),
    }
    folder = files("gausim.io")
    template = Template(folder.joinpath("player.html").read_text(encoding="utf-8"), keep_trailing_newline=True)
    page = template.render(
        settings=json.dumps(settings),
        script=folder.joinpath("player.js").read_text(encoding="utf-8"),
        motion=base64.b64encode(motion_glb(scene, trajectory, up=up).to_bytes()).decode(),
        title=html.escape(f"{scene.name} - gausim"),
    )
    write_durably(Path(path), page.encode())


def _first_view(scene: GaussianScene, camera: Cameras, up: str) -> dict[str, object]:
    """Eye, target, vertical axis and field of view of the smaller side [radian]."""
    eye, forward = camera.centers[0].double(), camera.viewmats[0, 2, :3].double()
    middle = scene.means[scene.foreground].median(0).values.double()
    distance = float((middle - eye) @ forward)
    target = eye + forward * (distance if distance > 0 else scene.diagonal)
    vertical = torch.tensor([float(axis == up[-1]) for axis in "xyz"]) * (-1 if up.startswith("-") else 1)
    fov = 2 * math.atan(min(camera.width, camera.height) / (2 * float(camera.Ks[0, 1, 1])))
    return {"eye": eye.tolist(), "target": target.tolist(), "up": vertical.tolist(), "fov": fov}
