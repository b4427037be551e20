"""Checks of appearance: texture, which loss gradients need, and constant exposure."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from scipy.ndimage import median_filter

from gausim.doctor.evidence import Evidence, Finding, listed

# Mean slope of the colours within the object below which it counts as plain [1/255 per reduced pixel].
_PLAIN = 2.5
# Relative jumps of brightness over time, the fraction of frames with them, and difference between cameras.
_FLICKER, _OFTEN, _BETWEEN = 0.03, 0.1, 0.15
# Smallest alpha of opaque pixels, and distance of the interior from the edge [reduced pixels].
_OPAQUE, _INSIDE = 230, 3


def find_plain(evidence: Evidence) -> Iterator[Finding]:
    """Finds objects of nearly constant colour."""
    item, slopes = evidence.first[0], []
    kernel = np.ones((2 * _INSIDE + 1, 2 * _INSIDE + 1), np.uint8)
    for alpha, gray in zip(item.alpha[0], item.gray[0] * 255, strict=True):
        inside = cv2.erode((alpha > _OPAQUE).astype(np.uint8), kernel) > 0
        if inside.sum() > 20:
            slopes.append(float(np.hypot(*np.gradient(gray))[inside].mean()))
    if slopes and float(np.median(slopes)) < _PLAIN:
        yield Finding(
            "note", "likely",
            f"The object is plain: its colours change by {np.median(slopes):.1f} of 255 per pixel, so only its outline "
            "tells how it moves.",
            "Training works from outlines too, less exactly. A pattern (paint, stickers, printed cloth) helps.",
        )  # fmt: skip


def find_flicker(evidence: Evidence) -> Iterator[Finding]:
    """Finds brightness that jumps from frame to frame."""
    fractions: dict[str, float] = {}
    for v, view in enumerate(evidence.views):
        jumps = []
        for item in evidence.watched:
            opaque = item.alpha[:, v] > _OPAQUE
            count = opaque.sum((-1, -2))
            if len(count) > 4 and count.all():
                light = (item.gray[:, v] * opaque).sum((-1, -2)) / count  # mean over the foreground, per frame
                jumps.append(np.abs(light / np.maximum(median_filter(light, 3, mode="nearest"), 1e-6) - 1) > _FLICKER)
        fractions[view] = float(np.concatenate(jumps).mean()) if jumps else 0.0
    flickers = [view for view, fraction in fractions.items() if fraction > _OFTEN]
    if flickers:
        yield Finding(
            "warning", "likely",
            f"The brightness of {listed(flickers)} jumps from frame to frame (by more than {_FLICKER:.0%} in "
            f"{max(fractions.values()):.0%} of the frames): automatic exposure, or lamps on mains.",
            "Film with fixed exposure, at a shutter time that suits the mains (1/50 or 1/100 s at 50 Hz).",
        )  # fmt: skip


def find_uneven(evidence: Evidence) -> Iterator[Finding]:
    """Finds brightness that differs from camera to camera."""
    if evidence.rest is None or evidence.fits is None:
        return
    item, drawn, gains = evidence.first[0], evidence.rest[0], {}
    for v, view in enumerate(evidence.views):
        both = (item.alpha[0, v] > _OPAQUE) & (drawn.alpha[v] > 0.9)
        if both.sum() > 20:
            gains[view] = float(item.gray[0, v][both].mean() / max(float(drawn.rgb[v].mean(-1)[both].mean()), 1e-3))
    usual = float(np.median(list(gains.values()))) if gains else 1.0
    other = [view for view, gain in gains.items() if abs(gain / usual - 1) > _BETWEEN]
    if other:
        told = ", ".join(f"{view} {gains[view] / usual - 1:+.0%}" for view in other)
        yield Finding(
            "warning", "likely",
            f"Brightness differs between cameras, compared with the rest scene: {told}.",
            "Set exposure and white balance alike and fixed, or correct the pictures of this camera.",
        )  # fmt: skip
