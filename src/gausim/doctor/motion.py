"""Checks of motion: its size, its frequency relative to the frame rate, and its start at rest."""

from collections.abc import Iterator

import cv2
import numpy as np

from gausim.doctor.evidence import Evidence, Finding, Watched, listed, same_cameras
from gausim.doctor.silhouettes import overlap
from gausim.metrics.oscillation import coordinates, principal_motions, spectrum

# Frames per view whose optical flow against frame 0 is computed, and the percentile over the foreground.
_FLOW_FRAMES, _QUANTILE = 6, 95
# Displacement below which an object counts as static, and below which noise and mask edges hide motion [pixels].
_STILL, _SMALL = 0.2, 1.0
# Overlap of frame 0 with that of the other sequences or the rest scene, below which it is not at rest.
_AT_REST, _FAR_FROM_REST = 0.95, 0.85
# Length of the longer side of images for the spectrum [pixels], and number of principal motions.
_SPECTRUM_LONGEST, _MOTIONS = 48, 3
# Frequencies above which motion is resolved badly, or not at all [of the frame rate; 0.5 is Nyquist's limit].
_FAST, _TOO_FAST = 0.2, 0.34
# Number of cycles within the examined frames below which their frequency is undetermined.
_CYCLES = 2.0
# Range of frequencies of elastic objects on a table [Hz].
_SLOWEST, _FASTEST = 0.3, 15.0
# Rates of cameras and common fractions of them [frames per second].
_USUAL_RATES = (
    10, 12, 12.5, 15, 20, 24, 25, 30, 48, 50, 60, 75, 90, 100, 120, 144, 150, 180, 200, 240, 300, 400, 480, 500, 600,
    960, 1000,
)  # fmt: skip
# Relative tolerance, which includes NTSC's rates (a thousandth lower).
_RATE_TOLERANCE = 2e-3


def find_odd_motion(evidence: Evidence) -> Iterator[Finding]:
    """Finds motion that is too small to be seen, or too fast or slow for the frame rate."""
    moving = {item.name: _displacements(item, evidence.scale) for item in evidence.watched}
    largest = {name: float(d.max()) for name, d in moving.items()}
    if max(largest.values()) < _STILL:
        yield Finding(
            "fault",
            f"Nothing moves: no part of the object leaves its place by more than {max(largest.values()):.2f} pixels in "
            f"any of {len(moving)} sequences.",
            "Record sequences in which the object is set off, or check that the frames are not one picture repeated.",
        )  # fmt: skip
        return
    still = [name for name, pixels in largest.items() if pixels < _STILL]
    if still:
        yield Finding(
            "warning", f"Nothing moves in {listed(still)}.",
            "Leave these sequences out; they teach nothing.",
        )  # fmt: skip
    typical = float(np.median([p for p in largest.values() if p >= _STILL]))
    if typical < _SMALL:
        yield Finding(
            "warning",
            f"The motion is smaller than a pixel (at most {typical:.2f} pixels): noise and the edges of the masks are "
            "as large.",
            "Push harder, film from nearer, or at a higher resolution.",
        )  # fmt: skip
    for v, view in enumerate(evidence.views):
        here = max(float(d[:, v].max()) for d in moving.values())
        if here < _STILL and len(evidence.views) > 1:
            yield Finding(
                "fault",
                f"{view} shows no motion (at most {here:.2f} pixels), while others show {typical:.1f}: it may be one "
                "picture repeated.", f"Export the frames of {view} again, or take it out of dataset.json.",
            )  # fmt: skip
    yield from _rates(evidence)


def _displacements(item: Watched, scale: float) -> np.ndarray:
    """95th percentile over the foreground of the optical flow of some frames against frame 0, (f, V) [pixels]."""
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow.setFinestScale(0)
    gray = (item.gray * 255 + 0.5).astype(np.uint8)
    chosen = np.unique(np.linspace(0, len(gray) - 1, _FLOW_FRAMES + 1).round().astype(int))
    found = np.zeros((len(chosen), gray.shape[1]))
    for i, v in np.ndindex(len(chosen), gray.shape[1]):
        shown = item.alpha[0, v] > 127
        if shown.any() and (gray[chosen[i], v] != gray[0, v]).any():
            moved = flow.calc(gray[0, v], gray[chosen[i], v], None)  # type: ignore[call-overload]
            found[i, v] = np.percentile(np.linalg.norm(moved[shown], axis=-1), _QUANTILE) / scale
    return found


def find_unrest(evidence: Evidence) -> Iterator[Finding]:
    """Finds sequences whose frame 0 is not the rest state; a free body may begin elsewhere."""
    if evidence.free:
        return
    overlaps = _first_overlaps(evidence)
    off = {name: value for name, value in overlaps.items() if value < _AT_REST}
    if not off:
        return
    worst = min(off.values())
    against = "those of the other sequences" if evidence.fits is None else "the rest scene and other sequences"
    yield Finding(
        "fault" if worst < _FAR_FROM_REST else "warning",
        f"Frame 0 is not at rest in {listed(list(off))}: its silhouettes overlap {against} by {worst:.2f} only. A "
        "prediction starts from the rest scene, so it would begin at the wrong place.",
        "Begin each sequence at the last frame before the object is set off, or leave the sequence out.",
    )  # fmt: skip


def _first_overlaps(evidence: Evidence) -> dict[str, float]:
    """Overlap of frame 0 of each sequence with the median over sequences of the same cameras and with the scene.

    It is the smaller of the two medians over cameras. The overlap with the scene is relative to the best sequence, so
    that a coarse scene or a displaced camera is no fault of a sequence.
    """
    cameras = evidence.first[0].cameras
    alike = [item for item in evidence.first if same_cameras(item.cameras, cameras)]
    usual = np.median([item.alpha[0] for item in alike], axis=0).astype(np.float32) / 255
    aligned = [float(np.median([fit.aligned for fit in row])) for row in evidence.fits or ()]
    best, found = max(aligned, default=0.0), {}
    for s, item in enumerate(evidence.first):
        values = [1.0]
        if item in alike:
            values.append(float(np.median([overlap(a, b) for a, b in zip(item.masks, usual, strict=True)])))
        if best > _AT_REST / 2:  # a smaller one is due to the calibration
            values.append(aligned[s] / best)
        found[item.name] = min(values)
    return found


def swing(evidence: Evidence) -> tuple[float, float]:
    """Frequency of the largest change of the images over all views [Hz], and its cycles within the examined frames.

    Images stand for displacements: their largest change is a fixed pattern times a coordinate that oscillates with the
    object, while the displacement is smaller than the object's width. More than one cycle is needed.
    """
    motions = [_pattern(item) for item in evidence.watched if len(item.gray) > 3]
    if not motions:
        return 0.0, 0.0
    shapes, _ = principal_motions(motions, _MOTIONS)
    series = [coordinates(motion, shapes) for motion in motions]
    frequency, power = spectrum(series, evidence.data.fps)
    dominant = float(frequency[1:][power[1:].argmax()])  # without the constant part
    return dominant, dominant * min(len(s) for s in series) / evidence.data.fps


def _pattern(item: Watched) -> np.ndarray:
    """Difference of blurred images of all views from frame 0, (F, P, 3)."""
    frames, views, height, width = item.alpha.shape
    factor = min(1.0, _SPECTRUM_LONGEST / max(height, width))
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    small = np.stack(
        [[cv2.resize(item.rgb[f, v], size, interpolation=cv2.INTER_AREA) for v in range(views)] for f in range(frames)]
    ).astype(np.float32)
    return (small - small[:1]).reshape(frames, -1, 3)


def _rates(evidence: Evidence) -> Iterator[Finding]:
    fps, (dominant, cycles) = evidence.data.fps, swing(evidence)
    swings, pace = cycles >= _CYCLES, dominant / fps  # cycles per frame
    rate = f"The object swings at about {dominant:.2g} Hz at {fps:g} frames per second"
    if swings and pace > _FAST:
        yield Finding(
            "fault" if pace > _TOO_FAST else "warning",
            f"{rate}, once in {1 / pace:.1f} frames: that is too fast for steps of a frame.",
            "Film at a higher rate (five frames per swing or more), or keep every frame of the film.",
        )  # fmt: skip
    usual = any(abs(fps / known - 1) < _RATE_TOLERANCE for known in _USUAL_RATES)
    plausible = not swings or _SLOWEST <= dominant <= _FASTEST
    if not (usual and plausible):
        reason = f"{fps:g} frames per second is no usual rate of a camera. " if not usual else ""
        yield Finding(
            "warning",
            f"{reason}{f'{rate}. ' if swings else ''}Field 'fps' of dataset.json may be wrong. Velocities, stiffness "
            "and damping scale with it.",
            "Set 'fps' in dataset.json and every sequences/*/transforms.json to the rate of the frames that are there "
            "(a film of 120 of which every fifth frame was kept has 24).",
        )  # fmt: skip
    elif swings:
        yield Finding(
            "note", f"{rate}.",
            "None is needed. If it swings faster or slower by the eye, 'fps' of dataset.json is wrong.",
        )  # fmt: skip
