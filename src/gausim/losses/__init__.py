"""Losses of training: images, rest state, and momentum between levels."""

from gausim.losses.image import ImageLoss
from gausim.losses.objective import Objective, static_loss

__all__ = ["ImageLoss", "Objective", "static_loss"]
