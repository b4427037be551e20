"""Sequences that teach nothing: black, empty, or one picture repeated."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from gausim.data.objects import ObjectData

# Frames of each sequence that are compared, and the largest difference between copies of one picture [of 255].
_FRAMES, _SAME = 4, 2


def idle_sequences(objects: Sequence[ObjectData]) -> Iterator[str]:
    """A sentence per object and kind on sequences whose training frames show nothing, are black, or do not move."""
    for item in objects:
        found: dict[str, list[str]] = {}
        for record in item.sequences:
            what = _idle(item, record.name)
            if what:
                found.setdefault(what, []).append(record.name)
        for what, names in found.items():
            yield f"{item.root}: {', '.join(names)} {what}. Leave these sequences out, or export them again."


def _idle(item: ObjectData, name: str) -> str:
    # A record of its own, which does not keep the decoded images.
    record, stop = item.record(name), item.train_frames.stop
    chosen = np.unique(np.linspace(0, stop - 1, _FRAMES).round().astype(int)).tolist()
    frames = [record.frames(range(f, f + 1), item.train_views)[0].numpy().astype(np.float32) for f in chosen]
    if not any(frame[..., 3].any() for frame in frames):
        return "show nothing (alpha is 0 in all training views)"
    shown = [frame[..., :3] * (frame[..., 3:] / 255) for frame in frames]
    if max(float(picture.max()) for picture in shown) <= _SAME:
        return "are black where alpha shows the object"
    apart = max(float(np.abs(picture - shown[0]).max()) for picture in shown)
    return "do not move: the frames of every training view are one picture" if apart <= _SAME else ""
