"""Brings an object of Spring-Gaus' data to our layout: a synthetic fall or a real capture.

Synthetic: ROOT is data/mpm_synthetic/render/OBJECT (camera.json, camera_0/000.png …). The world is y up, with gravity
and a floor at y = 0.3; frames 0 to 19 are trained on. There are no stills: frame 0 of the cameras takes their place.

Real: ROOT is data/real_capture, and --object names one of dynamic/sequences. Its stills (static/) and films (dynamic/)
have worlds of their own. The similarity between them is found by silhouettes: the visual hull of the stills is turned,
moved and scaled until it covers the masks of the first sequence's first frame. What is reached is told; below
--least-overlap the command stops.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from data_prep.capture.cameras.sources import fitted
from data_prep.capture.masks.clips import read_picture
from data_prep.common.command import option
from data_prep.common.photos import list_images, natural, open_photo
from data_prep.common.progress import Tick
from data_prep.public.fields import check_name, field, inside, lens, numbered, numbers, rate_of, read_list, viewmat
from data_prep.public.importing import Importer, ImportOptions, rate_option
from data_prep.public.pictures import brightness, masked, read_sized, resized, size_of, straight, with_alpha
from data_prep.public.registration import register
from data_prep.public.scene import GRAVITY, Motion, Picture, PublicObject, View, floor
from gausim.core.errors import ConfigError, DataError
from gausim.io.colmap import ColmapModel, colmap_files, read_colmap
from gausim.io.plain_json import read_any_json

CAMERAS, CALIBRATION = "camera.json", "dynamic/cameras_calib.json"
# Their renderer's world: frames every 0.03 s, a floor at this height, the first 20 of 30 frames seen.
SYNTHETIC_FPS, SYNTHETIC_FLOOR, SYNTHETIC_SEEN = 1 / 0.03, 0.3, 20
# Their cameras film 120 frames per second; the first 70 % are trained on unless told otherwise.
REAL_FPS, REAL_SHARE = 120.0, 0.7
SUFFIXES = (".JPG", ".jpg", ".jpeg", ".png", ".PNG")


@dataclass(frozen=True)
class SpringGausOptions(ImportOptions):
    """Facts that the folders do not contain."""

    fps: float | None = rate_option("synthetic: frame.json, or 33.3; real: 120")
    object: str | None = option(None, "of a real capture: name of the object (folder of dynamic/sequences)")
    real_floor: float = option(
        -0.02, "of a real capture: the table's z [scene units] (%(default)s)", least=-1e3, most=1e3
    )
    real_gravity: float = option(
        GRAVITY, "of a real capture: along +z [scene units/s^2] (%(default)s)", least=0, most=1e6
    )
    no_stills: bool = option(False, "of a real capture: leave the stills out, and with them the registration")
    least_overlap: float = option(
        0.8, "of a real capture: refuse a registration whose silhouettes overlap less (%(default)s)", least=0, most=1
    )
    turns: int = option(
        600, "of a real capture: rotations to begin the registration from (%(default)s)", least=1, most=100_000
    )


def read_springgaus(root: Path, options: SpringGausOptions) -> list[PublicObject]:
    """One synthetic object or one real capture.

    Raises:
        DataError: a file is missing or malformed.
        ConfigError: an option does not suit the folder.
    """
    if (root / CAMERAS).is_file():
        if options.object is not None:
            raise ConfigError(f"--object: {root} is one synthetic object ({CAMERAS}); leave the option out.")
        return [read_synthetic(root, options)]
    if not (root / CALIBRATION).is_file():
        raise DataError(
            f"{root}: neither {CAMERAS} (a synthetic object) nor {CALIBRATION} (real captures) is here. Give the "
            "folder data/mpm_synthetic/render/OBJECT, or data/real_capture."
        )
    return [read_real(root, options)]


def read_synthetic(root: Path, options: SpringGausOptions) -> PublicObject:
    """One synthetic object.

    Raises:
        DataError: ``camera.json``, ``frame.json`` or a folder of frames is missing or malformed.
    """
    path = root / CAMERAS
    views, pictures = [], {}
    for i, entry in enumerate(read_list(path, "cameras")):
        where = f"{path}: [{i}]"
        name = check_name(field(entry, "camera", str, where), f"{where}: field 'camera'")
        if name in pictures:
            raise DataError(f"{where}: field 'camera' '{name}' stands twice.")
        frames = _frames(root / name)
        size = size_of(frames[0])
        k = lens(field(entry, "K", list, where), f"{where}: field 'K'")
        pose = viewmat(field(entry, "c2w", list, where), f"{where}: field 'c2w'", opengl=True, inverse=True)
        views.append(View(name, size, k, pose))
        pictures[name] = tuple(Picture((p,), partial(with_alpha, p, size)) for p in frames)
    count = min(len(row) for row in pictures.values())
    times = root / "frame.json"
    files = {CAMERAS: path, **({times.name: times} if times.is_file() else {})}
    return PublicObject(
        root, options.name or root.absolute().name,
        options.fps or (_rate(times, count) if times.is_file() else SYNTHETIC_FPS),
        options.train_frames or min(SYNTHETIC_SEEN, count),
        (Motion("seq_000", root, tuple(views), pictures),), options.heldout,
        {"gravity": [0.0, -GRAVITY, 0.0], "floor": floor((0.0, SYNTHETIC_FLOOR, 0.0), (0.0, 1.0, 0.0)), "free": True},
        files=files,
    )  # fmt: skip


def _frames(folder: Path) -> tuple[Path, ...]:
    """The frames 000.png, 001.png … of a folder."""
    paths: dict[int, Path] = {}
    for path in list_images(folder):
        if not path.stem.isdecimal() or not path.stem.isascii() or len(path.stem) > 9 or int(path.stem) in paths:
            raise DataError(f"{path}: expected frames 000.png, 001.png … once each. Take this file out of the folder.")
        paths[int(path.stem)] = path
    return numbered(paths, str(folder))


def _rate(path: Path, count: int) -> float:
    """Frames per second by the times of ``frame.json``: a list of objects whose first value is the time [s]."""
    entries = field({"frames": read_any_json(path)}, "frames", list[dict[str, float]], str(path))
    if len(entries) != count or not all(entries):
        raise DataError(
            f"{path}: has times of {len(entries)} frames, the folders have {count}. Restore what is missing."
        )
    return rate_of([next(iter(entry.values())) for entry in entries], str(path))


def read_real(root: Path, options: SpringGausOptions) -> PublicObject:
    """One real capture; its stills stand in their own world yet.

    Raises:
        DataError: a file is missing or malformed.
        ConfigError: there is no such object.
    """
    folder = root / "dynamic" / "sequences"
    known = sorted(p.name for p in folder.iterdir() if p.is_dir()) if folder.is_dir() else []
    name = options.object
    if name not in known:
        raise ConfigError(f"--object {name or '(not given)'}: expected one of {known} in {folder}.")
    assert name is not None
    model = read_colmap(root / "static" / "colmap" / name)
    lists = sorted((folder / name).glob("*.json"), key=lambda p: natural(p.name))
    if not lists:
        raise DataError(f"{folder / name}: no sequence here, expected files like 0.json.")
    poses = _calibration(root / CALIBRATION)
    motions = tuple(_real_motion(root, path, poses, model) for path in lists)
    shortest = min(motion.count for motion in motions)
    world = {"gravity": [0.0, 0.0, options.real_gravity], "free": True,
             "floor": floor((0.0, 0.0, options.real_floor), (0.0, 0.0, -1.0))}  # fmt: skip
    files = {CALIBRATION: root / CALIBRATION, **{p.relative_to(root).as_posix(): p for p in lists},
             **{f"static/{role}": p for role, p in colmap_files(model.path).items()}}  # fmt: skip
    return PublicObject(
        root, options.name or name, options.fps or REAL_FPS,
        options.train_frames or max(2, int(REAL_SHARE * shortest)), motions, options.heldout, world,
        () if options.no_stills else _stills(root, name, model), files=files,
    )  # fmt: skip


def _calibration(path: Path) -> dict[str, np.ndarray]:
    """World to camera of every camera."""
    data, poses = read_any_json(path), {}
    if not isinstance(data, dict) or not data:
        raise DataError(f"{path}: expected an object of cameras with 'rvecs' and 'tvecs', got {str(data)[:60]}.")
    for camera, entry in data.items():
        where = f"{path}: {check_name(camera, str(path))}"
        turn, shift = (numbers(_flat(field(entry, key, list, where)), (3,), f"{where}: field '{key}'")
                       for key in ("rvecs", "tvecs"))  # fmt: skip
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
        poses[camera] = pose
    return poses


def _flat(values: list) -> list:
    """Three numbers, as OpenCV also writes them: [[x], [y], [z]]."""
    return [v[0] if isinstance(v, list) and len(v) == 1 else v for v in values]


def _real_motion(root: Path, path: Path, poses: Mapping[str, np.ndarray], model: ColmapModel) -> Motion:
    data = read_any_json(path)
    field(data, "hit_frame", int, str(path))
    unknown = sorted(set(data) - set(poses) - {"hit_frame"})
    missing = sorted(set(poses) - set(data))
    if unknown or missing:
        raise DataError(
            f"{path}: fields {unknown or missing} {'are' if unknown else 'of'} cameras "
            f"{'that cameras_calib.json does not know' if unknown else 'are missing'}; it knows {sorted(poses)}."
        )
    views, pictures = [], {}
    for camera, pose in poses.items():
        where = f"{path}: field '{camera}'"
        row = [_filmed(root, camera, name, where) for name in field(data, camera, list[str], str(path))]
        absent = next((p for pair in row for p in pair if not p.is_file()), None)
        if not row or absent is not None:
            raise DataError(f"{where}: names {f'a frame without {absent}' if row else 'no frame'}. Restore it.")
        size = size_of(row[0][0])
        views.append(View(camera, size, _film_lens(model, size), pose))
        pictures[camera] = tuple(Picture(pair, partial(masked, *pair, size)) for pair in row)
    name = check_name(path.stem, str(path))
    return Motion(f"seq_{int(name):03d}" if name.isdecimal() else name, path, tuple(views), pictures)


def _filmed(root: Path, camera: str, name: str, where: str) -> tuple[Path, Path]:
    """A frame and its mask."""
    picture = inside(root / "dynamic" / "videos_images" / camera, name, where)
    return picture, inside(root / "dynamic" / "videos_masks" / camera, name, where).with_suffix(".png")


def _film_lens(model: ColmapModel, size: tuple[int, int]) -> np.ndarray:
    """K of the films: the focal lengths of the stills' camera, scaled, and the middle of the picture."""
    camera = model.cameras[model.images[0].camera]
    fx, fy, *_ = camera.intrinsics
    return np.array([[fx * size[0] / camera.width, 0, size[0] / 2], [0, fy * size[1] / camera.height, size[1] / 2],
                     [0, 0, 1.0]])  # fmt: skip


def _stills(root: Path, name: str, model: ColmapModel) -> tuple[tuple[View, Picture], ...]:
    """Posed stills at the size of their masks, in the order of their names."""
    shots = []
    for image in model.images:
        camera = model.cameras[image.camera]
        if camera.distorted:
            raise DataError(
                f"{model.path}: camera {image.camera} is a {camera.model} with distortion, expected PINHOLE."
            )
        stem = Path(image.name).stem
        mask = root / "static" / "masks" / name / f"{stem}.png"
        photo = _photo(root / "static" / "images" / name, image.name)
        size = size_of(mask)
        try:
            fx, fy, cx, cy = fitted(camera, open_photo(mask, mask.name)).intrinsics
        except DataError as error:
            raise DataError(f"{colmap_files(model.path)['cameras']}: camera {image.camera}: {error}") from error
        k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        view = View(check_name(stem, f"{model.path}: image '{image.name}'"), size, k, image.viewmat)
        shots.append((view, Picture((photo, mask), partial(_still, photo, mask, size))))
    return tuple(shots)


def _photo(folder: Path, name: str) -> Path:
    stem = Path(name).stem
    found = [p for p in (folder / name, *(folder / f"{stem}{end}" for end in SUFFIXES)) if p.is_file()]
    if not found:
        raise DataError(f"{folder / name}: no such photo, though the COLMAP model has it. Restore it.")
    return found[0]


def _still(photo: Path, mask: Path, size: tuple[int, int]) -> np.ndarray:
    """A photo, reduced to its mask's size as the authors do, with the mask as alpha."""
    rgb = resized(read_picture(photo), size)[..., :3]
    return straight(rgb, brightness(read_sized(mask, size, f"the mask of {photo.name}")))


def _registered(found: PublicObject, options: SpringGausOptions, tick: Tick) -> PublicObject:
    """The same object with its stills, where it has some, in the world of the films.

    Raises:
        DataError: the silhouettes overlap too little.
    """
    if not found.stills:
        return found
    first = [(view, motion.pictures[view.name][0]) for motion in found.motions[:1] for view in motion.views]
    fit = register(found.stills, first, turns=options.turns, tick=tick)
    views = ", ".join(f"{name} {value:.3f}" for name, value in fit.by_view.items())
    if fit.overlap < options.least_overlap:
        raise DataError(
            f"{found.root}: the stills' silhouettes overlap those of {found.motions[0].name}'s first frame by "
            f"{fit.overlap:.3f} ({views}), expected at least --least-overlap {options.least_overlap:g}. "
            "Check static/masks and dynamic/videos_masks, try more --turns, or leave the stills out (--no-stills): "
            "frame 0 of the cameras takes their place."
        )
    stills = tuple((replace(view, viewmat=fit.move.viewmat(view.viewmat)), picture) for view, picture in found.stills)
    reached = f"overlap of silhouettes {fit.overlap:.3f} ({views}), agreement of colours {fit.colour:.2f}"
    notes = {"registered": f"{reached}, scale {fit.move.scale:.4g}"}
    if fit.ambiguous:
        notes["look at"] = "another turn of the object fits as well: compare the stills with frame 0"
    return replace(found, stills=stills, told={"registration": fit.told(), "notes": notes})


# The number rises when the same inputs and settings give another result than before.
import_springgaus = Importer(
    "import_springgaus", 1, SpringGausOptions, read_springgaus,
    "data/mpm_synthetic/render/OBJECT, or data/real_capture", __doc__, _registered,
)  # fmt: skip
main = import_springgaus.main
