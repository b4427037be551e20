"""Inputs of the stage of poses: photos, frames of sequences, and poses to take over."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from data_prep.capture.cameras.sources import (
    Posed,
    from_model,
    matrix_files_of,
    photos_of_model,
    read_lens_transforms,
    read_projections,
)
from data_prep.common.command import Options, option
from data_prep.common.photos import Photo, list_images, natural, open_photo
from data_prep.common.stage import MANIFEST, read_manifest
from gausim.core.errors import ConfigError, DataError
from gausim.io.colmap import PointTable, colmap_files, find_colmap, no_points, read_colmap


@dataclass(frozen=True)
class Sources(Options):
    """Options for the inputs of the poses."""

    images: Path | None = option(None, "photos of the rest state", metavar="DIR")
    sequences: Path | None = option(
        None, "result of ingest, or folders SEQ/CAM of frames; cameras stand still through a sequence, and its first "
        "frame shows the rest state", metavar="DIR",
    )  # fmt: skip
    fps: float | None = option(None, "frames per second of the sequences (default: that of ingest)", metavar="RATE")
    colmap: Path | None = option(
        None, "COLMAP model to take over, binary or text, for --images of any size", metavar="DIR"
    )
    transforms: Path | None = option(
        None, "transforms.json to take over, also with OPENCV or OPENCV_FISHEYE distortion", metavar="FILE"
    )
    projections: Path | None = option(
        None, "3 x 4 matrices to take over, as text: NAME.txt or NAME_P.txt for NAME.jpg", metavar="DIR"
    )
    scale: float = option(1.0, "size of the photos / size the matrices are for (%(default)s)")

    def __post_init__(self) -> None:
        """Checks that they go together."""
        super().__post_init__()
        taken = [n for n in ("colmap", "transforms", "projections") if getattr(self, n) is not None]
        if len(taken) > 1:
            raise ConfigError(f"--{' and --'.join(taken)}: poses come from one of them; give one.")
        if self.images is None and self.transforms is None and (self.sequences is None or taken):
            raise ConfigError("--images: give the folder of the photos.")

    @property
    def kind(self) -> str:
        """``mapping`` or what is taken over."""
        return next((n for n in ("colmap", "transforms", "projections") if getattr(self, n) is not None), "mapping")


@dataclass(frozen=True)
class Material:
    """Photos, frames and poses found in the sources."""

    stills: tuple[Photo, ...]  # photos whose poses are to be found
    # poses that are taken over, with their points; None where they are to be found
    posed: tuple[list[Posed], PointTable] | None
    coloured: bool  # the points that are taken over have colours
    sequences: dict[Path, tuple[str, ...]]  # the folders of sequences with the names of their cameras
    fps: float | None  # frames per second of the sequences
    inputs: dict[str, Path]  # all files that are read, by the names that the manifest gives them

    @staticmethod
    def of(sources: Sources) -> Material:
        """Looks what is there.

        Raises:
            DataError: something that was named is missing or malformed.
        """
        stills: tuple[Photo, ...] = ()
        posed, inputs = _taken_over(sources)
        if sources.images is not None and posed is None:
            stills = tuple(open_photo(path, path.name) for path in list_images(sources.images))
            inputs = {f"images/{photo.name}": photo.path for photo in stills}
        folders, fps = _sequences(sources)
        for folder, cameras in folders.items():
            for camera in cameras:
                inputs.update({f"{folder.name}/{camera}/{p.name}": p for p in list_images(folder / camera)})
        return Material(stills, posed, sources.colmap is not None, folders, fps, inputs)


def _taken_over(sources: Sources) -> tuple[tuple[list[Posed], PointTable] | None, dict[str, Path]]:
    """Poses that somebody else found, and the files that say so, with their photos."""
    if sources.kind == "mapping":
        return None, {}
    points = no_points()
    if sources.colmap is not None and sources.images is not None:
        folder = find_colmap(sources.colmap)
        model = read_colmap(folder)
        posed, points = from_model(model, photos_of_model(model, sources.images)), model.points
        files = colmap_files(folder)
    elif sources.transforms is not None:
        posed, files = read_lens_transforms(sources.transforms), {"transforms": sources.transforms}
    else:
        assert sources.projections is not None and sources.images is not None
        posed = read_projections(sources.projections, sources.images, sources.scale)
        files = {f"images/{p.name}": p for p in list_images(sources.images)}
        files.update({f"projections/{p.name}": p for p in matrix_files_of(sources.projections)})
    return (posed, points), {**files, **{f"images/{shot.photo.name}": shot.photo.path for shot in posed}}


def _sequences(sources: Sources) -> tuple[dict[Path, tuple[str, ...]], float | None]:
    if sources.sequences is None:
        return {}, sources.fps
    root, fps = sources.sequences, sources.fps
    if (root / MANIFEST).is_file():
        found = read_manifest(root, "ingest")["results"].get("fps")
        fps, root = fps if fps is not None else found, root / "sequences"
    if not root.is_dir():
        raise DataError(f"{root}: no such folder. Expected one folder per sequence in it, with one per camera.")
    folders: dict[Path, tuple[str, ...]] = {}
    for folder in sorted((p for p in root.iterdir() if p.is_dir()), key=lambda p: natural(p.name)):
        cameras = sorted((p.name for p in folder.iterdir() if p.is_dir()), key=natural)
        if cameras:
            folders[folder] = tuple(cameras)
    if not folders:
        raise DataError(f"{root}: no sequences here. Expected folders like seq_000/cam_0 with frames.")
    if fps is None or not 0 < fps < 1e4:
        raise ConfigError(f"--fps: expected frames per second of the sequences, got {fps}.")
    return folders, float(fps)
