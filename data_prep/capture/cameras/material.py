"""What the stage of poses reads: photos, frames of sequences, and poses to take over."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from data_prep.common.photos import Photo, list_images, natural, open_photo
from data_prep.common.stage import MANIFEST, read_manifest
from gausim.core.errors import ConfigError, DataError


@dataclass(frozen=True)
class Sources:
    """What poses are made of.

    Attributes:
        images: folder of photos (stills of the rest state); None where there are only videos.
        sequences: the result of the stage ``ingest``, or a folder with one folder per sequence and camera in it.
        colmap: a COLMAP model to take over.
        transforms: a ``transforms.json`` to take over; its images are where it says.
        projections: a folder of projection matrices to take over.
        scale: size of the photos over the size that the projection matrices are for.
        fps: of the sequences; None where ingest says it.
    """

    images: Path | None = None
    sequences: Path | None = None
    colmap: Path | None = None
    transforms: Path | None = None
    projections: Path | None = None
    scale: float = 1.0
    fps: float | None = None

    def __post_init__(self) -> None:
        """Checks that they go together."""
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
    """Files that are read.

    Attributes:
        stills: photos whose poses are to be found.
        sequences: the folders of sequences with the names of their cameras.
        fps: frames per second of the sequences.
        inputs: all files by the names that the manifest gives them.
    """

    stills: tuple[Photo, ...]
    sequences: dict[Path, tuple[str, ...]]
    fps: float | None
    inputs: dict[str, Path]

    @staticmethod
    def of(sources: Sources) -> Material:
        """Looks what is there.

        Raises:
            DataError: something that was named is missing or malformed.
        """
        inputs, stills = _taken_over(sources), []
        if sources.images is not None and sources.kind == "mapping":
            stills = [open_photo(path, path.name) for path in list_images(sources.images)]
        inputs.update({f"images/{photo.name}": photo.path for photo in stills})
        folders, fps = _sequences(sources)
        for folder, cameras in folders.items():
            for camera in cameras:
                inputs.update({f"{folder.name}/{camera}/{p.name}": p for p in list_images(folder / camera)})
        return Material(tuple(stills), folders, fps, inputs)


def _taken_over(sources: Sources) -> dict[str, Path]:
    """Inputs of poses that are taken over, with the photos they name."""
    if sources.colmap is not None:
        from gausim.io.colmap import colmap_files, find_colmap, read_colmap

        assert sources.images is not None
        folder = find_colmap(sources.colmap)
        names = [image.name for image in read_colmap(folder).images]
        return {**colmap_files(folder), **{f"images/{name}": sources.images / name for name in names}}
    if sources.transforms is not None:
        from data_prep.capture.cameras.sources import read_lens_transforms

        posed = read_lens_transforms(sources.transforms)
        return {"transforms": sources.transforms, **{f"images/{p.photo.name}": p.photo.path for p in posed}}
    if sources.projections is not None:
        from data_prep.capture.cameras.sources import matrix_files_of

        assert sources.images is not None
        images = {f"images/{p.name}": p for p in list_images(sources.images)}
        return {**images, **{f"projections/{p.name}": p for p in matrix_files_of(sources.projections)}}
    return {}


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
