"""Poses from photos by COLMAP's structure from motion (pycolmap, on the CPU), in steps that can be interrupted.

Features are written to the database photo by photo, matches a few pairs at a time, and the mapping itself takes a small
part of the time. With one thread and one seed the same photos give the same poses.
"""

from __future__ import annotations

import itertools
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from data_prep.common.colmap import PARAMETERS
from data_prep.common.command import Options, option
from data_prep.common.photos import Photo, reduced
from data_prep.common.progress import Tick
from gausim.core.errors import ConfigError, DataError
from gausim.io.files import write_durably

SEED = 0
# Folder of what only an interrupted run needs.
SCRATCH = "mapping"
# Matched between two commits of the database; an interruption loses no more.
PAIRS_AT_ONCE = 32
# COLMAP's guess of a focal length nobody knows, times the longer side.
_FOCAL_GUESS = 1.2
# Models of fewer images than this are accidents.
_SMALLEST_MODEL = 3
# Threshold of weak features in a thorough search, as a fraction of COLMAP's.
_WEAKER = 0.5


@dataclass(frozen=True)
class MappingOptions(Options):
    """Settings of the search for poses."""

    camera_model: str = option(
        "SIMPLE_RADIAL", "use this camera model of COLMAP: SIMPLE_RADIAL, OPENCV, OPENCV_FISHEYE ... (%(default)s)"
    )
    intrinsics: str = option(
        "shared", "assume one lens for all photos of a camera, or one per image where it zooms (%(default)s)",
        choices=("shared", "per-image"),
    )  # fmt: skip
    focal: float | None = option(
        None, "state the focal length (default: EXIF, else a guess)", least=1e-6, most=1e6, metavar="PIXELS"
    )
    matching: str = option(
        "exhaustive",
        "match every pair, or each photo with the next ones (%(default)s)",
        choices=("exhaustive", "sequential"),
    )
    overlap: int = option(
        10, "match with so many next photos, in sequential matching (%(default)s)", least=1, metavar="N"
    )
    features: int = option(4096, "take at most so many per photo (%(default)s)", least=1, metavar="N")
    feature_size: int = option(1600, "detect them at this longer side (%(default)s)", least=64, metavar="PIXELS")
    # Affine features over several sizes, weaker ones too, and a second search for matches.
    thorough: bool = option(False, "detect more, in far longer time, for few photos from places far apart")
    threads: int = option(
        1, "use so many threads; several are repeatable up to rounding only (%(default)s)", least=1, metavar="N"
    )

    def __post_init__(self) -> None:
        """Checks names and numbers."""
        super().__post_init__()
        if self.camera_model not in PARAMETERS:
            raise ConfigError(f"--camera-model '{self.camera_model}': expected one of {', '.join(PARAMETERS)}.")


def map_photos(
    photos: Sequence[Photo], cameras: Mapping[str, str], work: Path, options: MappingOptions, tick: Tick
) -> tuple[Path, list[int]]:
    """Finds the poses of photos.

    Returns:
        Folder of the COLMAP model with most images, in the photos' names; numbers of images of the models that could
        not be joined with that one.
    """
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    if len(photos) < _SMALLEST_MODEL:
        raise DataError(f"{len(photos)} photos: expected at least {_SMALLEST_MODEL}; the paper takes 200.")
    database = work / SCRATCH / "database.db"
    database.parent.mkdir(parents=True, exist_ok=True)
    _find_features(database, photos, cameras, options, tick)
    _match(database, photos, work, options, tick)
    folder = work / "colmap" / "sparse" / "0"
    sizes = _mapped(database, photos, folder, options, tick)
    return folder, sizes[1:]


def _find_features(
    path: Path, photos: Sequence[Photo], cameras: Mapping[str, str], options: MappingOptions, tick: Tick
) -> None:
    """Writes cameras, photos (named by their number) and their features to COLMAP's database, unless they are there."""
    known: dict[tuple, int] = {}
    with pycolmap.Database.open(path) as database:
        there = {image.name: image.image_id for image in database.read_all_images()}
        for i, photo in enumerate(photos):
            focal = options.focal or photo.focal
            key = (cameras[photo.name], photo.width, photo.height, focal, i if options.intrinsics == "per-image" else 0)
            number = known.setdefault(key, len(known) + 1)
            if not database.exists_camera(number):
                guess = focal or _FOCAL_GUESS * max(photo.width, photo.height)
                camera = pycolmap.Camera.create_from_model_name(
                    number, options.camera_model, guess, photo.width, photo.height
                )
                camera.has_prior_focal_length = focal is not None
                database.write_camera(camera, use_camera_id=True)
            image = there.get(_number_name(i))
            if image is None:
                image = database.write_image(pycolmap.Image(name=_number_name(i), camera_id=number))
            if not database.exists_descriptors(image):
                keypoints, descriptors = _features(photo, options)
                if not database.exists_keypoints(image):
                    database.write_keypoints(image, keypoints)
                database.write_descriptors(image, descriptors)
            tick("features", i + 1, len(photos))


def _features(photo: Photo, options: MappingOptions) -> tuple[np.ndarray, pycolmap.FeatureDescriptors]:
    """Keypoints (n, 4) [pixels] and descriptors of a photo."""
    gray = reduced(cv2.cvtColor(photo.read(), cv2.COLOR_RGBA2GRAY), options.feature_size)
    settings = pycolmap.FeatureExtractionOptions()
    settings.num_threads, settings.use_gpu, settings.max_image_size = options.threads, False, max(gray.shape)
    settings.sift.max_num_features = options.features
    if options.thorough:
        settings.sift.estimate_affine_shape = settings.sift.domain_size_pooling = True
        settings.sift.peak_threshold *= _WEAKER
    extractor = pycolmap.FeatureExtractor.create(settings, pycolmap.Device.cpu)
    found, descriptors = extractor.extract_from_uint8_array(np.ascontiguousarray(gray))
    keypoints = np.array(pycolmap.keypoints_to_matrix(found), np.float32).reshape(-1, 4)
    keypoints[:, :2] *= np.array([photo.width / gray.shape[1], photo.height / gray.shape[0]], np.float32)
    return keypoints, descriptors


def _number_name(number: int) -> str:
    # COLMAP's list of pairs splits at spaces, which names of photos may have.
    return f"{number:06d}"


def _pairs(count: int, options: MappingOptions) -> Iterator[tuple[int, int]]:
    for i, j in itertools.combinations(range(count), 2):
        # The last and the first are neighbours too: people walk around the object.
        if options.matching == "exhaustive" or min(j - i, count - (j - i)) <= options.overlap:
            yield i, j


def _match(database: Path, photos: Sequence[Photo], work: Path, options: MappingOptions, tick: Tick) -> None:
    matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.num_threads, matching.use_gpu = options.threads, False
    verification.ransac.random_seed = SEED
    matching.guided_matching = options.thorough
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = work / SCRATCH / "pairs.txt"
    pairs = list(_pairs(len(photos), options))
    with pycolmap.Database.open(database) as file:
        number = {image.name: image.image_id for image in file.read_all_images()}
        ids = [number[_number_name(i)] for i in range(len(photos))]
        left = [(i, j) for i, j in pairs if not file.exists_two_view_geometry(ids[i], ids[j])]
    tick("pairs", len(pairs) - len(left), len(pairs))
    for start in range(0, len(left), PAIRS_AT_ONCE):
        part = left[start : start + PAIRS_AT_ONCE]
        text = "".join(f"{_number_name(i)} {_number_name(j)}\n" for i, j in part)
        write_durably(pairing.match_list_path, text.encode())
        pycolmap.set_random_seed(SEED)
        pycolmap.match_image_pairs(database, matching, pairing, verification, pycolmap.Device.cpu)
        tick("pairs", len(pairs) - len(left) + start + len(part), len(pairs))


def _mapped(database: Path, photos: Sequence[Photo], folder: Path, options: MappingOptions, tick: Tick) -> list[int]:
    """Runs the incremental mapping, writes the largest model, and returns the sizes of all, largest first."""
    settings = pycolmap.IncrementalPipelineOptions()
    settings.num_threads, settings.random_seed = options.threads, SEED
    settings.mapper.num_threads, settings.mapper.random_seed = options.threads, SEED
    settings.triangulation.random_seed = SEED
    settings.extract_colors, settings.min_model_size = False, _SMALLEST_MODEL
    numbers = itertools.count(1)

    def told() -> None:
        tick("mapping", min(next(numbers), len(photos)), len(photos))

    models = database.parent / "models"
    shutil.rmtree(models, ignore_errors=True)
    models.mkdir()
    pycolmap.set_random_seed(SEED)
    found = pycolmap.incremental_mapping(database, database.parent, models, settings, next_image_callback=told)
    ranked = sorted(found.values(), key=lambda model: -model.num_reg_images())
    if not ranked:
        raise DataError(
            f"{photos[0].path.parent}: COLMAP found no two photos that fit together. Take them with more overlap "
            "(each part of the object in at least three), in even light, sharp, of a scene with texture (a printed "
            "cloth under the object helps), and none twice from the same place."
        )
    for image in ranked[0].images.values():
        image.name = photos[int(image.name)].name
    tick("mapping", len(photos), len(photos))
    fresh = folder.with_name(f".{folder.name}.tmp")
    shutil.rmtree(fresh, ignore_errors=True)
    fresh.mkdir(parents=True)
    ranked[0].write_binary(fresh)
    shutil.rmtree(folder, ignore_errors=True)
    os.replace(fresh, folder)
    return [model.num_reg_images() for model in ranked]
