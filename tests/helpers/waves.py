"""Two pictures for image metrics."""

import numpy as np
import torch


def pair(height: int = 48, width: int = 64) -> tuple[torch.Tensor, torch.Tensor]:
    """A picture of waves, and the same shifted and duller: (prediction, target)."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    waves = [0.5 + 0.5 * np.sin(0.31 * x + 0.2 * y), 0.5 + 0.5 * np.sin(0.17 * x - 0.4 * y + 1),
             0.5 + 0.4 * np.cos(0.05 * x * y / 8)]  # fmt: skip
    target = np.stack(waves, -1)
    prediction = np.clip(0.85 * np.roll(target, 3, 1) + 0.05, 0, 1)
    return torch.tensor(prediction, dtype=torch.float32)[None], torch.tensor(target, dtype=torch.float32)[None]
