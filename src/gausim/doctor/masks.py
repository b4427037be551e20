"""Checks of masks: inverted, missing, empty, flickering, or with haze around the object."""

from collections.abc import Iterator

import cv2
import numpy as np

from gausim.doctor.evidence import Evidence, Finding, listed

# Fractions of foreground along the image border above which masks are inverted, and missing.
_AROUND, _EVERYWHERE = 0.8, 0.999
# Standard deviation of the colours along the border of a uniform background, and how far red, green and blue lie apart
# in a coloured one [of 255].
_UNIFORM, _COLOURED = 8.0, 40.0
# Haze: largest invisible alpha (of 255), distance from the object [reduced pixels], and fraction of the pixels.
_FAINT, _AWAY, _HAZE = 26, 6, 0.02
# Relative jump of a mask's area against the neighbouring frames, the radius of these, and the jump over a median step.
_JUMP, _RADIUS, _STEPS = 0.15, 2, 3
# Fraction of empty frames that makes a fault.
_MANY = 0.1


def find_mask_faults(evidence: Evidence) -> Iterator[Finding]:
    """Finds masks that cannot be those of one object."""
    rims = {view: [_rim(item.alpha[0, v]) > 127 for item in evidence.first] for v, view in enumerate(evidence.views)}
    full = [view for view, found in rims.items() if np.median([rim.mean() for rim in found]) > _AROUND]
    if full:
        yield _inverted_or_absent(evidence, full)
        return
    yield from _empty(evidence)
    yield from _encoded(evidence)
    yield from _haze(evidence)
    yield from _blinking(evidence)


def _rim(picture: np.ndarray) -> np.ndarray:
    """The pixels along the image border."""
    return np.concatenate((picture[0], picture[-1], picture[:, 0], picture[:, -1]))


def _inverted_or_absent(evidence: Evidence, views: list[str]) -> Finding:
    index = [evidence.views.index(view) for view in views]
    covered = float(np.mean([(item.alpha[0, index] > 127).mean() for item in evidence.first]))
    if covered > _EVERYWHERE:
        return _not_cut_out(evidence, views, index)
    return Finding(
        "fault",
        f"The masks of {listed(views)} are inverted: alpha keeps the border of the picture and leaves out its middle.",
        "Write 255 - alpha into the images (alpha 255 is the object), or segment again.",
    )  # fmt: skip


def _not_cut_out(evidence: Evidence, views: list[str], index: list[int]) -> Finding:
    rims = [_rim(p).astype(np.float32) for i in evidence.first for p in i.rgb[0, index]]
    spread = float(np.median([rim.std(0).max() for rim in rims]))
    hue = float(np.median([np.ptp(rim.mean(0)) for rim in rims]))
    backend = "chroma" if spread < _UNIFORM and hue > _COLOURED else "background or --backend masks"
    return Finding(
        "fault",
        f"Nothing is cut out in {listed(views)}: alpha is 255 all over the picture, so the background would be taken "
        "for the object.", f"Make masks: `gausim prepare segment PICTURES --out OUT --backend {backend}`.",
    )  # fmt: skip


def _empty(evidence: Evidence) -> Iterator[Finding]:
    for v, view in enumerate(evidence.views):
        shown = np.concatenate([item.alpha[:, v].max((-1, -2)) > 0 for item in evidence.watched])
        first = next((f"{i.name} frame {f}" for i in evidence.watched for f in range(len(i.alpha))
                      if not i.alpha[f, v].any()), "")  # fmt: skip
        empty = 1 - float(shown.mean())
        if empty == 0:
            continue
        told = "never shows the object" if empty == 1 else f"does not show the object in {empty:.0%} of the frames"
        yield Finding(
            "fault" if empty > _MANY else "warning",
            f"{view} {told}: the mask is empty (first: {first}).",
            f"Segment {view} again; where it does not see the object, take it out of dataset.json (field 'views').",
        )  # fmt: skip


def _encoded(evidence: Evidence) -> Iterator[Finding]:
    most = {view: max(int(item.alpha[:, v].max()) for item in evidence.watched)
            for v, view in enumerate(evidence.views)}  # fmt: skip
    faint = [view for view, value in most.items() if 0 < value <= 127]
    if faint:
        yield Finding(
            "fault",
            f"The masks of {listed(faint)} never exceed {max(most[view] for view in faint)} of 255: labels or colours "
            "of a palette were taken for alpha, so the object is transparent.",
            "Write the masks again as 0 and 255, e.g. with `gausim prepare segment PICTURES --backend masks`.",
        )  # fmt: skip
    doubled = [view for v, view in enumerate(evidence.views) if all(item.premultiplied[v] for item in evidence.first)]
    if doubled:
        yield Finding(
            "warning",
            f"The colours of {listed(doubled)} are multiplied by alpha already (premultiplied), so edges become dark.",
            "Divide them by alpha: `gausim prepare segment PICTURES --backend alpha` does.",
        )  # fmt: skip


def _haze(evidence: Evidence) -> Iterator[Finding]:
    kernel = np.ones((2 * _AWAY + 1, 2 * _AWAY + 1), np.uint8)
    fractions: dict[str, float] = {}
    for v, view in enumerate(evidence.views):
        found = []
        for alpha in (item.alpha[0, v] for item in evidence.first):
            near = cv2.dilate((alpha > 127).astype(np.uint8), kernel) > 0
            found.append(float(((alpha > 0) & (alpha <= _FAINT) & ~near).mean()))
        fractions[view] = float(np.median(found))
    hazy = [view for view, fraction in fractions.items() if fraction > _HAZE]
    if hazy:
        yield Finding(
            "warning",
            f"A haze of faint alpha (1 to {_FAINT} of 255) lies around the object in {listed(hazy)}, over up to "
            f"{max(fractions.values()):.0%} of the picture. All alpha above 0 counts as foreground.",
            "Set alpha below 0.1 to 0 in the images, or segment again with `--floor 0.1`.",
        )  # fmt: skip


def _blinking(evidence: Evidence) -> Iterator[Finding]:
    for v, view in enumerate(evidence.views):
        jumps = []
        for item in evidence.watched:
            area = item.alpha[:, v].astype(np.float64).sum((-1, -2))
            padded = np.pad(area, _RADIUS, mode="reflect") if len(area) > _RADIUS else area
            if len(padded) == len(area):
                continue
            near = np.lib.stride_tricks.sliding_window_view(padded, 2 * _RADIUS + 1)
            around = np.median(near, -1)
            # A body that turns changes its area smoothly: the cubic through its neighbours predicts a frame.
            smooth = (4 * (near[:, 1] + near[:, 3]) - near[:, 0] - near[:, 4]) / 6
            usual = _STEPS * np.median(np.abs(np.diff(area)))  # thin bodies turn edge-on within frames
            off = np.minimum(np.abs(area - around), np.abs(area - smooth)) > np.maximum(_JUMP * around, max(usual, 1))
            jumps += [f"{item.name} frame {f}" for f in np.nonzero(off)[0] if area[f] > 0]
        if jumps:
            yield Finding(
                "warning",
                f"The mask of {view} jumps in size by more than {_JUMP:.0%} for a frame or two: {listed(jumps)}.",
                "Look at these frames; segment them again (`--radius 3` mends what flashes up or drops out).",
            )  # fmt: skip
