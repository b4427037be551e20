"""Check of calibration: agreement of the rest scene with frame 0 in every camera, and common misreadings of files."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import Cameras
from gausim.doctor.evidence import Evidence, Finding, listed
from gausim.doctor.silhouettes import Fit, overlap
from gausim.io.transforms import OPENGL_TO_OPENCV

# Overlap below which a silhouette misses the object, and above which a reading of the calibration fits.
_MISSED, _FITS = 0.5, 0.8
# Displacements of silhouettes that are a warning and a fault [fractions of the image's longer side].
_WORTH, _SPOILS = 0.006, 0.012
# Overlap after the best shift and rotation, below which scene and object differ in shape.
_SHAPE = 0.85
# The same, below which a free body is not in its rest shape and orientation.
_AT_REST = 0.97
# Ratios of common units of length: millimetres, centimetres and metres.
_UNITS = (0.001, 0.01, 0.1, 10.0, 100.0, 1000.0)
# Iterations of the estimate of the focal length from areas.
_ROUNDS = 4
_AXES = torch.tensor(OPENGL_TO_OPENCV, dtype=torch.float64)


def find_calibration_faults(evidence: Evidence) -> Iterator[Finding]:
    """Compares the rest scene's silhouettes with frame 0 in every camera, and tests other conventions.

    A free body is drawn where the cameras see it in frame 0; where it begins turned or bent, no more is known.
    """
    if evidence.fits is None:
        yield Finding(
            "note", "There is no rest scene yet, so poses and lenses were not compared with it.",
            f"Make one with `gausim reconstruct {evidence.data.root}` (or give --scene FILE.ply) and run this again.",
        )  # fmt: skip
        return
    fits = dict(zip(evidence.views, zip(*evidence.fits, strict=True), strict=True))
    raw = {view: float(np.median([fit.overlap for fit in row])) for view, row in fits.items()}
    if sum(value < _MISSED for value in raw.values()) > len(raw) / 2:
        yield _convention(evidence, raw)
    elif evidence.free and np.median([[fit.aligned for fit in row] for row in evidence.fits]) < _AT_REST:
        yield _turned(evidence)
    else:
        yield from _moved(evidence, fits)
        yield from _shape(fits)


def _consistent_shift(fits: Sequence[Fit]) -> float:
    """Median displacement over sequences [reduced pixels]; 0 if it differs from sequence to sequence.

    A wrong camera pose gives the same displacement in every sequence; an object that moves in frame 0 does not.
    """
    pixels = np.array([fit.pixels for fit in fits])
    if not np.isfinite(pixels).all():
        return math.inf if np.median(pixels) == math.inf else 0.0
    shifts = np.array([fit.shift for fit in fits])
    scatter = float(np.median(np.linalg.norm(shifts - np.median(shifts, axis=0), axis=1)))
    return float(np.median(pixels)) if scatter < 0.5 * np.median(pixels) else 0.0


def _moved(evidence: Evidence, fits: dict[str, tuple[Fit, ...]]) -> Iterator[Finding]:
    longer = max(evidence.first[0].alpha.shape[-2:])
    off = {view: _consistent_shift(row) for view, row in fits.items()}
    worth = [view for view, pixels in off.items() if pixels > _WORTH * longer]
    if not worth:
        return
    measured = "; ".join(_sentence(view, fits[view], evidence.scale) for view in worth)
    if 2 * len(worth) < len(off):
        what = (
            f"{listed(worth)} {'is' if len(worth) == 1 else 'are'} not where the pose says, while the others agree "
            f"with the rest scene: {measured}."
        )
        remedy = (
            f"Find the pose of {listed(worth)} again (was it moved after the calibration?), or take it out of "
            "dataset.json."
        )
    else:
        what = f"{len(worth)} of {len(off)} cameras disagree with the rest scene: {measured}."
        remedy = (
            "Calibrate all cameras together with the stills that the scene was made of (`gausim prepare poses "
            "--images STILLS --sequences FRAMES`), or make the scene again if it is of another object or world."
        )
    spoils = max(off[view] for view in worth) > _SPOILS * longer
    yield Finding("fault" if spoils else "warning", what, remedy, tuple(worth))


def _sentence(view: str, fits: Sequence[Fit], scale: float) -> str:
    pixels, degrees = (float(np.median([getattr(fit, key) for fit in fits])) for key in ("pixels", "degrees"))
    if not math.isfinite(pixels):
        return f"the rest scene is outside the picture of {view}"
    right, down = np.median([fit.shift for fit in fits], axis=0) / scale
    return (
        f"{view} is off by about {degrees:.1f} degrees or {pixels / scale:.1f} pixels (the scene lies {right:.1f} to "
        f"the right and {down:.1f} below)"
    )


def _shape(fits: dict[str, tuple[Fit, ...]]) -> Iterator[Finding]:
    aligned = {view: float(np.median([fit.aligned for fit in row])) for view, row in fits.items()}
    usual = float(np.median(list(aligned.values())))
    if usual < _SHAPE:
        yield Finding(
            "warning",
            f"Even at the best shift the rest scene's silhouettes overlap those of frame 0 by {usual:.2f} only: parts "
            "are missing in the scene, or frame 0 shows another shape.",
            "Look at views.png (--out DIR). Reconstruct the scene again, or check the masks and that sequences begin "
            "at rest.",
        )  # fmt: skip


def _convention(evidence: Evidence, raw: dict[str, float]) -> Finding:
    readings = _readings(evidence)
    best, now = readings[0], float(np.mean(list(raw.values())))
    fits = best.overlap > max(_FITS, now + 0.2)
    what = f"The silhouettes would fit ({best.overlap:.2f}) if transforms.json held {best.name}."
    remedy = f"In every sequences/*/transforms.json {best.remedy}."
    if not fits and evidence.free:
        return _turned(evidence)
    if not fits:
        what = f"No usual mistake explains it (best: {best.name}, overlap {best.overlap:.2f})."
        remedy = (
            "Check that scene and sequences are of one object and one world, and that angles are in radian; calibrate "
            "the cameras again (`gausim prepare poses`)."
        )
    return Finding(
        "fault",
        f"The cameras do not see the rest scene where frame 0 shows the object (mean overlap {now:.2f}). {what}",
        remedy,
    )  # fmt: skip


def _turned(evidence: Evidence) -> Finding:
    return Finding(
        "note", "The free body begins turned or bent, so poses and lenses were not compared with the rest scene.",
        f"Look at views.png (`gausim doctor {evidence.data.root} --out DIR`): the outline must have the body's place "
        "and size in all cameras.",
    )  # fmt: skip


@dataclass(frozen=True)
class _Reading:
    """The calibration under another convention."""

    name: str  # description of the convention
    remedy: str  # what to change
    overlap: float  # mean intersection over union of the silhouettes over the views


def _readings(evidence: Evidence) -> list[_Reading]:
    """Readings of the cameras under common conventions, sorted by their fit to the masks of frame 0, the best first."""
    cameras = evidence.first[0].cameras
    # The matrices of the file: camera to world, OpenGL axes.
    stored = torch.linalg.inv(cameras.viewmats.double()) * _AXES
    readings = []
    for name, remedy, change in _POSES:
        viewmats = torch.stack([change(pose) for pose in stored]).float()
        readings.append(_Reading(name, remedy, _fit(evidence, replace(cameras, viewmats=viewmats))))
    readings.append(_another_lens(evidence))
    return sorted(readings, key=lambda reading: -reading.overlap)


def _fit(evidence: Evidence, cameras: Cameras) -> float:
    item = evidence.first[0]
    drawn = evidence.drawn(item, cameras).alpha
    return float(np.mean([overlap(mask, alpha) for mask, alpha in zip(item.masks, drawn, strict=True)]))


def _read(pose: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    return torch.linalg.inv(pose * _AXES)


def _transposed(pose: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    turned = pose.clone()
    turned[:3, :3] = pose[:3, :3].T
    return _read(turned)


def _world(quarter: int) -> Callable[[Tensor], Tensor]:
    """Rotation of the world by ±90 degrees about x."""
    turn = torch.tensor([[1, 0, 0, 0], [0, 0, -quarter, 0], [0, quarter, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)
    return lambda pose: _read(turn @ pose)


def _unit(factor: float) -> Callable[[Tensor], Tensor]:
    scale = torch.tensor([1, 1, 1, factor], dtype=torch.float64)
    return lambda pose: _read(torch.cat((pose[:3] * scale, pose[3:])))


_POSES: list[tuple[str, str, Callable[[Tensor], Tensor]]] = [
    ("camera-to-world matrices in OpenCV axes (y down, looking along +z)",
     "negate the second and third column of every transform_matrix (OpenGL axes: y up, looking along -z)",
     torch.linalg.inv),
    ("world-to-camera matrices in OpenCV axes",
     "invert every transform_matrix (it must be camera to world), then negate its second and third column",
     lambda pose: pose),
    ("world-to-camera matrices in OpenGL axes",
     "invert every transform_matrix: it must be camera to world", lambda pose: _AXES[:, None] * pose),
    ("poses whose rotations are transposed",
     "transpose the upper left 3 x 3 part of every transform_matrix", _transposed),
    ("poses of a world whose up is y, while the scene's up is z",
     "turn every transform_matrix by +90 degrees about x (x, y, z to x, -z, y), or the scene the other way", _world(1)),
    ("poses of a world whose up is z, while the scene's up is y",
     "turn every transform_matrix by -90 degrees about x (x, y, z to x, z, -y), or the scene the other way",
     _world(-1)),
    *((f"positions of cameras in another unit than the scene's (times {factor:g})",
       f"multiply the last column of every transform_matrix by {factor:g}", _unit(factor)) for factor in _UNITS),
]  # fmt: skip


def _another_lens(evidence: Evidence) -> _Reading:
    """The same poses with the focal length at which silhouettes have the right size."""
    item = evidence.first[0]
    masks, cameras = item.masks, item.cameras
    lenses = cameras.Ks.clone()
    for _ in range(_ROUNDS):
        drawn = evidence.drawn(item, replace(cameras, Ks=lenses)).alpha
        seen = [v for v in range(len(masks)) if drawn[v].sum() > 0 and masks[v].sum() > 0]
        if not seen:
            break
        ratio = math.sqrt(float(np.median([masks[v].sum() / drawn[v].sum() for v in seen])))
        lenses[:, [0, 1], [0, 1]] *= ratio
    factor = float((lenses[:, 0, 0] / cameras.Ks[:, 0, 0]).median())
    field = math.degrees(2 * math.atan(cameras.width / (2 * float(lenses[:, 0, 0].median()))))
    name = f"a focal length {factor:.3g} times the stated one, which makes a field of view of {field:.3g} degrees"
    remedy = (
        f"multiply fl_x and fl_y by {factor:.3g} (they may have been made from an angle in degrees where radians were "
        "expected, or for pictures of another size; then cx and cy are wrong too)"
    )
    return _Reading(name, remedy, _fit(evidence, replace(cameras, Ks=lenses)))
