"""Brings a set in the layout of READY's authors to ours: ROOT/sparse/0 (COLMAP), images/, video_images/, meta.json.

Images of the name seq_XXXXX_cam_XXXXX in the COLMAP model are the fixed video cameras, the others are stills; frames
lie in video_images/seq_XXXXX_cam_XXXXX/. Frames without alpha get it from masks of the same names, where there are any
(--image-masks, --video-masks); otherwise the result still has to be segmented. Point clouds become scene.ply and its
masks: kernels within 0.01 of moving_part_points.ply are simulated, of clean_object_points.ply foreground, and those
that pin_mask.json lists are pinned. Pickles are never read.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from data_prep.common.command import add_result, headline, told
from data_prep.common.progress import Tick, silent
from gausim.core.errors import ConfigError, DataError
from gausim.io.files import write_json

if TYPE_CHECKING:
    from data_prep.scenes.ready import ReadyFiles

# Raise when the same inputs and settings give another result than before.
REVISION = 1
# METHOD of the paper's data: kernels this near to a point cloud belong to it [scene units].
NEAR = 0.01


@dataclass(frozen=True)
class ReadyOptions:
    """What the folders do not say.

    Attributes:
        fps: frames per second (50; the orchids' films have 29.97).
        train_frames: frames 0..n-1 of every sequence are trained on.
        heldout: cameras that are never trained on.
        near: distance to a point cloud within which kernels belong to it [scene units].
        name: of the object; the folder's name when None.
    """

    fps: float = 50.0
    train_frames: int = 16
    heldout: tuple[str, ...] = ()
    near: float = NEAR
    name: str | None = None

    def __post_init__(self) -> None:
        """Checks the numbers."""
        if not 0 < self.fps < 1e4 or self.train_frames < 2 or not 0 < self.near < 1e6:
            raise ConfigError("--fps and --near must be positive, --train-frames at least 2.")


def import_ready(
    root: Path,
    out: Path,
    options: ReadyOptions,
    *,
    image_masks: Path | None = None,
    video_masks: Path | None = None,
    force: bool = False,
    tick: Tick = silent,
) -> dict[str, Any]:
    """Runs the stage.

    Args:
        root: folder of one object in the authors' layout.
        out: folder of the result, in the layout of docs/reference/files.md.
        options: what the folders do not say.
        image_masks: masks of stills, with the names of the images; ``root/masks`` where it is there.
        video_masks: masks of frames, laid out like ``video_images``; ``root/video_masks`` where it is there.
        force: replace a result of other inputs or settings.
        tick: told of the progress: step, done, of how many.

    Returns:
        The stage's manifest.

    Raises:
        DataError: a file is missing or malformed, or the sequences have no camera in common.
        SceneError: the point cloud is no 3DGS scene, or a mask marks nothing.
    """
    from data_prep.common.stage import Stage, run_stage
    from data_prep.scenes.ready import find_files

    files = find_files(root, image_masks, video_masks)
    unknown = sorted(set(options.heldout) - set(files.views))
    if unknown or set(options.heldout) == set(files.views):
        raise ConfigError(f"--heldout {unknown or list(options.heldout)}: expected a part of {list(files.views)}.")
    stage = Stage(
        "import_ready", REVISION, files.inputs, asdict(options), ("numpy", "opencv-python-headless", "pycolmap")
    )
    return run_stage(stage, out, lambda work: _make(work, files, options, tick), force=force)


def _make(work: Path, files: ReadyFiles, options: ReadyOptions, tick: Tick) -> dict[str, Any]:
    from data_prep.cameras.output import Straighteners, write_points, write_sequence, write_stills
    from data_prep.scenes.ready import sequence_poses

    straighteners = Straighteners()
    results: dict[str, Any] = {"stills": len(files.stills), "sequences": {}, "left_out": files.left_out}
    bare: set[str] = set()
    if files.stills:
        write_stills(work / "static", files.stills, straighteners, tick, mask_of=files.still_mask, bare=bare)
    for name in files.sequences:
        cameras = sequence_poses(files, name)
        target = work / "sequences" / name
        frames = write_sequence(
            target, files.frames[name], cameras, options.fps, straighteners, tick, mask_of=files.frame_mask, bare=bare
        )
        if frames < options.train_frames:
            raise DataError(f"{files.root}: {name} has {frames} frames, fewer than --train-frames.")
        results["sequences"][name] = {"frames": frames, "cameras_left_out": files.extra_views[name]}
    points = files.model.points
    if len(points.ids):
        write_points(work / "points.npz", points, points.xyz, points.rgb)
    results["scene"] = _scene(work, files, options)
    results["without_alpha"] = sorted(bare)
    _facts(work / "dataset.json", files, options)
    return results


def _facts(path: Path, files: ReadyFiles, options: ReadyOptions) -> None:

    facts = {
        "name": options.name or files.root.name,
        "fps": options.fps,
        "views": list(files.views),
        "train_views": [view for view in files.views if view not in options.heldout],
        "heldout_views": list(options.heldout),
        "train_frames": [0, options.train_frames],
        "train_sequences": [name for name in files.sequences if name in files.train],
        "test_sequences": [name for name in files.sequences if name in files.test],
    }
    write_json(path, facts)


def _scene(work: Path, files: ReadyFiles, options: ReadyOptions) -> dict[str, int] | None:
    """Writes the scene with its masks, where there is one, and returns how many kernels they mark."""
    import torch

    from data_prep.scenes.ready import read_pins
    from data_prep.scenes.selections import read_points
    from gausim.io.ply import load_scene, save_scene
    from gausim.ops.selection import NearPoints, apply_masks

    if files.scene is None:
        return None
    scene = load_scene(files.scene, name="scene")
    masks: dict[str, Any] = {}
    for mask, path in (("simulated", files.moving), ("foreground", files.object)):
        if path is not None:
            masks[mask] = NearPoints(torch.from_numpy(read_points(path)), options.near)
    if files.pins is not None:
        masks["pinned"] = torch.from_numpy(read_pins(files.pins, scene.count))
    scene = apply_masks(scene, **masks)
    save_scene(scene, work / "scene.ply")
    return {"kernels": scene.count} | {n: int(getattr(scene, n).sum()) for n in ("simulated", "pinned", "foreground")}


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    arguments = _parser().parse_args(argv)
    from data_prep.common.progress import bars

    def run() -> str:
        heldout = tuple(n.strip() for n in (arguments.heldout or "").split(",") if n.strip())
        options = ReadyOptions(arguments.fps, arguments.train_frames, heldout, arguments.near, arguments.name)
        with bars() as tick:
            manifest = import_ready(
                arguments.root, arguments.out, options, image_masks=arguments.image_masks,
                video_masks=arguments.video_masks, force=arguments.force, tick=tick,
            )  # fmt: skip
        return f"{headline(arguments.out, manifest)}\n{summary(manifest['results'])}"

    return told(run)


def summary(results: Mapping[str, Any]) -> str:
    """A few lines about what was imported, for people."""
    lines = [
        f"stills      {results['stills']}",
        f"sequences   {len(results['sequences'])}: {', '.join(results['sequences'])}",
        *(f"left out    {name}: {why}" for name, why in results["left_out"].items()),
        f"scene       {results['scene'] or 'none (no point_cloud.ply): reconstruct it'}",
    ]
    if results["without_alpha"]:
        lines.append(f"no alpha    in {', '.join(results['without_alpha'])}: segment them next")
    return "\n".join(lines)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m data_prep.import_ready",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("root", type=Path, metavar="ROOT", help="folder of one object in the authors' layout")
    add_result(parser)
    group = parser.add_argument_group("masks of the images (white is the object)")
    group.add_argument("--image-masks", type=Path, metavar="DIR", help="of stills, named like them (ROOT/masks)")
    group.add_argument(
        "--video-masks", type=Path, metavar="DIR", help="of frames, like video_images (ROOT/video_masks)"
    )
    group = parser.add_argument_group("what the folders do not say")
    group.add_argument("--fps", type=float, default=50.0, help="of the films; the orchids' 29.97 (%(default)s)")
    group.add_argument(
        "--train-frames", type=int, default=16, metavar="N", help="first frames to train on (%(default)s)"
    )
    group.add_argument("--heldout", metavar="CAM,CAM", help="cameras never to train on (none)")
    group.add_argument(
        "--near", type=float, default=NEAR, help="distance to the point clouds [scene units] (%(default)s)"
    )
    group.add_argument("--name", help="of the object (the folder's)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
