"""Figure of long rollouts (``endurance.json``)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from gausim.report.pictures.figures import METHOD_COLORS, save_figure


def endurance_figure(name: str, rollouts: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Motion energy and distance from rest over the frames of every rollout.

    Args:
        name: of the object.
        rollouts: by kind: ``window`` [frames], ``energy`` and ``away`` per window.
        path: PNG to write.
    """
    figure = Figure(figsize=(9.6, 3.4), dpi=110, layout="constrained")
    left, right = figure.subplots(1, 2)
    for color, (kind, told) in zip(METHOD_COLORS, rollouts.items(), strict=False):
        frames = (np.arange(len(told["energy"])) + 0.5) * told["window"]
        left.semilogy(frames, np.maximum(told["energy"], 1e-30), color=color, label=kind)
        right.plot(frames, 100 * np.asarray(told["away"]), color=color, label=kind)
    left.set(title="motion energy", xlabel="frame")
    right.set(title="mean distance from rest [% of diagonal]", xlabel="frame", ylim=(0, None))
    right.legend(fontsize=8)
    figure.suptitle(f"{name}, far beyond the recording", fontsize=10)
    save_figure(figure, path)
