"""A motion in one HTML page that plays it: WebGL 2, no library, no network."""

import base64
import html
import json
import math
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from jinja2 import Environment, FunctionLoader
from torch import Tensor

from gausim.core import Cameras, DataError, GaussianScene, Trajectory
from gausim.io.files import write_durably
from gausim.io.motion import motion_arrays

# Arrays that are stored as half floats: none of them drives a simulated motion.
HALF = ("quats", "opacities", "base", "gradients", "moved")
# Levels of the stored spherical harmonics above degree 0, each way.
_LEVELS = 127


def save_player(
    path: Path | str,
    scene: GaussianScene,
    trajectory: Trajectory,
    camera: Cameras,
    *,
    up: str = "z",
    background: Float[Tensor, " 3"] | None = None,
) -> None:
    """Writes a page with time bar, speed, loop and orbit.

    The page begins with place and field of view of the one ``camera``, looking at the point of its axis that is
    nearest to the scene's middle. The vertical axis ``up`` is x, y or z, with a minus sign where it points down. It
    is replaced atomically.

    Raises:
        DataError: the trajectory is of another scene, or goes beyond half floats.
        DivergenceError: a frame is not finite.
    """
    motion, facts = motion_arrays(scene, trajectory)
    splats, scales = splat_arrays(scene)
    content, index, _ = packed({"splats": splats, "motion": motion})
    settings = view_settings(scene, camera, up=up, background=background) | facts
    settings |= {"arrays": index, "sh_scales": scales}
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


def splat_arrays(scene: GaussianScene) -> tuple[dict[str, np.ndarray], list[float]]:
    """Arrays of a rest scene, and the value of one step of each coefficient above degree 0, which are bytes."""
    high = scene.sh[:, 1:].detach().cpu().float()
    scales = high.abs().amax((0, 2)) / _LEVELS
    levels = (high / scales.clamp_min(1e-30)[:, None]).round().to(torch.int8)
    values = {
        "rest": scene.means, "quats": torch.nn.functional.normalize(scene.quats, dim=-1).roll(-1, -1),  # xyzw
        "scales": scene.log_scales.exp(), "opacities": scene.opacity_logits.sigmoid(), "base": scene.sh[:, 0],
        "sh": levels,
    }  # fmt: skip
    return {name: value.detach().cpu().numpy() for name, value in values.items()}, scales.tolist()


def packed(parts: Mapping[str, Mapping[str, np.ndarray]]) -> tuple[bytes, dict[str, list[object]], dict[str, int]]:
    """Arrays of several parts as binary content, its index (type, first byte and count by name), and bytes by part.

    Raises:
        DataError: a number is not finite, or beyond half floats.
    """
    content, index, sizes = bytearray(), dict[str, list[object]](), dict[str, int]()
    for part, arrays in parts.items():
        begin = len(content)
        for name, array in arrays.items():
            data, kind = _packed(name, array)
            index[name] = [kind, len(content), array.size]
            content += data
        sizes[part] = (len(content) - begin) * 4 // 3
    return bytes(content), index, sizes


def _packed(name: str, array: np.ndarray) -> tuple[bytes, str]:
    """Bytes of an array, padded to a multiple of 12, and its type.

    Raises:
        DataError: a number is not finite, or beyond half floats.
    """
    if array.dtype.kind == "f":
        array, kind = (array.astype("<f2"), "f2") if name in HALF else (array.astype("<f4"), "f4")
        if not np.isfinite(array).all():
            raise DataError(f"the page's '{name}': expected finite numbers, as half floats below 65504. Train again.")
    elif array.dtype.itemsize > 2:
        array, kind = array.astype("<u4"), "u4"
    else:
        kind = f"i{array.dtype.itemsize}"
    data = np.ascontiguousarray(array).tobytes()
    return data + bytes(-len(data) % 12), kind
