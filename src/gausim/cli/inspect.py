"""`gausim inspect`: statistics of a scene and of its hierarchy."""

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from gausim.cli.arguments import UPS, add_pin_option, command_parser, pinned_by
from gausim.core.errors import SceneError

if TYPE_CHECKING:
    from gausim.core.scene import GaussianScene
    from gausim.models.hierarchy.clusters import Hierarchy

# The hierarchy of conf/model/gausim.yaml; composing it here would be slow.
DEFAULT_RADII = (0.125, 0.55)


def main(argv: list[str]) -> int:
    """Runs the command; returns the exit status."""
    arguments = _parser().parse_args(argv)
    from gausim.io.ply import load_scene, masks_path, save_masks
    from gausim.models.hierarchy.clusters import build_hierarchy

    if any(not 0 < r <= 1 for r in arguments.radii):
        raise SceneError(f"--radii {arguments.radii}: expected fractions of the diagonal in (0, 1], fine to coarse.")
    scene = _marked(load_scene(arguments.scene, masks=arguments.masks), arguments)
    _print_scene(scene)
    if arguments.clean:
        from gausim.core.outliers import without_outliers
        from gausim.io.ply import save_scene

        clean = without_outliers(scene)
        save_scene(clean, arguments.clean)
        print(f"clean      {arguments.clean}: {clean.count} of {scene.count} kernels, with their masks")
        return 0
    hierarchy = build_hierarchy(scene, radii=arguments.radii)
    _print_hierarchy(hierarchy, arguments.radii)
    out = arguments.out or Path(f"{arguments.scene.stem}.clusters.png")
    _draw(scene, hierarchy, arguments, out)
    print(f"picture    {out}")
    if arguments.save_masks:
        side = arguments.masks or masks_path(arguments.scene)
        save_masks(scene, side)
        print(f"masks      {side}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("inspect")
    add = parser.add_argument
    add("scene", metavar="SCENE", type=Path, help="3DGS scene (PLY)")
    add("--masks", metavar="FILE", type=Path, help="read these masks (npz; default: <stem>.masks.npz, if there)")
    add_pin_option(parser)
    add("--simulate", action="append", default=[], metavar="SIDE", help="simulate only kernels on this side, e.g. "
        "\"above z=0.1\" [scene units]; draw the others without moving them (default: as stored)")  # fmt: skip
    add("--save-masks", action="store_true", help="store the masks so that every command uses them")
    add("--clean", metavar="OUT.ply", type=Path, help="write the scene without kernels larger than the body or far "
        "outside of it, and nothing else")  # fmt: skip
    add("--radii", type=float, nargs="+", default=list(DEFAULT_RADII), metavar="R",
        help="bound the clusters' diameters per level, fine to coarse [diagonals of the simulated kernels' bounding "
        "box] (default: {:g} {:g}, as of model=gausim)".format(*DEFAULT_RADII))  # fmt: skip
    add("--up", choices=UPS,
        help="draw this axis upwards (write --up=-y; default: away from the pins, else z)")  # fmt: skip
    add("--out", metavar="PICTURE.png", type=Path,
        help="write this picture (default: <stem>.clusters.png)")  # fmt: skip
    return parser


def _marked(scene: "GaussianScene", arguments: argparse.Namespace) -> "GaussianScene":
    from gausim.ops.selection import apply_masks, parse_half_space

    for side in arguments.simulate:
        scene = apply_masks(scene, simulated=scene.simulated & parse_half_space(side)(scene))
    return pinned_by(scene, arguments.pin)


def _print_scene(scene: "GaussianScene") -> None:
    low, high = scene.means.amin(0).tolist(), scene.means.amax(0).tolist()
    print(f"scene      {scene.name}\nkernels    {scene.count}\nSH degree  {scene.sh_degree}")
    print("box        " + "  ".join(f"{a} {low[i]:.4g} .. {high[i]:.4g}" for i, a in enumerate("xyz")))
    if scene.simulated.any():
        print(f"diagonal   {scene.diagonal:.4g} scene units (simulated kernels)")
    masks = {"simulated": scene.simulated, "pinned": scene.pinned, "foreground": scene.foreground}
    print("masks      " + "  ".join(f"{name} {int(mask.sum())}" for name, mask in masks.items()))
    print(f"volume     c = {scene.volume_scale:.6g} (V = prod of c s_i)")


def _print_hierarchy(hierarchy: "Hierarchy", radii: list[float]) -> None:
    levels = hierarchy.levels
    print("level      units   free  pinned  max diameter    volume sum      mass sum at density 1")
    for number, level in enumerate(levels):
        pinned, total = int(level.pinned.sum()), math.fsum(level.volume.double().tolist())
        bound = f"{radii[number - 1]:.3g} of diagonal" if number else "-"
        units = f"{level.count:>10} {level.count - pinned:>6} {pinned:>7}"
        print(f"{number:<5} {units}  {bound:<15} {total:<15.8g} {total:.8g}")
    predicted = list(range(len(levels) - 1, 0, -1))
    kernels, count = levels[0].count, hierarchy.predictions(predicted)
    fraction = f"{count} / {kernels} = {100 * count / kernels:.2f} %"
    print(f"N_F / N_K  {fraction} (units predicted per step, levels {predicted})")
    print("levels     " + " -> ".join(str(level.count) for level in levels))


def _draw(scene: "GaussianScene", hierarchy: "Hierarchy", arguments: argparse.Namespace, out: Path) -> None:
    from gausim.pictures.kernels import draw_clusters

    above = range(1, len(hierarchy.levels))
    upward = arguments.up or _away_from_pins(arguments)
    up = "xyz".index(upward[-1])
    first, second = (axis for axis in range(3) if axis != up)
    draw_clusters(
        out,
        scene.means[hierarchy.kernels].cpu().numpy(),
        [hierarchy.ancestor(0, level).numpy() for level in above],
        scene.pinned[hierarchy.kernels].cpu().numpy(),
        title=f"{scene.name}: {hierarchy.levels[0].count} simulated kernels (pinned grey)",
        names=[f"level {level}: {hierarchy.levels[level].count} units" for level in above],
        sides=((first, up), (second, up)),
        flip=upward.startswith("-"),
    )


def _away_from_pins(arguments: argparse.Namespace) -> str:
    from gausim.ops.selection import parse_half_space

    half = parse_half_space(arguments.pin[0] if arguments.pin else "below z=0")
    return ("" if half.above is None else "-") + "xyz"[half.axis]
