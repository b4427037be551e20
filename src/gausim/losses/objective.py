"""Objective of training: weights of the loss terms, lengths of backpropagation, and the static loss."""

from dataclasses import dataclass, field, fields

from jaxtyping import Float
from torch import Tensor

from gausim.core import ConfigError
from gausim.losses.image import ImageLoss


@dataclass(frozen=True)
class Objective:
    """Objective of an optimiser step (METHOD section 4).

    Attributes:
        image: loss between a predicted and a true image.
        static_weight: weight of the static loss [diagonals^2].
        rest_image_weight: weight of the image loss of one step from the rest state against frame 0, in batches with the
            static loss.
        static_probability: probability of the static loss in a batch; None is 1 / T.
        momentum_weight: weight of the momentum loss [(total mass x diagonals)^2], times the rest state's loss.
        backprop_steps: loss gradients stop after this number of steps; 0 lets them through the whole rollout.
        explosion: distance from rest of a kernel [diagonals of the scene's bounding box] at which a rollout ends, with
            no loss beyond it; the log counts these rollouts.
    """

    image: ImageLoss = field(default_factory=ImageLoss)
    static_weight: float = 10.0
    rest_image_weight: float = 0.0
    static_probability: float | None = None
    momentum_weight: float = 1.5e4
    backprop_steps: int = 0
    explosion: float = 3.0

    def __post_init__(self) -> None:
        names = ["backprop_steps", *(f.name for f in fields(self) if f.name.endswith("_weight"))]
        negative = [name for name in names if getattr(self, name) < 0]
        if negative or self.explosion <= 0:
            raise ConfigError(f"loss: expected {', '.join(negative) or 'explosion'} not to be negative, got {self}.")
        if self.static_probability is not None and not 0 <= self.static_probability <= 1:
            raise ConfigError(f"loss.static_probability: expected null or 0..1, got {self.static_probability}.")

    def static_chance(self, steps: int) -> float:
        """Probability of the static loss in a batch of ``steps`` predicted steps."""
        if self.static_weight == 0 and self.rest_image_weight == 0:
            return 0.0
        return 1 / steps if self.static_probability is None else self.static_probability

    def window(self, steps: int) -> int:
        """Length of the stretches through which loss gradients flow, in a rollout of ``steps``."""
        return min(steps, self.backprop_steps) if self.backprop_steps else steps


def static_loss(
    positions: Float[Tensor, "K 3"], rest: Float[Tensor, "K 3"], diagonal: Float[Tensor, "K 1"]
) -> Float[Tensor, ""]:
    """Static loss (METHOD section 4): sum over kernels of the squared distance of one step from the rest state.

    Lengths are divided by the diagonal of each kernel's scene, so the loss is independent of the scene's unit.
    """
    return ((positions - rest) / diagonal).square().sum()
