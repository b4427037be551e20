"""Values of command lines that several commands read."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor


def positive(text: str) -> int:
    """Reads a whole number above 0."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected a positive number, got {text}")
    return value


def parse_background(text: str) -> Tensor | None:
    """Reads a background colour; None is black.

    Raises:
        ConfigError: it is neither a name nor three numbers in 0..1.
    """
    import torch

    from gausim.core.errors import ConfigError

    if text == "black":
        return None
    try:
        color = [1.0, 1.0, 1.0] if text == "white" else [float(v) for v in text.split(",")]
    except ValueError:
        color = []
    if len(color) != 3 or not all(0 <= v <= 1 for v in color):
        raise ConfigError(
            f"--background {text}: expected black, white or R,G,B with numbers in 0..1, e.g. 0.2,0.2,0.2."
        )
    return torch.tensor(color)
