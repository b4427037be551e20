"""Sources of an object: posed stills and sequences in the results of other stages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gausim.core.errors import DataError
from gausim.io.files import natural
from gausim.io.pixels import read_header
from gausim.io.plain_json import read_json
from gausim.io.transforms import PosedImages, read_transforms

TRANSFORMS, FACTS = "transforms.json", "dataset.json"


@dataclass(frozen=True, eq=False)
class Gathered:
    """Posed pictures of one object, before they are brought together."""

    stills: PosedImages | None  # those of the rest state; None where there are none
    sequences: Mapping[str, PosedImages]  # by name, all with the same cameras and rate
    facts: Mapping[str, Any]  # what a ``dataset.json`` beside them says already

    def files(self) -> Iterator[tuple[str, Path]]:
        """Every file to copy, by its name in the assembled object."""
        sets = {f"sequences/{name}": posed for name, posed in self.sequences.items()}
        for place, posed in (({"static": self.stills} if self.stills is not None else {}) | sets).items():
            yield f"{place}/{TRANSFORMS}", posed.path
            for name in dict.fromkeys(_inside(posed.path, frame.path) for frame in posed.frames):
                yield f"{place}/{name}", posed.path.parent / name

    @property
    def views(self) -> tuple[str, ...]:
        """The cameras, in natural order."""
        return _views(next(iter(self.sequences.values())))

    @property
    def fps(self) -> float | None:
        """Frames per second that the sequences state; None where none does."""
        return next((posed.fps for posed in self.sequences.values() if posed.fps is not None), None)


def gather(folders: Sequence[Path]) -> Gathered:
    """Looks for posed pictures; what a later folder has replaces what an earlier one has by the same name."""
    stills: PosedImages | None = None
    sequences: dict[str, PosedImages] = {}
    facts: dict[str, Any] = {}
    for folder in folders:
        if not folder.is_dir():
            raise DataError(f"{folder}: no such folder. Expected the result of segment, or of poses.")
        still = next((p for p in (folder, folder / "static") if (p / TRANSFORMS).is_file()), None)
        films = _sequences(folder)
        if still is None and not films:
            raise DataError(
                f"{folder}: no posed pictures (no {TRANSFORMS} in it, in static/ or in sequences/*/). `segment` "
                "carries them along where it reads the result of `poses`, without --every."
            )
        stills = _posed(still) if still is not None else stills
        sequences.update({film.name: _posed(film) for film in films})
        facts.update(read_json(folder / FACTS) if (folder / FACTS).is_file() else {})
    ordered = {name: sequences[name] for name in sorted(sequences, key=natural)}
    _check_alike(ordered)
    return Gathered(stills, ordered, facts)


def _sequences(folder: Path) -> list[Path]:
    """Folders of sequences: in ``sequences``, or in the folder itself where that is what was segmented."""
    inner = folder / "sequences"
    found = sorted((p for p in (inner if inner.is_dir() else folder).iterdir() if p.is_dir()), key=lambda p: p.name)
    if not inner.is_dir():
        return [p for p in found if (p / TRANSFORMS).is_file() and p.name != "static"]
    for path in found:
        if not (path / TRANSFORMS).is_file():
            raise DataError(f"{path / TRANSFORMS}: not found. Give the sequences their poses with `poses`.")
    return found


def _posed(folder: Path) -> PosedImages:
    """Reads a ``transforms.json`` and looks at one picture of each of its folders."""
    posed = read_transforms(folder / TRANSFORMS)
    for frame in {frame.path.parent: frame for frame in reversed(posed.frames)}.values():
        header = read_header(frame.path)
        if header is None:
            what = "cannot be read as an image" if frame.path.is_file() else "not found, but transforms.json names it"
            raise DataError(f"{frame.path}: {what}. Export it again.")
        if header.mode != "RGBA":
            raise DataError(
                f"{frame.path}: expected 8-bit RGBA, got {header.mode}. Cut the object out with `segment` first."
            )
    return posed


def _inside(transforms: Path, picture: Path) -> str:
    """A picture's name relative to its ``transforms.json``, which has to lie above it."""
    try:
        return picture.resolve().relative_to(transforms.parent.resolve()).as_posix()
    except ValueError:
        raise DataError(f"{transforms}: names {picture}, which lies outside of its folder. Move it there.") from None


def _views(posed: PosedImages) -> tuple[str, ...]:
    return tuple(sorted({frame.camera for frame in posed.frames}, key=natural))


def _check_alike(sequences: Mapping[str, PosedImages]) -> None:
    """Raises where two sequences have different cameras or rates."""
    rates = {name: posed.fps for name, posed in sequences.items() if posed.fps is not None}
    if len(set(rates.values())) > 1:
        raise DataError(f"sequences have different rates [frames per second]: {rates}. Ingest them with one --fps.")
    views = {name: list(_views(posed)) for name, posed in sequences.items()}
    for name, found in views.items():
        if found != (expected := next(iter(views.values()))):
            raise DataError(
                f"{sequences[name].path}: has the cameras {found}, {next(iter(views))} has {expected}. Every sequence "
                "of an object needs the same: leave this sequence out, or assemble it as an object of its own."
            )
