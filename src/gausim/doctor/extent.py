"""What there is to train on: pins, seen frames, sequences."""

from __future__ import annotations

from collections.abc import Iterator

from gausim.core import SceneError
from gausim.doctor.evidence import Evidence
from gausim.doctor.finding import Finding
from gausim.ops.selection import require_pinned

NAME = "extent"
# The paper's number of seen frames, and what is short of learning anything.
_SEEN, _FEWEST_SEEN = 16, 6
# Fewer sequences than this hold too few directions of motion.
_SEQUENCES = 4
# A scene of which so much is held has little left to move.
_MOSTLY_PINNED = 0.9


def find_extent_faults(evidence: Evidence) -> Iterator[Finding]:
    """Counts pins, frames and sequences."""
    yield from _pins(evidence)
    yield from _frames(evidence)


def _pins(evidence: Evidence) -> Iterator[Finding]:
    scene = evidence.scene
    if scene is None:
        return
    try:
        require_pinned(scene)
    except SceneError as error:
        sentence, _, remedy = str(error).partition(". ")
        yield Finding(
            "pins", "fault", "certain", f"{sentence.rstrip('.')}.",
            remedy or "Pin fewer kernels: --pin-below with a lower height.",
            {"pinned": int(scene.pinned.sum()), "simulated": int(scene.simulated.sum())},
        )  # fmt: skip
        return
    share = float(scene.pinned.sum()) / float(scene.simulated.sum())
    if share > _MOSTLY_PINNED:
        yield Finding(
            "pins", "warning", "possible",
            f"{share:.0%} of the simulated kernels are pinned: hardly anything is left to move.",
            "Pin only what is held in the videos (`gausim inspect SCENE.ply` draws it in grey).", {"share": share},
        )  # fmt: skip


def _frames(evidence: Evidence) -> Iterator[Finding]:
    seen, sequences = len(evidence.data.train_frames), evidence.sequences
    if seen < _SEEN:
        yield Finding(
            NAME, "warning", "likely" if seen < _FEWEST_SEEN else "possible",
            f"Training sees {seen} frames of each sequence only (field 'train_frames' of dataset.json); the paper sees "
            f"{_SEEN}. Less than a swing says little about stiffness and damping.",
            f"Record longer sequences, or set 'train_frames' to [0, {_SEEN}]; `data.curriculum.t_max` must stay below.",
            {"frames": seen},
        )  # fmt: skip
    if sequences < _SEQUENCES:
        yield Finding(
            NAME, "warning", "possible",
            f"There {'is one sequence' if sequences == 1 else f'are {sequences} sequences'} only: pushes in directions "
            "that were never filmed will be predicted badly.",
            "Record more, pushed at different places and in different directions (the paper has 30, the examples 8 to "
            "12).", {"sequences": sequences},
        )  # fmt: skip
