"""Synchronise several cameras' films of each sequence into lossless frames.

Cameras are put on one clock by their sound, else by a flash that all saw, else by given offsets; a camera that ends up
more than half a frame from where it should be is refused by name. The output is sequences/seq_000/cam_0/0000.png and
so on (8-bit RGB), a sheet per sequence to check the synchronisation by eye, and a manifest with every camera's facts.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from data_prep.capture.films.film import Film, pictures, probe, upright
from data_prep.capture.films.sync import METHODS, Alignment, align, facts, measure
from data_prep.capture.films.takes import Take, find_takes, offset_seconds
from data_prep.common.command import Options, add_options, chosen, headline, option, run_command, stage_parser
from data_prep.common.photos import reduced, write_picture
from data_prep.common.progress import Tick, silent
from data_prep.common.stage import Stage, run_stage
from gausim.core.errors import ConfigError, DataError
from gausim.io.files import write_json

# Raise when the same films and settings give other frames than before.
REVISION = 1
# PNG's effort: 1 is three times as fast as the default and 10 % larger.
COMPRESSION = 1
THUMBNAIL, MOMENTS = 160, 9

LAYOUT = """FILMS is a folder with one folder per sequence, each with one film per camera, named alike in all sequences;
or a folder with the films of a single sequence. Cameras become cam_0, cam_1 ... in the natural order of their names."""


def _offsets(text: str) -> dict[str, str]:
    pairs = [part.partition("=") for part in text.split(",") if part.strip()]
    if not pairs or not all(name.strip() and value.strip() for name, _, value in pairs):
        raise argparse.ArgumentTypeError(f"expected CAMERA=SECONDS,CAMERA=FRAMESf, got {text!r}")
    return {name.strip(): value.strip() for name, _, value in pairs}


@dataclass(frozen=True)
class IngestOptions(Options):
    """Settings of synchronisation and of the frames that are written."""

    sync: str = option(
        "auto",
        "synchronise by this method; auto takes the first that applies (%(default)s)",
        choices=("auto", *METHODS),
    )
    offsets: Mapping[str, str] | None = option(
        None, "state how much later cameras began, in every sequence: seconds, or 7.3f in frames",
        type=_offsets, metavar="CAM=X,CAM=X",
    )  # fmt: skip
    reference: str | None = option(
        None, "take the times of this camera's frames (the one with the smallest residuals)", metavar="CAM"
    )
    fps: str | None = option(None, "write this rate, of which all cameras' rates are multiples (the slowest camera's)")
    start: float = option(0.0, "leave out so much of the common time [s] (%(default)s)", least=0)
    duration: float | None = option(None, "keep so much of it [s] (all)", least=0)
    max_side: int | None = option(None, "reduce larger pictures to this [pixels]", least=1)

    def __post_init__(self) -> None:
        """Checks the numbers."""
        super().__post_init__()
        try:
            good = self.fps is None or 0 < Fraction(self.fps) <= 1000
        except (ValueError, ZeroDivisionError):
            good = False
        if not good:
            raise ConfigError(f"--fps: expected frames per second such as 25 or 30000/1001, got {self.fps!r}.")


def ingest(
    films: Path, out: Path, options: IngestOptions | None = None, *, overwrite: bool = False, tick: Tick = silent
) -> dict[str, Any]:
    """Writes synchronised frames of all sequences."""
    options = options or IngestOptions()
    takes = find_takes(films)
    told = [{**asdict(take), "films": {camera: path.name for camera, path in take.films.items()}} for take in takes]
    inputs = {f"{take.name}/{camera}": path for take in takes for camera, path in take.films.items()}
    packages = ("av", "numpy", "scipy", "opencv-python-headless")
    stage = Stage("ingest", REVISION, inputs, {**asdict(options), "takes": told}, packages)

    def make(work: Path) -> dict[str, Any]:
        found = {take.name: _one_take(take, work / "sequences" / take.name, options, tick) for take in takes}
        rates = {name: facts["fps"] for name, facts in found.items()}
        if len(set(rates.values())) > 1:
            raise DataError(f"{films}: sequences have different rates: {rates}. State one with --fps.")
        return {"fps": next(iter(rates.values())), "cameras": list(takes[0].films), "sequences": found}

    return run_stage(stage, out, make, overwrite=overwrite)


def _one_take(take: Take, folder: Path, options: IngestOptions, tick: Tick) -> dict[str, Any]:
    """Synchronises and writes one sequence; its ``sync.json``, written last, says that it is complete."""
    marker = folder / "sync.json"
    if marker.is_file():
        found: dict[str, Any] = json.loads(marker.read_bytes())
        return found
    films, alignment, found = synchronise(take, options)
    thumbnails = {}
    count = len(alignment.frames[alignment.reference])
    for i, (camera, film) in enumerate(films.items()):
        thumbnails[camera] = _write_camera(
            film, alignment.frames[camera], folder / camera, options.max_side,
            lambda done, i=i: tick(take.source, i * count + done, len(films) * count),  # type: ignore[misc]
        )  # fmt: skip
    _write_sheet(folder / "sync.png", thumbnails)
    write_json(marker, found)
    return found


def synchronise(take: Take, options: IngestOptions) -> tuple[dict[str, Film], Alignment, dict[str, Any]]:
    """Reads the films' facts and finds the frames that belong together; writes nothing.

    Returns:
        The films and their alignment by camera, and what the manifest says of the sequence.
    """
    films = {camera: probe(path) for camera, path in take.films.items()}
    try:
        given = {}
        for name, text in (options.offsets or {}).items():
            camera = take.camera(name, "offsets")
            given[camera] = offset_seconds(text, float(films[camera].rate))
        offsets = measure(films, options.sync, given=given)
        alignment = align(
            films, offsets, rate=Fraction(options.fps) if options.fps else None,
            reference=take.camera(options.reference, "reference") if options.reference else None,
            start=options.start, duration=options.duration,
        )  # fmt: skip
    except DataError as error:
        raise DataError(f"sequence '{take.source}': {error}") from error
    found = {
        "source": take.source, "fps": float(alignment.rate), "frames": len(alignment.frames[alignment.reference]),
        "method": offsets.method, "reference": alignment.reference, "notes": [*offsets.notes, *_warnings(films)],
        "cameras": {
            name: {"film": take.labels[name], **facts(film, name, offsets, alignment)} for name, film in films.items()
        },
    }  # fmt: skip
    return films, alignment, found


def _warnings(films: Mapping[str, Film]) -> list[str]:
    notes = []
    for name, film in films.items():
        if film.hdr:
            notes.append(f"{name}: {film.hdr} footage; its 8-bit frames look flat. Record in standard range.")
        if film.before_key:
            notes.append(f"{name}: begins between key frames; its first {film.before_key} frames are left out")
    sizes = sorted({film.size for film in films.values()})
    return notes if len(sizes) == 1 else [*notes, f"cameras have different sizes: {sizes}"]


def _write_camera(
    film: Film, indices: np.ndarray, folder: Path, max_side: int | None, done: Callable[[int], None]
) -> list[np.ndarray]:
    """Writes the frames of one camera that are not there yet; returns a small picture of each."""
    small: dict[int, np.ndarray] = {}
    for index, frame in pictures(film):
        places = np.flatnonzero(indices == index)
        if not len(places):
            continue
        pixels = reduced(upright(film, frame), max_side)
        for place in places.tolist():
            path = folder / f"{place:04d}.png"
            if not path.is_file():
                write_picture(path, pixels, COMPRESSION)
            small[place] = reduced(pixels, THUMBNAIL)
        done(len(small))
        if len(small) == len(indices):
            break
    if len(small) != len(indices):
        raise DataError(f"{film.path}: {len(indices)} frames are needed, {len(small)} can be decoded.")
    return [small[place] for place in range(len(indices))]


def _write_sheet(path: Path, thumbnails: Mapping[str, list[np.ndarray]]) -> None:
    """Writes a PNG to check the synchronisation by eye: small pictures around the fastest motion, a camera per row."""
    cameras = list(thumbnails.values())
    motion = sum(np.abs(np.diff(np.stack(frames).astype(np.float32), axis=0)).mean((1, 2, 3)) for frames in cameras)
    count = len(cameras[0])
    first = int(np.clip(np.argmax(motion) + 1 - MOMENTS // 2, 0, max(0, count - MOMENTS))) if count > 1 else 0
    rows = [
        np.hstack([cv2.resize(f, (THUMBNAIL, THUMBNAIL)) for f in frames[first : first + MOMENTS]])
        for frames in cameras
    ]
    for row, name in zip(rows, thumbnails, strict=True):
        cv2.putText(row, f"{name}, frames from {first}", (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 60, 60), 1)
    write_picture(path, np.vstack(rows))


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = stage_parser("ingest", __doc__, epilog=LAYOUT)
    parser.add_argument("films", type=Path, metavar="FILMS", help="folder of films; see below")
    add_options(parser.add_argument_group("synchronisation and frames"), IngestOptions)

    def run(arguments: argparse.Namespace, tick: Tick) -> str:
        options = chosen(IngestOptions, arguments)
        manifest = ingest(arguments.films, arguments.out, options, overwrite=arguments.overwrite, tick=tick)
        return f"{headline(arguments.out, manifest)}\n{summary(manifest['results'])}"

    return run_command(parser, argv, run, waiting="synchronising")


def summary(results: Mapping[str, Any]) -> str:
    """A few lines about every sequence, for people."""
    lines = []
    for name, found in results["sequences"].items():
        lines.append(
            f"{name} ({found['source']}): {found['frames']} frames at {found['fps']:.6g} per second, "
            f"by {found['method']}, reference {found['reference']}"
        )
        for camera, known in found["cameras"].items():
            lines.append(
                f"  {camera} ({known['film']}): starts {known['offset_frames']:+.2f} frames later, residual "
                f"{known['residual_frames']['largest']:.2f}, keeps {known['kept'][0]}..{known['kept'][1]} of "
                f"{known['frames']} at {known['fps']:.6g}"
            )
        lines += [f"  note: {note}" for note in found["notes"]]
    return "\n".join(lines)
