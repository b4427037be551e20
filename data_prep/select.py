"""Mark the kernels of a scene that are simulated, pinned and shown in the videos, and draws what was marked.

A selection is a text, read from left to right:
  --simulated "near moving.ply 0.01"            within 0.01 of a point of an npz, ply or txt
  --simulated "component 0.05 0,0,0.3"          what hangs together by steps of 0.05 around that point (or the largest)
  --pinned    "below z=0.33 and not box 0,0,0 1,1,0.2"
Terms: all; below AXIS=VALUE; above AXIS=VALUE; box X,Y,Z X,Y,Z; near FILE DISTANCE; component RADIUS [X,Y,Z];
mask NAME (as the scene has it now). They are joined by and, or, not, without precedence.

The result is OUT/scene.ply with OUT/scene.masks.npz beside it, where every command finds them, and OUT/masks.png, the
marked kernels from four sides.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from data_prep.common.command import headline, run_command, stage_parser
from data_prep.common.photos import write_picture
from data_prep.common.progress import Tick
from data_prep.common.stage import Stage, run_stage
from gausim.core.errors import ConfigError

if TYPE_CHECKING:
    from gausim.core import GaussianScene

# Raise when the same inputs and settings give another result than before.
REVISION = 1
MASKS = {
    "simulated": "let these kernels move",
    "pinned": "pin these simulated kernels",
    "foreground": "compare these kernels with segmented video",
}
AZIMUTHS = (0.0, 90.0, 180.0, 270.0)
# Selected kernels are drawn half in this colour (RGB), the others grey.
TINTS = {"simulated": (0.1, 0.8, 0.2), "pinned": (0.95, 0.15, 0.1), "foreground": (0.15, 0.4, 1.0)}
_GREY, _TINT, _PALE = 0.75, 0.6, 0.7


def select(
    scene: Path, out: Path, selections: Mapping[str, str], *, masks: Path | None = None, up: str = "z",
    size: int = 360, overwrite: bool = False,
) -> dict[str, Any]:  # fmt: skip
    """Runs the stage."""
    from data_prep.ready.selections import parse_selection
    from gausim.io.ply import masks_path

    unknown = sorted(set(selections) - set(MASKS))
    if unknown or not selections:
        raise ConfigError(f"selections of {unknown or 'no mask'}: expected some of {', '.join(MASKS)}.")
    parsed = {name: parse_selection(text) for name, text in selections.items()}
    side = masks or (masks_path(scene) if masks_path(scene).is_file() else None)
    inputs = {"scene": scene, **({"masks": side} if side else {})}
    inputs.update({f"points {file}": file for _, files in parsed.values() for file in files})
    settings = {"selections": dict(selections), "up": up, "size": size}
    stage = Stage("select", REVISION, inputs, settings, ("torch", "numpy", "scipy"))

    def make(work: Path) -> dict[str, Any]:
        from gausim.io.ply import load_scene, save_scene
        from gausim.ops.selection import apply_masks

        found = load_scene(scene, masks=side, name="scene")
        marked = apply_masks(found, **{name: chosen for name, (chosen, _) in parsed.items()})
        save_scene(marked, work / "scene.ply")
        draw_masks(work / "masks.png", marked, up=up, size=size)
        return _facts(marked)

    return run_stage(stage, out, make, overwrite=overwrite)


def _facts(scene: GaussianScene) -> dict[str, Any]:
    facts: dict[str, Any] = {"kernels": scene.count}
    for name in MASKS:
        inside = scene.means[getattr(scene, name)]
        box = [inside.amin(0).tolist(), inside.amax(0).tolist()] if len(inside) else None
        facts[name] = {"kernels": len(inside), "box": box}
    return facts


def draw_masks(path: Path, scene: GaussianScene, *, up: str = "z", size: int = 360) -> None:
    """Writes a picture: a row per mask, a column per side; marked kernels tinted, the others grey."""
    rows = []
    for name in MASKS:
        images = _sides(scene, name, up, size)
        label = np.full((24, size * len(AZIMUTHS), 3), 255, np.uint8)
        text = f"{name}: {int(getattr(scene, name).sum())} of {scene.count}"
        cv2.putText(label, text, (6, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
        rows += [label, np.concatenate(list(images), axis=1)]
    write_picture(path, np.concatenate(rows))


def _sides(scene: GaussianScene, name: str, up: str, size: int) -> np.ndarray:
    """(4, size, size, 3) uint8 RGB of the scene with one mask tinted."""
    import torch

    from gausim.ops.orbit import orbit_cameras
    from gausim.ops.spherical_harmonics import C0
    from gausim.render.cpu import CpuRenderer
    from gausim.render.draw import draw_still, to_bytes

    mask = getattr(scene, name)
    color = scene.sh[:, 0] * C0 + 0.5
    grey = color.mean(-1, keepdim=True).clamp(0, 1) * (1 - _PALE) + _GREY * _PALE
    tinted = color * (1 - _TINT) + torch.tensor(TINTS[name]) * _TINT
    color = torch.where(mask[:, None], tinted, grey.expand_as(color))
    flat = replace(scene, sh=((color - 0.5) / C0)[:, None])
    cameras = orbit_cameras(scene.means, azimuths=AZIMUTHS, up=up, size=(size, size))
    drawn = draw_still(CpuRenderer(), flat, cameras, background=torch.ones(3)).rgb[0]
    return np.asarray(to_bytes(drawn).numpy())


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = stage_parser("select", __doc__)
    parser.add_argument("scene", type=Path, metavar="SCENE", help="3DGS scene (PLY)")
    group = parser.add_argument_group("masks (those not given stay as they are)")
    for name, what in MASKS.items():
        group.add_argument(f"--{name}", metavar="SELECTION", help=what)
    group.add_argument(
        "--masks", type=Path, metavar="FILE", help="start from these masks (default: <stem>.masks.npz, if there)"
    )
    group = parser.add_argument_group("picture")
    group.add_argument("--up", choices=("x", "y", "z", "-x", "-y", "-z"), default="z",
        help="draw this axis upwards (write --up=-y; default %(default)s)")  # fmt: skip
    group.add_argument("--size", type=int, default=360, help="draw each view in this size [pixels] (%(default)s)")

    def run(given: argparse.Namespace, tick: Tick) -> str:
        selections = {name: getattr(given, name) for name in MASKS if getattr(given, name)}
        manifest = select(
            given.scene, given.out, selections, masks=given.masks, up=given.up, size=given.size,
            overwrite=given.overwrite,
        )  # fmt: skip
        results = manifest["results"]
        lines = [f"{name:<11} {results[name]['kernels']} of {results['kernels']} kernels" for name in MASKS]
        return "\n".join([headline(given.out, manifest), *lines, f"look at     {given.out / 'masks.png'}"])

    return run_command(parser, argv, run)
