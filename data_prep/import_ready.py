"""Brings a set in the layout of READY's authors to ours: ROOT/sparse/0 (COLMAP), images/, video_images/, meta.json.

Images of the name seq_XXXXX_cam_XXXXX in the COLMAP model are the fixed video cameras, the others are stills; frames
lie in video_images/seq_XXXXX_cam_XXXXX/. Frames without alpha get it from masks of the same names, where there are any
(--image-masks, --video-masks); otherwise the result still has to be segmented. Point clouds become scene.ply and its
masks: kernels within 0.01 of moving_part_points.ply are simulated, of clean_object_points.ply foreground, and those
that pin_mask.json lists are pinned. Pickles are never read.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from data_prep.capture.cameras.output import PosedWriter, write_points
from data_prep.common.command import Options, add_options, chosen, headline, names, option, run_command, stage_parser
from data_prep.common.objects import object_facts
from data_prep.common.progress import Tick, silent
from data_prep.common.stage import Stage, files_in, run_stage
from data_prep.ready.authors import ReadyFiles, find_files, sequence_poses, write_scene
from gausim.core.errors import ConfigError, DataError
from gausim.io.files import write_json

# Raise when the same inputs and settings give another result than before.
REVISION = 1
# METHOD of the paper's data: kernels this near to a point cloud belong to it [scene units].
NEAR = 0.01


@dataclass(frozen=True)
class ReadyOptions(Options):
    """Facts that the folders do not contain."""

    fps: float = option(50.0, "of the films; the orchids' 29.97 (%(default)s)", least=1e-3, most=1e4)
    train_frames: int = option(16, "first frames to train on (%(default)s)", least=2, metavar="N")
    heldout: tuple[str, ...] = option((), "cameras never to train on (none)", type=names, metavar="CAM,CAM")
    near: float = option(NEAR, "distance to the point clouds [scene units] (%(default)s)", least=1e-9, most=1e6)
    name: str | None = option(None, "of the object (the folder's)")


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

    Raises:
        DataError: a file is missing or malformed, or the sequences have no camera in common.
        SceneError: the point cloud is no 3DGS scene, or a mask marks nothing.
    """
    files = find_files(root, image_masks, video_masks)
    unknown = sorted(set(options.heldout) - set(files.views))
    if unknown or set(options.heldout) == set(files.views):
        raise ConfigError(f"--heldout {unknown or list(options.heldout)}: expected a part of {list(files.views)}.")
    stage = Stage(
        "import_ready", REVISION, files.inputs(), asdict(options), ("numpy", "opencv-python-headless", "pycolmap")
    )
    return run_stage(stage, out, lambda work: _make(work, files, options, tick), force=force)


def _make(work: Path, files: ReadyFiles, options: ReadyOptions, tick: Tick) -> dict[str, Any]:
    writer = PosedWriter(tick, files.mask)
    results: dict[str, Any] = {"stills": len(files.stills), "sequences": {}, "left_out": files.left_out}
    if files.stills:
        writer.stills(work / "static", files.stills)
    for name in files.frames:
        cameras = sequence_poses(files, name)
        frames = writer.sequence(work / "sequences" / name, files.frames[name], cameras, options.fps)
        if frames < options.train_frames:
            raise DataError(f"{files.root}: {name} has {frames} frames, fewer than --train-frames.")
        results["sequences"][name] = {"frames": frames, "cameras_left_out": files.extra_views[name]}
    points = files.model.points
    if len(points.ids):
        write_points(work / "points.npz", points, points.xyz, points.rgb)
    results["scene"] = write_scene(work, files.root, options.near)
    results["without_alpha"] = sorted(writer.bare)
    facts = object_facts(
        options.name or files.root.name, options.fps, files.views, options.heldout, options.train_frames
    )
    used = {f"{part}_sequences": [n for n in files.frames if n in files.meta.lists[part]] for part in ("train", "test")}
    write_json(work / "dataset.json", facts | used)
    return {**results, "files": files_in(work)}


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = stage_parser("import_ready", __doc__)
    parser.add_argument("root", type=Path, metavar="ROOT", help="folder of one object in the authors' layout")
    group = parser.add_argument_group("masks of the images (white is the object)")
    group.add_argument("--image-masks", type=Path, metavar="DIR", help="of stills, named like them (ROOT/masks)")
    group.add_argument(
        "--video-masks", type=Path, metavar="DIR", help="of frames, like video_images (ROOT/video_masks)"
    )
    add_options(parser.add_argument_group("what the folders do not say"), ReadyOptions)

    def run(given: argparse.Namespace, tick: Tick) -> str:
        manifest = import_ready(
            given.root, given.out, chosen(ReadyOptions, given), image_masks=given.image_masks,
            video_masks=given.video_masks, force=given.force, tick=tick,
        )  # fmt: skip
        return f"{headline(given.out, manifest)}\n{summary(manifest['results'])}"

    return run_command(parser, argv, run)


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
