"""Quality of poses: reprojection errors, colours of points, a picture of cameras and points."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from data_prep.capture.cameras.sources import Posed
from data_prep.capture.cameras.world import centers
from data_prep.common.colmap import PointTable


def reprojection(points: PointTable) -> dict[str, Any]:
    """Mean distance between where photos show points and where their cameras see them, as COLMAP states it [pixels]."""
    count = int(points.tracks.sum())
    return {"observations": count, "mean": float((points.error * points.tracks).sum() / count) if count else None}


def point_colors(posed: Sequence[Posed], points: PointTable) -> np.ndarray:
    """(P, 3) uint8 RGB: the mean of the pixels that show each point."""
    total, count = np.zeros((len(points.ids), 3)), np.zeros(len(points.ids))
    order = np.argsort(points.ids)
    for shot in posed if len(order) else ():
        rows = order[np.searchsorted(points.ids, shot.point_ids, sorter=order).clip(max=len(order) - 1)]
        known = points.ids[rows] == shot.point_ids
        if not known.any():
            continue
        pixels = shot.photo.read()
        x = shot.xy[known, 0].astype(int).clip(0, shot.photo.width - 1)
        y = shot.xy[known, 1].astype(int).clip(0, shot.photo.height - 1)
        np.add.at(total, rows[known], pixels[y, x, :3])
        np.add.at(count, rows[known], 1)
    return np.round(total / np.maximum(count, 1)[:, None]).astype(np.uint8)


def draw_cameras(path: Path, posed: Sequence[Posed], points: np.ndarray, colors: np.ndarray, title: str) -> None:
    """Writes a PNG of points (P, 3) with colours (P, 3) uint8 and of the cameras, from above and from two sides."""
    from matplotlib.figure import Figure

    viewmats = np.stack([shot.viewmat for shot in posed])
    eyes = centers(viewmats)
    around = np.concatenate((eyes, points)) if len(points) else eyes
    # Stray points far away would shrink everything else to a dot.
    low = np.minimum(np.percentile(around, 2, 0), eyes.min(0))
    high = np.maximum(np.percentile(around, 98, 0), eyes.max(0))
    reach = 0.06 * float(np.linalg.norm(high - low)) + 1e-9
    figure = Figure(figsize=(16.5, 6), layout="constrained")
    figure.suptitle(title)
    for panel, (across, up) in zip(figure.subplots(1, 3), ((0, 1), (0, 2), (1, 2)), strict=True):
        panel.scatter(points[:, across], points[:, up], s=2, c=colors / 255.0, linewidths=0)
        ahead = viewmats[:, 2, :3] * reach
        panel.quiver(
            eyes[:, across], eyes[:, up], ahead[:, across], ahead[:, up],
            angles="xy", scale_units="xy", scale=1, color="tab:red", width=0.004,
        )  # fmt: skip
        panel.scatter(eyes[:, across], eyes[:, up], s=14, color="tab:red")
        margin = 2 * reach
        panel.set_xlim(low[across] - margin, high[across] + margin)
        panel.set_ylim(low[up] - margin, high[up] + margin)
        panel.set_aspect("equal")
        panel.set_xlabel("xyz"[across])
        panel.set_ylabel("xyz"[up])
        panel.set_title("from above" if (across, up) == (0, 1) else f"from the side, looking along {'yx'[across]}")
    figure.savefig(path, format="png", dpi=90)
