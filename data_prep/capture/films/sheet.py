"""A picture that shows by eye whether films are synchronised: the same moments side by side, and when things move."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gausim.io.files import replacing

MOMENTS = 5


def motion(thumbnails: Sequence[np.ndarray]) -> np.ndarray:
    """Mean absolute change between neighbouring (H, W) grey pictures, 0..1; its maximum is 1."""
    frames = np.stack([t.astype(np.float32) for t in thumbnails])
    change = np.abs(np.diff(frames, axis=0)).mean((1, 2))
    return np.asarray(change / max(float(change.max(initial=0.0)), 1e-6))


def write_sheet(path: Path, thumbnails: Mapping[str, Sequence[np.ndarray]], found: Mapping[str, Any]) -> None:
    """Writes a PNG of F small grey frames per camera: some moments, and each camera's motion over time.

    Peaks of motion lie above each other where the films are synchronised.
    """
    from matplotlib.figure import Figure

    count = min(len(frames) for frames in thumbnails.values())
    moments = np.unique(np.linspace(0, count - 1, MOMENTS).astype(int))
    figure = Figure(figsize=(11, 1.4 * len(thumbnails) + 3.2), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=[1.4 * len(thumbnails), 3.0])
    upper, lower = parts
    axes = upper.subplots(len(thumbnails), len(moments), squeeze=False)
    for row, (camera, frames) in zip(axes, thumbnails.items(), strict=True):
        for axis, k in zip(row, moments, strict=True):
            axis.imshow(frames[k], cmap="gray", vmin=0, vmax=255)
            axis.set_xticks([])
            axis.set_yticks([])
            axis.set_title(f"frame {k}", fontsize=8)
        row[0].set_ylabel(camera, fontsize=8)
    plot = lower.subplots()
    for i, (camera, frames) in enumerate(thumbnails.items()):
        if len(frames) > 1:
            offset = found["cameras"][camera]["offset_frames"]
            label = f"{camera}: {offset:+.2f} frames"
            plot.plot(np.arange(1, len(frames)), motion(frames) + 0.15 * i, label=label, linewidth=1)
    plot.set_xlabel("output frame")
    plot.set_ylabel("motion (shifted up per camera)")
    plot.legend(fontsize=7)
    plot.set_title(f"{found['source']}: by {found['method']}, reference {found['reference']}", fontsize=9)
    with replacing(path, typed=True) as temporary:
        figure.savefig(temporary, dpi=90)
