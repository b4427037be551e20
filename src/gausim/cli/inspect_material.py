"""`gausim inspect RUN --property`: the material that a run has learned, as colours of the Gaussians."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch

from gausim.compose.build import LoadedRun, load_run
from gausim.compose.data_paths import data_option
from gausim.compose.predict import run_object, state_of
from gausim.core import GaussianScene
from gausim.core.errors import ConfigError
from gausim.io.ply import save_scene
from gausim.models.step.scene_model import SceneModel
from gausim.models.template.template import Property
from gausim.ops.orbit import orbit_cameras
from gausim.ops.spherical_harmonics import C0
from gausim.pictures.kernels import draw_property, property_colors, property_scale
from gausim.render.draw import draw_still

PIXELS = 480


def show_material(arguments: argparse.Namespace) -> int:
    """Writes picture and PLY of a property, and prints its range; returns the exit status."""
    run, name = load_run(arguments.scene, data=data_option(arguments.data)), arguments.property
    state_of(run)
    item = run_object(run, arguments.objects)
    scene, found = item.scene.to("cpu"), _learned(run, item.scene_id, name, arguments.scene)
    known = torch.isfinite(found.values)
    scale = property_scale(found.values)
    colors = property_colors(found.values, scale)
    # One colour from every side, so that the colour bar holds from every side.
    colored = replace(scene, sh=((colors - 0.5) / C0)[:, None])
    images = _images(run, colored, arguments.azimuths, arguments.up or "z")
    out = arguments.out or Path(f"{item.data.name}.{name}.png")
    draw_property(out, images.numpy(), scale, title=f"{item.data.name}: {name}", text=found.text)
    ply = out.with_suffix(".ply")
    save_scene(colored, ply, more={name: torch.where(known, found.values, 0.0)})
    low, middle, high = torch.quantile(found.values[known].double(), torch.tensor([0.0, 0.5, 1.0]).double()).tolist()
    print(f"{name:<10} {found.text}\nkernels    {int(known.sum())} of {scene.count} move; the others are grey")
    print(f"range      {low:.4g} .. {high:.4g}, median {middle:.4g}\npicture    {out}\nPLY        {ply}")
    return 0


def _learned(run: LoadedRun, scene_id: int, name: str, path: Path) -> Property:
    model = run.module.model
    known = model.material(scene_id) if isinstance(model, SceneModel) else {}
    if name not in known:
        what = ", ".join(known) or "no property of a material"
        raise ConfigError(
            f"--property {name}: {path} ({run.module.method_name}) has learned {what}. Take one of these, or a run of "
            "model=gausim or model=gausim_elastic, which learn stiffness, density and damping."
        )
    return known[name]


def _images(run: LoadedRun, scene: GaussianScene, azimuths: list[float], up: str) -> torch.Tensor:
    """The scene from these sides on white, (V, H, W, 3) in [0, 1]."""
    cameras = orbit_cameras(scene.means[scene.foreground], azimuths=azimuths, up=up, size=(PIXELS, PIXELS))
    made = draw_still(run.renderer, scene, cameras, background=torch.ones(3), mask=scene.foreground)
    return made.rgb[0].clamp(0, 1).cpu()
