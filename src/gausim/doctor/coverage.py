"""Checks of coverage: pins, number of frames and sequences, framing and directions of the cameras."""

import math
from collections.abc import Iterator

import numpy as np

from gausim.core import SceneError
from gausim.core.outliers import outliers
from gausim.doctor.evidence import Evidence, Finding, listed
from gausim.ops.selection import require_pinned
from gausim.ops.visual_hull import search_cube

# Angle between views below which depth is uncertain, and below which it is almost unobserved [degrees].
_NARROW, _SAME = 25.0, 10.0
# Fraction of the frames in which an object may touch the border.
_OFTEN = 0.2
# An object is tiny below this fraction of the picture's longer side, or this many of its pixels.
_TINY_FRACTION, _TINY_PIXELS = 0.12, 24

# The paper's number of seen frames.
_SEEN = 16
# Smallest number of sequences with enough directions of motion.
_SEQUENCES = 4
# Fraction of pinned kernels above which little of a scene can move.
_MOSTLY_PINNED = 0.9


def view_directions(evidence: Evidence) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors from the cameras to the object, (V, 3), and its position (3,) [scene units]."""
    cameras = evidence.first[0].cameras
    if evidence.scene is not None:
        middle = evidence.scene.means[evidence.scene.foreground].mean(0)
    else:
        middle, _ = search_cube(cameras.viewmats, cameras.Ks, (cameras.width, cameras.height))
    away = (middle - cameras.centers).numpy()
    return away / np.linalg.norm(away, axis=1, keepdims=True).clip(1e-9), middle.numpy()


def seen_angle(directions: np.ndarray) -> float:
    """Angle between two views [degrees] that observe depth as well as these; opposite views count as equal.

    The sum of I - d d^T over unit directions d measures how well motion along each axis is observed; its smallest
    eigenvalue for two views at angle a is 1 - |cos a|.
    """
    across = np.mean(np.eye(3) - directions[:, :, None] * directions[:, None, :], axis=0)
    least = float(np.linalg.eigvalsh(across)[0])
    return math.degrees(math.acos(min(1.0, max(0.0, 1 - 2 * least))))


def find_like_directions(evidence: Evidence) -> Iterator[Finding]:
    """Finds training views along nearly one line."""
    names = list(evidence.data.train_views)
    directions = view_directions(evidence)[0][[evidence.views.index(name) for name in names]]
    angle = seen_angle(directions)
    if len(names) == 1:
        yield Finding(
            "fault",
            f"There is one training view only ({names[0]}): motion towards it and away from it is not seen.",
            "Film with at least two cameras, better four, 40 degrees or more apart.",
        )  # fmt: skip
    elif angle < _NARROW:
        yield Finding(
            "fault" if angle < _SAME else "warning",
            f"The training views {listed(names)} look along nearly the same line ({angle:.0f} degrees): depth is "
            "hardly seen.",
            "Move a camera to the side, so that at least two look at the object 40 to 140 degrees apart.",
        )  # fmt: skip


def find_cut_off(evidence: Evidence) -> Iterator[Finding]:
    """Finds objects cut off at the border of an image."""
    for v, view in enumerate(evidence.views):
        masks = np.concatenate([item.alpha[:, v] > 127 for item in evidence.watched])
        sides = {"top": masks[:, 0], "bottom": masks[:, -1], "left": masks[:, :, 0], "right": masks[:, :, -1]}
        often = {side: float(rim.any(-1).mean()) for side, rim in sides.items()}
        cut = [side for side, fraction in often.items() if fraction > _OFTEN]
        if not cut:
            continue
        moves = any(bool((sides[side] != sides[side][:1]).any()) for side in cut)
        yield Finding(
            "warning",
            f"The object is cut off at the {listed(cut)} of {view} in {max(often.values()):.0%} of the frames"
            f"{'' if moves else ', where nothing moves'}.",
            "Move the camera back or turn it. Where only a part that is held leaves the picture, this does no harm.",
        )  # fmt: skip


def find_tiny(evidence: Evidence) -> Iterator[Finding]:
    """Finds objects that fill too little of an image."""
    for v, view in enumerate(evidence.views):
        lengths = []
        for alpha in (item.alpha[0, v] > 127 for item in evidence.first):
            rows, columns = np.nonzero(alpha)
            if len(rows):
                lengths.append(max(np.ptp(rows), np.ptp(columns)) + 1)
        if not lengths:
            continue
        length, longer = float(np.median(lengths)), max(evidence.first[0].alpha.shape[-2:])
        if length < _TINY_FRACTION * longer or length / evidence.scale < _TINY_PIXELS:
            yield Finding(
                "warning",
                f"The object is tiny in {view}: {length / evidence.scale:.0f} pixels, {length / longer:.0%} of the "
                "picture's longer side.",
                "Film from nearer or with a longer lens, or crop the pictures (and shift cx, cy, w and h with them).",
            )  # fmt: skip


def find_outliers(evidence: Evidence) -> Iterator[Finding]:
    """Finds kernels of the rest scene that are most likely wrong."""
    for found in [] if evidence.scene is None else outliers(evidence.scene):
        yield Finding(
            "warning", f"Rest scene: {found.what}",
            f"`gausim inspect {evidence.data.scene_path} --clean OUT.ply` writes the scene without kernels that are "
            "too large or too far away.",
        )  # fmt: skip


def find_pins(evidence: Evidence) -> Iterator[Finding]:
    """Finds scenes without pinned kernels, or with nearly all pinned; nothing holds a free body."""
    scene = evidence.scene
    if scene is None or evidence.free:
        return
    try:
        require_pinned(scene)
    except SceneError as error:
        sentence, _, remedy = str(error).partition(". ")
        yield Finding(
            "fault", f"{sentence.rstrip('.')}.",
            remedy or "Pin fewer kernels, e.g. --pin \"below z=...\" with a lower height.",
        )  # fmt: skip
        return
    fraction = float(scene.pinned.sum()) / float(scene.simulated.sum())
    if fraction > _MOSTLY_PINNED:
        yield Finding(
            "warning",
            f"{fraction:.0%} of the simulated kernels are pinned: hardly anything is left to move.",
            "Pin only what is held in the videos (`gausim inspect SCENE.ply` draws it in grey).",
        )  # fmt: skip


def find_few_frames(evidence: Evidence) -> Iterator[Finding]:
    """Finds objects with too few training frames for an oscillation, or too few sequences for several directions."""
    seen, sequences = len(evidence.data.train_frames), evidence.sequences
    if seen < _SEEN:
        yield Finding(
            "warning",
            f"Training sees {seen} frames of each sequence only (field 'train_frames' of dataset.json); the paper sees "
            f"{_SEEN}. Less than a swing says little about stiffness and damping.",
            f"Record longer sequences, or set 'train_frames' to [0, {_SEEN}].",
        )  # fmt: skip
    if sequences < _SEQUENCES:
        yield Finding(
            "warning",
            f"Sequences: {sequences} only. Pushes in directions that were never filmed will be predicted badly.",
            "Record more, pushed at different places and in different directions (the paper has 30).",
        )  # fmt: skip
