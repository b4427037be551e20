"""A trained template in one HTML page that simulates it: WebGL 2, no library, no network."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

from gausim.core import Cameras, GaussianScene
from gausim.io.files import write_durably
from gausim.io.player import packed, rendered, splat_arrays, view_settings


@dataclass(frozen=True)
class Start:
    """The learned initial state of a recorded sequence."""

    name: str
    before: list[float]  # modal coordinates at t = -1; those at t = 0 are zero
    frames: int  # number of recorded frames
    seen: int  # number of frames in training


@dataclass(frozen=True, eq=False)
class ElasticPage:
    """An object with N units and M modes; modes and directions are in the scene's axes."""

    scene: GaussianScene
    centres: Float[Tensor, "N 3"]  # centres of mass of the units at rest [scene units]
    unit_of_kernel: Int[Tensor, " K"]  # N for kernels that never move
    modes: Float[Tensor, "N 3 M"]
    gradients: Float[Tensor, "N 3 3 M"]  # displacement gradients of the modes [1 / scene units]
    weights: Float[Tensor, " N"]  # z = sum_n weight_n Phi_n^T u_n
    wind: Float[Tensor, "3 M"]  # change of z by an acceleration of the wind along each axis
    step: Mapping[str, np.ndarray]  # :func:`gausim.models.template.reduced.reduced_step`
    numbers: Mapping[str, float]  # of the step
    starts: Sequence[Start]
    fps: float  # frames per second
    gravity: float  # unit of weight [scene units / s^2]
    ceiling: float  # highest energy that forces may reach
    conserve_volume: bool  # whether the units' deformation gradients are scaled to determinant 1
    about: Sequence[tuple[str, str]]  # what the page was made from: heading and text


def save_page(
    path: Path | str,
    page: ElasticPage,
    camera: Cameras,
    *,
    up: str = "z",
    background: Float[Tensor, " 3"] | None = None,
) -> dict[str, int]:
    """Writes the page; replaces the file atomically.

    ``camera``, ``up`` and ``background`` are those of :func:`gausim.io.player.save_player`.

    Returns:
        Bytes of the file by part: ``splats``, ``modes``, ``step`` and ``code``.

    Raises:
        DataError: a number is not finite.
    """
    splats, scales = splat_arrays(page.scene)
    splats["unit_of_kernel"] = page.unit_of_kernel.cpu().numpy()
    content, index, sizes = packed({"splats": splats, "modes": _modes(page), "step": page.step})
    scene = page.scene
    settings = {
        **view_settings(scene, camera, up=up, background=background),
        "arrays": index, "sh_scales": scales, "units": len(page.centres), "modes": page.modes.shape[-1],
        "name": scene.name, "diagonal": scene.diagonal, "fps": page.fps, "gravity": page.gravity,
        "ceiling": page.ceiling, "conserve_volume": page.conserve_volume, "about": list(page.about),
        "starts": [vars(start) for start in page.starts], **page.numbers,
    }  # fmt: skip
    scripts = ("algebra", "laws", "body", "page")
    text = rendered("page", scripts, content, settings, title=f"{scene.name} - gausim").encode()
    write_durably(Path(path), text)
    return {**sizes, "code": len(text) - sum(sizes.values())}


def _modes(page: ElasticPage) -> dict[str, np.ndarray]:
    values = {
        "centres": page.centres, "weights": page.weights, "modes": page.modes,
        "gradients": page.scene.diagonal * page.gradients, "wind": page.wind,
    }  # fmt: skip
    return {name: value.detach().cpu().numpy() for name, value in values.items()}
