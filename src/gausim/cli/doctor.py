"""`gausim doctor`: faults of a data set and their remedies, to be used before a training."""

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gausim.cli.arguments import add_pin_option, add_threads_option, command_parser, pinned_by
from gausim.core.errors import DataError

if TYPE_CHECKING:
    from gausim.core.scene import GaussianScene
    from gausim.data.objects import ObjectData


def main(argv: list[str]) -> int:
    """Runs the command; returns 0 if the data can be trained on, 1 if there are faults."""
    arguments = _parser().parse_args(argv)
    import torch

    from gausim.data.objects import find_objects

    torch.set_num_threads(arguments.threads)
    roots = find_objects(arguments.root)
    findings: dict[str, Any] = {}
    for root in roots:
        out = arguments.out / root.name if arguments.out and len(roots) > 1 else arguments.out
        findings[str(root)] = _one(root, arguments, out)
    if arguments.json:
        print(json.dumps(findings, indent=1))
    return 1 if any(entry["ruinous"] for entry in findings.values()) else 0


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "doctor",
        " Exits with 1 if a fault would make training useless. Files and formats are checked first, as `gausim verify "
        "--quick` does.",
    )
    add = parser.add_argument
    add("root", metavar="ROOT", type=Path, help="object directory, or a folder of them")
    add("--scene", metavar="SCENE.ply", type=Path, help="take this rest scene (default: ROOT/scene.ply)")
    add("--masks", metavar="FILE", type=Path, help="take its masks (npz) from there (default: beside the scene)")
    add_pin_option(parser)
    add("--out", metavar="DIR", type=Path, help="write views.png and motion.png to this folder (default: none)")
    add("--json", action="store_true", help="print an object: {DIRECTORY: {ruinous, faults, findings, left_out}}")
    add_threads_option(parser)
    return parser


def _one(root: Path, arguments: argparse.Namespace, out: Path | None) -> dict[str, Any]:
    """Examines one object, prints the findings and returns them as plain data."""
    from gausim.data.objects import ObjectData
    from gausim.data.verify import verify
    from gausim.doctor.examine import examine
    from gausim.doctor.text import findings_text, plain_findings

    # Masks and pins are checked below: options may set them, and missing pins are one of the findings.
    faults = verify(root, quick=True, scene=False)
    if faults:
        if not arguments.json:
            count = "1 fault" if len(faults) == 1 else f"{len(faults)} faults"
            print(f"{root}: {count} in its files; nothing else was checked")
            print("\n".join(f"  {fault.where}: {fault.what}" for fault in faults))
        return {"ruinous": True, "faults": [[f.where, f.what] for f in faults], "findings": [], "left_out": {}}
    data = ObjectData(root, scene=arguments.scene, masks=arguments.masks)
    found = examine(data, _scene(data, arguments))
    if not arguments.json:
        print(findings_text(str(root), found))
    if out is not None and found.evidence is not None:
        from gausim.doctor.pictures import draw_pictures  # loads Matplotlib

        draw_pictures(found.evidence, out)
        if not arguments.json:
            print(f"pictures  {out}")
    return {"ruinous": found.ruinous, "faults": [], **plain_findings(found)}


def _scene(data: "ObjectData", arguments: argparse.Namespace) -> "GaussianScene | None":
    """The rest scene with the requested pins; None if the object has no scene yet."""
    from gausim.io.ply import load_scene

    if not data.scene_path.is_file():
        if arguments.scene is not None:
            raise DataError(f"{data.scene_path}: no such file. Give --scene the PLY that `gausim reconstruct` wrote.")
        return None
    return pinned_by(load_scene(data.scene_path, masks=data.masks_path, name=data.name), arguments.pin)
