"""Sequences that teach nothing: black, empty, or one picture repeated."""

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
            yield f"{item.root}: {what} in {', '.join(names)}. Leave these sequences out, or export them again."


def _idle(item: ObjectData, name: str) -> str:
    # A record of its own, which does not keep the decoded images.
    record, stop = item.record(name), item.train_frames.stop
    chosen = np.unique(np.linspace(0, stop - 1, _FRAMES).round().astype(int)).tolist()
    alpha, brightest, apart = 0, 0.0, 0.0
    for view in item.train_views:
        pictures = np.concatenate([record.frames(range(f, f + 1), [view]).numpy()[:, 0] for f in chosen])
        shown = pictures[..., :3] * (pictures[..., 3:] / np.float32(255))
        alpha, brightest = max(alpha, int(pictures[..., 3].max())), max(brightest, float(shown.max()))
        apart = max(apart, float(np.abs(shown - shown[0]).max()))
        if apart > _SAME:
            return ""
    if alpha == 0:
        return "nothing is visible (alpha is 0 in all training views)"
    if brightest <= _SAME:
        return "the object is black"
    return "nothing moves (the frames of every training view are one picture)"
