"""Several cameras' films of each sequence to synchronised, lossless frames.

Run ``gausim prepare ingest FILMS --out OUT``. Cameras are put on one clock by their time code, else by their
sound, else by a flash that all saw, else by given offsets; a camera that ends up more than half a frame from where it
should be is refused by name. The output is sequences/seq_000/cam_0/0000.png and so on (8-bit RGB), a sheet per sequence
to check the synchronisation by eye, and a manifest with every camera's facts.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gausim.core import DataError
from gausim.io.files import write_durably, write_json

if TYPE_CHECKING:
    import numpy as np

    from data_prep.capture.films.film import Film
    from data_prep.capture.films.sync import Alignment, Offsets
    from data_prep.capture.films.takes import Take
    from data_prep.common.progress import Tick

# Raise when the same films and settings give other frames than before.
REVISION = 1
METHODS = ("auto", "timecode", "audio", "flash", "offsets")
# PNG's effort: 1 is three times as fast as the default and 10 % larger.
COMPRESSION = 1
THUMBNAIL = 64

LAYOUT = """FILMS is a folder with one folder per sequence, each with one film per camera, named alike in all sequences;
or a folder with the films of a single sequence; or a list file, with paths relative to itself:

  {"sequences": [{"name": "poke", "cameras": {"left": "a/1.mp4", "right": "b/7.mov"},
                  "offsets": {"right": "7.3f"}, "start": 0.5, "duration": 2.0}]}

Cameras become cam_0, cam_1 ... in the natural order of their names."""


@dataclass(frozen=True)
class Options:
    """What is chosen.

    Attributes:
        sync: method, or ``auto``.
        offsets: by camera, seconds or frames with an ``f``, for all sequences that state none.
        reference: camera whose frames give the times; chosen by the residuals when None.
        fps: output rate as text (``25``, ``30000/1001``); the slowest camera's when None.
        shutter: exposure as part of the frame interval, for flashes.
        start: what is left out at the beginning of the common time [s].
        duration: how much of it is kept [s]; all when None.
        max_side: larger pictures are reduced to this [pixels]; None keeps them.
    """

    sync: str = "auto"
    offsets: Mapping[str, str] | None = None
    reference: str | None = None
    fps: str | None = None
    shutter: float = 1.0
    start: float = 0.0
    duration: float | None = None
    max_side: int | None = None


def ingest(
    films: Path, out: Path, options: Options | None = None, *, force: bool = False, advance: Tick | None = None
) -> dict[str, Any]:
    """Writes synchronised frames of all sequences.

    Args:
        films: folder or list file, see :func:`data_prep.capture.films.takes.find_takes`.
        out: directory of the result.
        options: what is chosen.
        force: replace a result of other films or settings.
        advance: told the sequence, frames done and frames in all, as they are written.

    Returns:
        The manifest; its ``results`` tell every camera's facts.

    Raises:
        DataError: a film is unusable, or the films do not go together.
    """
    from data_prep.capture.films.takes import find_takes
    from data_prep.common.stage import Stage, run_stage

    options = options or Options()
    takes = find_takes(films)
    settings = {
        **asdict(options),
        "takes": [{**asdict(t), "films": {c: p.name for c, p in t.films.items()}} for t in takes],
    }
    stage = Stage(
        name="ingest",
        revision=REVISION,
        inputs={f"{take.name}/{camera}": path for take in takes for camera, path in take.films.items()},
        settings=settings,
        packages=("av", "numpy", "scipy", "opencv-python-headless"),
    )

    def make(work: Path) -> dict[str, Any]:
        found = {take.name: _one_take(take, work / "sequences" / take.name, options, advance) for take in takes}
        rates = {name: facts["fps"] for name, facts in found.items()}
        if len(set(rates.values())) > 1:
            raise DataError(f"{films}: sequences have different rates: {rates}. State one with --fps.")
        return {"fps": next(iter(rates.values())), "cameras": list(takes[0].films), "sequences": found}

    return run_stage(stage, out, make, force=force)


def _one_take(take: Take, folder: Path, options: Options, advance: Tick | None) -> dict[str, Any]:
    """Synchronises and writes one sequence; its ``sync.json``, written last, says that it is complete."""
    marker = folder / "sync.json"
    if marker.is_file():
        found = json.loads(marker.read_bytes())
        assert isinstance(found, dict)
        return found
    films, alignment, found = synchronise(take, options)
    thumbnails = {}
    total = len(films) * len(alignment.frames[alignment.reference])
    for i, (camera, film) in enumerate(films.items()):
        thumbnails[camera] = _write_camera(
            film, alignment.frames[camera], folder / camera, options.max_side,
            lambda done, i=i: advance and advance(take.source, i * total // len(films) + done, total),  # type: ignore[misc]
        )  # fmt: skip
    from data_prep.capture.films.sheet import write_sheet

    write_sheet(folder / "sync.png", thumbnails, found)
    write_json(marker, found)
    return found


def synchronise(take: Take, options: Options) -> tuple[dict[str, Film], Alignment, dict[str, Any]]:
    """Reads the films' facts and finds the frames that belong together; writes nothing.

    Returns:
        The films and their alignment by camera, and what the manifest says of the sequence.

    Raises:
        DataError: a film is unusable, or the films do not go together.
    """
    from data_prep.capture.films.film import probe
    from data_prep.capture.films.sync import facts

    films = {camera: probe(path) for camera, path in take.films.items()}
    try:
        offsets, alignment = _placed(take, films, options)
    except DataError as error:
        raise DataError(f"sequence '{take.source}': {error}") from error
    cameras = {
        name: {"film": take.labels[name], **facts(film, name, offsets, alignment)} for name, film in films.items()
    }
    notes = [*offsets.notes, *_warnings(films)]
    found = {
        **{"source": take.source, "fps": float(alignment.rate), "frames": len(alignment.frames[alignment.reference])},
        **{"method": offsets.method, "reference": alignment.reference, "notes": notes, "cameras": cameras},
    }
    return films, alignment, found


def _placed(take: Take, films: Mapping[str, Film], options: Options) -> tuple[Offsets, Alignment]:
    from data_prep.capture.films.sync import align, measure
    from data_prep.capture.films.takes import offset_seconds

    given = {}
    for name, text in (take.offsets or options.offsets or {}).items():
        camera = _camera(name, take, "offsets")
        given[camera] = offset_seconds(text, float(films[camera].rate))
    offsets = measure(films, options.sync, given=given, shutter=options.shutter)
    alignment = align(
        films,
        offsets,
        rate=Fraction(options.fps) if options.fps else None,
        reference=_camera(options.reference, take, "reference") if options.reference else None,
        start=options.start if take.start is None else take.start,
        duration=options.duration if take.duration is None else take.duration,
    )
    return offsets, alignment


def _camera(name: str, take: Take, what: str) -> str:
    """The camera that the user calls so, by the output's name or the film's."""
    for camera, label in take.labels.items():
        if name in (camera, label):
            return camera
    raise DataError(f"{what}: no camera '{name}'; there are {dict(take.labels)}.")


def _warnings(films: Mapping[str, Film]) -> list[str]:
    notes = []
    for name, film in films.items():
        if film.hdr:
            notes.append(f"{name}: {film.hdr} footage; its 8-bit frames look flat. Record in standard range.")
    sizes = {film.size for film in films.values()}
    if len(sizes) > 1:
        notes.append(f"cameras have different sizes: {sorted(sizes)}")
    return notes


def _write_camera(
    film: Film, indices: np.ndarray, folder: Path, max_side: int | None, done: Callable[[int], None]
) -> list[np.ndarray]:
    """Writes the frames of one camera that are not there yet; returns a small grey picture of each."""
    import cv2

    from data_prep.capture.films.film import pictures, upright

    places: dict[int, list[int]] = {}
    for place, index in enumerate(indices):
        places.setdefault(int(index), []).append(place)
    small: dict[int, np.ndarray] = {}
    for index, frame in pictures(film):
        if index not in places:
            continue
        pixels = _reduced(cv2.cvtColor(upright(film, frame), cv2.COLOR_RGB2BGR), max_side)
        for place in places[index]:
            path = folder / f"{place:04d}.png"
            if not path.is_file():
                ok, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, COMPRESSION])
                if not ok:
                    raise DataError(f"{path}: cannot be encoded as PNG.")
                write_durably(path, data.tobytes())
            small[place] = _reduced(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), THUMBNAIL)
        done(len(small))
        if len(small) == len(indices):
            break
    if len(small) != len(indices):
        raise DataError(f"{film.path}: {len(indices)} frames are needed, {len(small)} can be decoded.")
    return [small[place] for place in range(len(indices))]


def _reduced(pixels: np.ndarray, max_side: int | None) -> np.ndarray:
    import cv2

    height, width = pixels.shape[:2]
    if not max_side or max(height, width) <= max_side:
        return pixels
    scale = max_side / max(height, width)
    return cv2.resize(
        pixels, (max(1, round(width * scale)), max(1, round(height * scale))), interpolation=cv2.INTER_AREA
    )


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    arguments = _parser().parse_args(argv)
    names = [name for name in Options.__dataclass_fields__]
    options = Options(**{name: getattr(arguments, name) for name in names})
    from data_prep.common.command import headline, told
    from data_prep.common.progress import bars

    def run() -> str:
        with bars("synchronising") as tick:
            manifest = ingest(arguments.films, arguments.out, options, force=arguments.force, advance=tick)
        return f"{headline(arguments.out, manifest)}\n{summary(manifest['results'])}"

    return told(run)


def summary(results: Mapping[str, Any]) -> str:
    """A few lines about every sequence, for people."""
    lines = []
    for name, found in results["sequences"].items():
        lines.append(
            f"{name} ({found['source']}): {found['frames']} frames at {found['fps']:.6g} per second, "
            f"by {found['method']}, reference {found['reference']}"
        )
        for camera, facts in found["cameras"].items():
            lines.append(
                f"  {camera} ({facts['film']}): starts {facts['offset_frames']:+.2f} frames later, residual "
                f"{facts['residual_frames']['largest']:.2f}, keeps {facts['kept'][0]}..{facts['kept'][1]} of "
                f"{facts['frames']} at {facts['fps']:.6g}"
            )
        lines += [f"  note: {note}" for note in found["notes"]]
    return "\n".join(lines)


def _parser() -> argparse.ArgumentParser:
    from data_prep.common.command import add_result

    parser = argparse.ArgumentParser(
        prog="gausim prepare ingest", description=__doc__.split("\n")[0],
        epilog=LAYOUT, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument(
        "films", type=Path, metavar="FILMS", help="folder with a folder of films per sequence, or a list file"
    )
    add_result(parser)
    sync = parser.add_argument_group("synchronisation")
    sync.add_argument(
        "--sync", choices=METHODS, default="auto", help="method; auto takes the first that applies (%(default)s)"
    )
    sync.add_argument(
        "--offsets",
        type=_offsets,
        metavar="CAM=X,CAM=X",
        help="how much later cameras began: seconds, or 7.3f in frames",
    )
    sync.add_argument(
        "--reference", metavar="CAM", help="camera whose frames give the times (the one with the smallest residuals)"
    )
    sync.add_argument(
        "--shutter", type=_part, default=1.0, help="exposure as part of the frame interval, for flashes (%(default)s)"
    )
    frames = parser.add_argument_group("frames")
    frames.add_argument(
        "--fps", type=_rate, help="output rate, of which all cameras' rates are multiples (the slowest camera's)"
    )
    frames.add_argument(
        "--start", type=_seconds, default=0.0, help="leave out so much of the common time [s] (%(default)s)"
    )
    frames.add_argument("--duration", type=_seconds, help="keep so much of it [s] (all)")
    frames.add_argument("--max-side", type=_positive, help="reduce larger pictures to this [pixels]")
    return parser


def _offsets(text: str) -> dict[str, str]:
    pairs = [part.partition("=") for part in text.split(",") if part.strip()]
    if not pairs or not all(name.strip() and value.strip() for name, _, value in pairs):
        raise argparse.ArgumentTypeError(f"expected CAMERA=SECONDS,CAMERA=FRAMESf, got {text!r}")
    return {name.strip(): value.strip() for name, _, value in pairs}


def _rate(text: str) -> str:
    try:
        rate = Fraction(text)
    except (ValueError, ZeroDivisionError):
        rate = Fraction(0)
    if not 0 < rate <= 1000:
        raise argparse.ArgumentTypeError(f"expected frames per second such as 25 or 30000/1001, got {text!r}")
    return str(rate)


def _seconds(text: str) -> float:
    value = float(text)
    if not math.isfinite(value) or value < 0:
        raise argparse.ArgumentTypeError("must be finite and at least 0")
    return value


def _part(text: str) -> float:
    value = float(text)
    if not 0 < value <= 1:
        raise argparse.ArgumentTypeError("must be above 0 and at most 1")
    return value


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError("must be at least 1")
    return value


if __name__ == "__main__":
    sys.exit(main())
