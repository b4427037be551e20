"""A motion in one HTML page that plays it: WebGL 2, no library, no network."""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

import torch
from jaxtyping import Float
from jinja2 import Environment, FunctionLoader
from torch import Tensor

from gausim.core import Cameras, DataError, GaussianScene, Trajectory
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
    content = motion_glb(scene, trajectory, up=up).to_bytes()
    settings = view_settings(scene, camera, up=up, background=background)
    page = rendered("player", ("player",), content, settings, title=f"{scene.name} - gausim")
    write_durably(Path(path), page.encode())


def rendered(name: str, scripts: Sequence[str], content: bytes, settings: dict[str, object], **texts: object) -> str:
    """A page of the Gaussians' painter: NAME.html in frame.html, with more scripts, and binary content as base64.

    All texts and numbers are data: ``settings`` are JSON in which no ``<`` is left, ``texts`` are escaped.

    Raises:
        DataError: a number of the settings is not finite.
    """
    folder = files("gausim.io")

    def read(file: str) -> str:
        return folder.joinpath(file).read_text(encoding="utf-8")

    try:
        known = json.dumps(settings, allow_nan=False).replace("<", "\\u003c")
    except ValueError as error:
        raise DataError(f"the page's settings: expected finite numbers ({error}). Train the run again.") from error
    pages = Environment(loader=FunctionLoader(read), keep_trailing_newline=True)  # noqa: S701, escaped below
    return pages.get_template(f"{name}.html").render(
        settings=known,
        shaders=read("splats.html"),
        script="\n".join(read(f"{part}.js") for part in ("splats", *scripts)),
        content=base64.b64encode(content).decode(),
        **{key: html.escape(str(text)) for key, text in texts.items()},
    )


def view_settings(
    scene: GaussianScene, camera: Cameras, *, up: str, background: Float[Tensor, " 3"] | None
) -> dict[str, object]:
    """Camera (eye, target, vertical axis and field of view of the smaller side [radian]), and background colour."""
    eye, forward = camera.centers[0].double(), camera.viewmats[0, 2, :3].double()
    middle = scene.means[scene.foreground].median(0).values.double()
    distance = float((middle - eye) @ forward)
    target = eye + forward * (distance if distance > 0 else scene.diagonal)
    vertical = torch.tensor([float(axis == up[-1]) for axis in "xyz"]) * (-1 if up.startswith("-") else 1)
    fov = 2 * math.atan(min(camera.width, camera.height) / (2 * float(camera.Ks[0, 1, 1])))
    view = {"eye": eye.tolist(), "target": target.tolist(), "up": vertical.tolist(), "fov": fov}
    return {"camera": view, "background": [0.0, 0.0, 0.0] if background is None else background.tolist()}
