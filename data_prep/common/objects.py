"""Objects that stages make: their facts, what is told of them, and the check before they take their name."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from gausim.core.errors import DataError

MOST_FAULTS = 5


def object_facts(
    name: str, fps: float, views: Sequence[str], heldout: Collection[str], train_frames: int
) -> dict[str, Any]:
    """The fields of ``dataset.json`` that every object has."""
    return {
        "name": name, "fps": fps, "views": list(views), "train_views": [view for view in views if view not in heldout],
        "heldout_views": [view for view in views if view in heldout], "train_frames": [0, train_frames],
    }  # fmt: skip


def described(facts: Mapping[str, Any], stills: int, sequences: Mapping[str, int]) -> list[str]:
    """A few lines about an object with so many stills and frames by sequence, for people."""
    frames = sorted(sequences.values())
    length = str(frames[0]) if frames[0] == frames[-1] else f"{frames[0]} to {frames[-1]}"
    heldout = ", ".join(facts["heldout_views"]) or "none"
    return [
        f"stills      {stills}",
        f"sequences   {len(frames)}, {length} frames at {facts['fps']:g} per second",
        f"cameras     train {', '.join(facts['train_views'])}; never trained on: {heldout}",
        f"frames      0 to {facts['train_frames'][1] - 1} are trained on",
    ]


def train_command(name: str, out: Path) -> str:
    """The command that trains on an object."""
    return f"gausim train data={out} name={name}"


def refuse_faults(work: Path, out: Path) -> None:
    """Checks the object in ``work``, which is to become ``out``, as `gausim verify` does."""
    from gausim.data.verify import verify

    faults = verify(work)
    if faults:
        shown = [f"{fault.where}: {fault.what.replace(str(work), str(out))}" for fault in faults]
        more = f" And {len(faults) - MOST_FAULTS} more." if len(faults) > MOST_FAULTS else ""
        raise DataError(f"{out}: the object would have faults:\n  " + "\n  ".join(shown[:MOST_FAULTS]) + more)
