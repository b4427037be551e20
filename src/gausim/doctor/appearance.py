"""Checks of appearance: constant exposure."""

from collections.abc import Iterator

import numpy as np
from scipy.ndimage import median_filter

from gausim.doctor.evidence import Evidence, Finding, listed

# Relative jumps of brightness over time, the fraction of frames with them, and difference between cameras.
_FLICKER, _OFTEN, _BETWEEN = 0.03, 0.1, 0.15
# Smallest alpha of opaque pixels.
_OPAQUE = 230


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
            "warning",
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
            "warning",
            f"Brightness differs between cameras, compared with the rest scene: {told}.",
            "Set exposure and white balance alike and fixed, or correct the pictures of this camera.",
        )  # fmt: skip
