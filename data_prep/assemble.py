"""Put stills, sequences and the scene of one object into one directory, with ``dataset.json``, ready for training.

PICTURES are results of `segment` (or of `poses`, where the pictures had alpha already, or of `public`): posed
stills become OUT/static, posed sequences OUT/sequences. Of several folders the later one replaces what the earlier ones
have, so that films may be cut out in another way than stills. Without --scene the object is what `reconstruct` needs;
with the scene of `select` it is complete, and is checked as `gausim verify` does before it takes its name.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec import Struct

from data_prep.common.command import Options, add_options, chosen, headline, names, option, run_command, stage_parser
from data_prep.common.objects import described, object_facts, refuse_faults, train_command
from data_prep.common.progress import Tick, silent
from data_prep.common.stage import Stage, copy_missing, files_in, run_stage
from gausim.core.errors import ConfigError, DataError
from gausim.io.files import write_json
from gausim.io.plain_json import checked

if TYPE_CHECKING:
    from data_prep.ready.gathered import Gathered

# Raise when the same inputs and settings give another result than before.
REVISION = 1
# The paper trains on the first 16 frames.
TRAIN_FRAMES = 16
# From so many cameras on, one is left out of training unless told otherwise.
ENOUGH_VIEWS = 3
SCENE = "scene.ply"


@dataclass(frozen=True)
class AssembleOptions(Options):
    """Facts beyond the pictures; None takes the value of a ``dataset.json`` beside them, or the default."""

    name: str | None = option(None, "name the object (default: as the result's folder)")
    fps: float | None = option(
        None, "state the frames per second (default: as transforms.json of the sequences)", least=1e-3, most=1e4
    )
    heldout: tuple[str, ...] | None = option(
        None, "never train on these cameras, or 'none' (the last of three or more)", type=names, metavar="CAM,CAM"
    )
    train_frames: int | None = option(
        None, f"first frames to train on ({TRAIN_FRAMES}, or the shortest sequence)", least=2, metavar="N"
    )


class _Given(Struct):
    """Fields of a ``dataset.json`` beside the pictures that matter here."""

    name: str | None = None
    fps: float | None = None
    heldout_views: list[str] | None = None
    train_frames: tuple[int, int] | None = None


def assemble(
    pictures: Sequence[Path], out: Path, options: AssembleOptions | None = None, *, scene: Path | None = None,
    overwrite: bool = False, tick: Tick = silent,
) -> dict[str, Any]:  # fmt: skip
    """Runs the stage."""
    from data_prep.ready.gathered import gather

    options, found = options or AssembleOptions(), gather(pictures)
    if not found.sequences:
        raise DataError(
            f"{pictures[0]}: has no sequences, and dynamics are learned from them. For a scene from photos alone leave "
            "this stage out: reconstruct the folder itself."
        )
    facts = _facts(found, options, out.name)
    files = {**dict(found.files()), **(_scene_files(scene) if scene is not None else {})}
    stage = Stage("assemble", REVISION, files, {"facts": facts, **asdict(options)})
    return run_stage(stage, out, lambda work: _make(work, out, found, files, facts, tick), overwrite=overwrite)


def _facts(found: Gathered, options: AssembleOptions, name: str) -> dict[str, Any]:
    """The content of ``dataset.json``."""
    given = checked(dict(found.facts), _Given, "dataset.json", "Correct it beside the pictures.")
    views, fps = found.views, options.fps or found.fps or given.fps
    if fps is None:
        raise ConfigError("--fps: the sequences do not say how many frames per second they have; state it.")
    heldout = options.heldout if options.heldout is not None else given.heldout_views
    if heldout is None:
        heldout = views[-1:] if len(views) >= ENOUGH_VIEWS else ()
    if not set(heldout) < set(views):
        raise ConfigError(f"--heldout {','.join(heldout)}: expected a part of the cameras {list(views)}.")
    lengths = {name: _length(posed.frames) for name, posed in found.sequences.items()}
    shortest = min(lengths, key=lambda name: lengths[name])
    wanted = options.train_frames or (given.train_frames or (0, min(TRAIN_FRAMES, lengths[shortest])))[1]
    if not 2 <= wanted <= lengths[shortest]:
        raise ConfigError(
            f"--train-frames {wanted}: {shortest} has {lengths[shortest]} frames; expected 2 to {lengths[shortest]}, "
            "or leave that sequence out."
        )
    return dict(found.facts) | object_facts(options.name or given.name or name, fps, views, heldout, wanted)


def _length(frames: Sequence[Any]) -> int:
    """Frames of the camera that has the fewest."""
    return min(Counter(frame.camera for frame in frames).values())


def _scene_files(scene: Path) -> dict[str, Path]:
    """The scene's files by their names in the object."""
    from gausim.io.ply import masks_path

    path = scene / SCENE if scene.is_dir() else scene
    if not path.is_file():
        raise DataError(f"{path}: not found. Expected the rest scene, as `reconstruct` or `select` writes it.")
    masks = masks_path(path)
    return {SCENE: path, **({masks_path(Path(SCENE)).name: masks} if masks.is_file() else {})}


def _make(
    work: Path, out: Path, found: Gathered, files: Mapping[str, Path], facts: Mapping[str, Any], tick: Tick
) -> dict[str, Any]:
    """Copies what is missing in ``work``, checks it, and tells what is there."""
    for number, (name, path) in enumerate(files.items(), 1):
        copy_missing(path, work / name)
        tick("copying", number, len(files))
    write_json(work / "dataset.json", facts)
    refuse_faults(work, out)
    return {
        "stills": len(found.stills.frames) if found.stills is not None else 0,
        "sequences": {name: _length(posed.frames) for name, posed in found.sequences.items()}, "facts": facts,
        "scene": SCENE in files, "files": files_in(work),
    }  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = stage_parser("assemble", __doc__)
    parser.add_argument(
        "pictures", type=Path, nargs="+", metavar="PICTURES", help="folders with posed RGBA stills and sequences"
    )
    parser.add_argument(
        "--scene", type=Path, metavar="SCENE", help="take this rest scene (PLY, masks beside it), or its folder"
    )
    add_options(parser.add_argument_group("what the pictures do not say"), AssembleOptions)

    def run(given: argparse.Namespace, tick: Tick) -> str:
        options = chosen(AssembleOptions, given)
        manifest = assemble(given.pictures, given.out, options, scene=given.scene, overwrite=given.overwrite, tick=tick)
        return f"{headline(given.out, manifest)}\n{summary(manifest['results'], given.out)}"

    return run_command(parser, argv, run)


def summary(results: Mapping[str, Any], out: Path) -> str:
    """A few lines about the object, for people."""
    lines = described(results["facts"], results["stills"], results["sequences"])
    if results["scene"]:
        return "\n".join([*lines, f"train       {train_command(results['facts']['name'], out)}"])
    return "\n".join([*lines, f"scene       none yet: gausim reconstruct {out}"])
