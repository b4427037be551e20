"""The weights of the terms and how far gradients reach: everything that defines what is minimised."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from gausim.core import ConfigError
from gausim.losses.image import ImageLoss


@dataclass(frozen=True)
class Objective:
    """What one optimiser step minimises (METHOD section 4).

    Attributes:
        image: loss between a predicted and a true image.
        image_weight: of the image loss (mean over views).
        static_weight: of the static loss [diagonals^2].
        rest_image_weight: of the image loss of one step from the rest state against frame 0, in batches that carry the
            static loss.
        static_probability: how often a batch carries it; None is 1 / T.
        momentum_weight: of the momentum loss [(total mass x diagonals)^2], times what the rest state scores.
        over_steps: ``mean`` or ``sum`` of image and momentum losses over the steps of a rollout.
        backprop_steps: gradients stop every so many steps; 0 lets them through the whole rollout.
        checkpoint_steps: keep of each step of a rollout its input only and compute it once more in the backward pass;
            same gradients in less memory, for about a third more time of the dynamics.
        energy_weight: of the energy that free motion beyond the frames seen gains, as a share of what it has, times the
            batch's image loss; 0 is off. The model's template must know an energy; None is 1 where it does, else 0.
        energy_frames: how far that motion goes.
        energy_stretch: frames over which its energy is averaged, about a period; gradients stop at its ends.
        energy_probability: how often a batch carries it.
        mixing_weight: of the squares by which the template's matrices mix the modes of the body it began with, times
            what the rest state scores: what the frames do not tell stays as it was.
        explosion: a rollout that moves a kernel further than this from its rest position ends there and the rest of
            it is not learned from [diagonals of the scene's bounding box]; each such end is counted in the log.
    """

    image: ImageLoss = field(default_factory=ImageLoss)
    image_weight: float = 1.0
    static_weight: float = 1.0
    rest_image_weight: float = 0.0
    static_probability: float | None = None
    momentum_weight: float = 1.0
    over_steps: str = "mean"
    backprop_steps: int = 1
    checkpoint_steps: bool = False
    energy_weight: float | None = 0.0
    energy_frames: int = 36
    energy_stretch: int = 12
    energy_probability: float = 0.5
    mixing_weight: float = 0.0
    explosion: float = 3.0

    def __post_init__(self) -> None:
        """Checks the ranges."""
        names = ["backprop_steps", *(f.name for f in fields(self) if f.name.endswith("_weight"))]
        negative = [name for name in names if (getattr(self, name) or 0) < 0]
        if negative or self.explosion <= 0:
            raise ConfigError(f"loss: expected {', '.join(negative) or 'explosion'} not to be negative, got {self}.")
        if self.over_steps not in ("mean", "sum"):
            raise ConfigError(f"loss.over_steps: expected mean or sum, got '{self.over_steps}'.")
        if not 0 <= self.energy_probability <= 1 or not 0 < self.energy_stretch < self.energy_frames:
            raise ConfigError(
                "loss: expected 0 <= energy_probability <= 1 and 0 < energy_stretch < energy_frames, got "
                f"{self.energy_probability}, {self.energy_stretch} and {self.energy_frames}."
            )
        if self.static_probability is not None and not 0 <= self.static_probability <= 1:
            raise ConfigError(f"loss.static_probability: expected null or 0..1, got {self.static_probability}.")

    def step_weight(self, steps: int) -> float:
        """What the losses of one of ``steps`` predicted steps count."""
        return 1.0 / steps if self.over_steps == "mean" else 1.0

    def static_chance(self, steps: int) -> float:
        """Probability that a batch of ``steps`` predicted steps also carries the static loss."""
        if self.static_weight == 0 and self.rest_image_weight == 0:
            return 0.0
        return 1 / steps if self.static_probability is None else self.static_probability

    def window(self, steps: int) -> int:
        """Length of the stretches through which gradients flow, within a rollout of ``steps``."""
        return min(steps, self.backprop_steps) if self.backprop_steps else steps
