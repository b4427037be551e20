"""Static reconstruction: the Gaussians of the rest scene from posed RGBA stills, through any renderer."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gausim.core import ConfigError, DivergenceError, GaussianScene, Renderer
from gausim.data.images import composite
from gausim.losses.image import ImageLoss
from gausim.reconstruction.splat_start import start_object
from gausim.reconstruction.splats import LearningRates, Splats
from gausim.reconstruction.stills import ImageSet

# Fractions to which Adam's step sizes fall exponentially: positions as in 3DGS, the others less.
FINAL_MEANS_RATE = 0.01
FINAL_RATE = 0.1
SSIM_WINDOW = 11
# Weights of D-SSIM against L1 (3DGS), of the L1 error of alpha against the mask, and of long kernels.
SSIM_WEIGHT, ALPHA_WEIGHT, ANISOTROPY_WEIGHT = 0.2, 0.2, 0.02
# Fraction of the kernels at the start; splitting adds the others.
START_FRACTION = 0.6
# Number of times that kernels are pruned and split.
ROUNDS = 8
# Margin of the structural loss around the masks' bounding box [pixels].
CROP_MARGIN = 6
# Steps between two limitations of the kernels' sizes.
LIMIT_EVERY = 10
# Steps between two attributions of the image's error to kernels, each of which costs another rendering.
ATTRIBUTE_EVERY = 4
# Number of intervals of a run whose mean losses early stopping compares.
INTERVALS = 20
# Fraction by which the mean loss must fall to count as better.
BETTER = 2e-3

# Means, covariances, colours and opacities of all kernels.
Drawable = tuple[Tensor, Tensor, Tensor, Tensor]


@dataclass(frozen=True)
class ReconstructionOptions:
    """Options of a reconstruction."""

    kernels: int = 2000  # target number of kernels (pruning may leave fewer)
    iterations: int = 4000  # optimiser steps, one image each
    sh_degree: int = 1  # degree of the spherical harmonics, 0..3
    hull_resolution: int = 96  # voxels along the longest side of the visual hull
    missing_masks: float = 0.0  # fraction of the views whose masks may lack a part that all others show
    minimum_opacity: float = 0.05  # kernels of less opacity are pruned
    anisotropy_limit: float = 3.0  # r of the penalty mean(max(s_max / s_min, r) - r) (PhysGaussian)
    random_background: bool = True  # composite over a random colour in every step instead of black
    # number of successive twentieths of the steps, after the last round, without a better mean loss before an
    # early stop; 0 never stops
    patience: int = 3
    seed: int = 0  # seed of all random numbers
    rates: LearningRates = field(default_factory=LearningRates)  # Adam's step sizes

    def __post_init__(self) -> None:
        for name in ("kernels", "iterations", "hull_resolution"):
            if getattr(self, name) < 1:
                raise ConfigError(f"reconstruction: {name} must be at least 1, got {getattr(self, name)}.")
        if self.sh_degree not in (0, 1, 2, 3):
            raise ConfigError(f"reconstruction: sh_degree must be 0, 1, 2 or 3, got {self.sh_degree}.")
        for name in ("missing_masks", "minimum_opacity"):
            if not 0 <= getattr(self, name) < 1:
                raise ConfigError(f"reconstruction: {name} must be in [0, 1), got {getattr(self, name)}.")

    @property
    def round_steps(self) -> tuple[int, ...]:
        """Steps after which kernels are pruned and split: between 10 % and 70 % of the iterations."""
        first, last = 0.1 * self.iterations, 0.7 * self.iterations
        return tuple(sorted({int(first + (last - first) * i / (ROUNDS - 1)) for i in range(ROUNDS)}))


def reconstruct(
    sets: Sequence[ImageSet],
    renderer: Renderer,
    options: ReconstructionOptions,
    *,
    name: str = "scene",
    progress: "Callable[[Reconstruction], None] | None" = None,
) -> GaussianScene:
    """Fits Gaussians to images by L1 + D-SSIM + mask loss (3DGS, with the mask against floaters).

    Kernels start on the surface of the visual hull of the first set. They are split where the images' error is largest
    and pruned where they are transparent, never seen or out of bounds, because the dynamics moves every kernel. All
    are simulated and foreground, none pinned. ``progress`` is called after every step.

    Raises:
        DataError: no body projects into all masks.
        DivergenceError: the loss is not finite, or pruning left fewer than two kernels.
    """
    run = Reconstruction(sets, renderer, options, name=name)
    while not run.finished:
        run.step()
        if progress is not None:
            progress(run)
    return run.scene()


class Reconstruction:
    """State of an unfinished reconstruction.

    Attributes:
        splats: the kernels.
        done: number of steps so far.
        loss: loss of the latest step.
    """

    def __init__(
        self, sets: Sequence[ImageSet], renderer: Renderer, options: ReconstructionOptions, *, name: str
    ) -> None:
        """Places the first kernels (see :func:`reconstruct`)."""
        self._sets, self._renderer, self._options, self._name = list(sets), renderer, options, name
        self._start = start = start_object(
            sets[0], round(START_FRACTION * options.kernels), resolution=options.hull_resolution,
            missing=options.missing_masks, name=name,
        )  # fmt: skip
        self.splats = Splats(
            start.points, start.colors, start.scales, sh_degree=options.sh_degree, opacity=0.8, rates=options.rates,
            extent=start.extent,
        )  # fmt: skip
        self._generator = torch.Generator().manual_seed(options.seed)
        self._queues: list[list[int]] = [[] for _ in sets]
        self._similarity = ImageLoss(balance=0.0, window=SSIM_WINDOW, pixels=1 / 3)
        self._rounds = options.round_steps
        # Sum and number of the losses of this interval, the best mean, and the intervals since the best one.
        self._patience = [0.0, 0.0, math.inf, 0.0]
        self.done, self.loss = 0, math.nan

    @property
    def finished(self) -> bool:
        """True after all steps, or after an early stop."""
        return self.done >= self._options.iterations or 0 < self._options.patience <= self._patience[3]

    def step(self) -> None:
        """One optimiser step on one image.

        Raises:
            DivergenceError: the loss is not finite, or pruning left fewer than two kernels.
        """
        images, i = self._draw()
        random = torch.rand(3, generator=self._generator)
        background = random if self._options.random_background else torch.zeros(3)
        truth, mask = composite(images.images[i], background)
        drawable = self.splats.drawable(images.cameras.centers[i])
        rgb, alpha = self._render(images, i, background, drawable)
        loss = self._loss(rgb, alpha, truth, mask)
        self.loss = float(loss.detach())
        if not math.isfinite(self.loss):
            raise DivergenceError(
                f"{self._name}: reconstruction loss is {self.loss} at step {self.done}. Lower the rates."
            )
        loss.backward()
        if self.done % ATTRIBUTE_EVERY == 0 and self.done < self._rounds[-1]:
            self._attribute(images, i, background, drawable, (rgb.detach() - truth).abs().mean(-1))
        progress = self.done / self._options.iterations
        self.splats.step({"means": FINAL_MEANS_RATE**progress, "": FINAL_RATE**progress})
        if self.done % LIMIT_EVERY == 0:
            self._limit()
        if self.done in self._rounds:
            self._prune()
            self._densify(self._rounds.index(self.done), len(self._rounds))
            self.splats.forget()
        if self.done > self._rounds[-1]:
            self._note_loss()
        self.done += 1

    def scene(self) -> GaussianScene:
        """The scene of the kernels that are opaque and within bounds."""
        self._limit()
        self.splats.keep(self._lasting())
        return self.splats.scene(self._name)

    def _draw(self) -> tuple[ImageSet, int]:
        """A set drawn by its weight, and the index of an image in it; a set shows all images before one is repeated."""
        done = self.done / self._options.iterations
        weights = torch.tensor([s.weight * (s.span[0] <= done < s.span[1]) for s in self._sets])
        k = int(torch.multinomial(weights, 1, generator=self._generator))
        if not self._queues[k]:
            self._queues[k] = torch.randperm(len(self._sets[k].images), generator=self._generator).tolist()
        return self._sets[k], self._queues[k].pop()

    def _render(
        self, images: ImageSet, i: int, background: Tensor, drawable: Drawable
    ) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"]]:
        cameras = images.cameras
        means, covars, colors, opacities = drawable
        camera = cameras.viewmats[None, i : i + 1], cameras.Ks[None, i : i + 1]
        drawn = self._renderer(
            means[None], covars[None], colors[None, None], opacities[None], *camera, (cameras.width, cameras.height),
            background=background,
        )  # fmt: skip
        return drawn.rgb[0, 0], drawn.alpha[0, 0]

    def _attribute(
        self, images: ImageSet, i: int, background: Tensor, drawable: Drawable, error: Float[Tensor, "H W"]
    ) -> None:
        """Records every kernel's part of the image's error: the sum over pixels of its weight times the error.

        This is the derivative of sum(error * rgb) with respect to the kernel's grey value. Unlike the loss gradient of
        the position it does not cancel within a large kernel (Rota Bulo et al., Revising Densification, 2024).
        """
        means, covars, colors, opacities = (x.detach() for x in drawable)
        gray = torch.zeros_like(colors).requires_grad_()
        rgb, _ = self._render(images, i, background, (means, covars, gray, opacities))
        (derivative,) = torch.autograd.grad(rgb, gray, error[..., None].expand_as(rgb))
        self.splats.note_error(derivative.mean(-1))

    def _loss(self, rgb: Tensor, alpha: Tensor, truth: Tensor, mask: Tensor) -> Tensor:
        rows, columns = _crop(mask > 0)
        first, second = (x[rows, columns].contiguous()[None, None] for x in (rgb, truth))
        area = first.shape[2] * first.shape[3] / mask.numel()  # outside both are background, where D-SSIM is zero
        similarity = SSIM_WEIGHT * area * self._similarity(first, second)[0]
        ratio = (self.splats["log_scales"].amax(-1) - self.splats["log_scales"].amin(-1)).exp()
        long = (ratio - self._options.anisotropy_limit).clamp_min(0).mean()
        color, alphas = (rgb - truth).abs().mean(), (alpha - mask).abs().mean()
        return (1 - SSIM_WEIGHT) * color + ALPHA_WEIGHT * alphas + similarity + ANISOTROPY_WEIGHT * long

    def _lasting(self) -> Bool[Tensor, " K"]:
        """Mask of the kernels that are opaque and within bounds."""
        opaque = torch.sigmoid(self.splats["opacity"].detach()) > self._options.minimum_opacity
        return opaque & self._start.contains(self.splats["means"].detach())

    @torch.no_grad()
    def _limit(self) -> None:
        self.splats["log_scales"].clamp_max_(float(torch.tensor(self._start.largest).log()))

    def _prune(self) -> None:
        seen, lasting = self.splats.seen, self._lasting()
        keep = seen & lasting
        if keep.sum() < 2:
            raise DivergenceError(
                f"reconstruction: only {int(keep.sum())} of {len(keep)} kernels are left after pruning (opaque and "
                f"within bounds: {int(lasting.sum())}, seen: {int(seen.sum())}). Check masks and poses, or take more "
                "iterations."
            )
        self.splats.keep(keep)

    def _densify(self, done: int, rounds: int) -> None:
        """Splits the kernels with the largest errors; the last round but one reaches the number of kernels."""
        missing = self._options.kernels - self.splats.count
        count = min(math.ceil(missing / max(1, rounds - 1 - done)), self.splats.count)
        if count > 0 and done < rounds - 1:
            self.splats.split(self.splats.error.topk(count).indices)

    def _note_loss(self) -> None:
        """Counts the intervals of steps over which the mean loss no longer falls, for early stopping."""
        total, count, best, worse = self._patience[0] + self.loss, self._patience[1] + 1, *self._patience[2:]
        if count >= max(1, self._options.iterations // INTERVALS):
            mean = total / count
            worse = 0.0 if mean < (1 - BETTER) * best else worse + 1
            total, count, best = 0.0, 0.0, min(best, mean)
        self._patience = [total, count, best, worse]


def _crop(mask: Bool[Tensor, "H W"]) -> tuple[slice, slice]:
    """Rows and columns of the mask's bounding box with a margin, at least as large as the SSIM window."""
    slices = []
    for dim, size in enumerate(mask.shape):
        used = mask.any(1 - dim).nonzero()[:, 0]
        low, high = (int(used[0]), int(used[-1]) + 1) if len(used) else (0, size)
        slices.append(slice(max(0, low - CROP_MARGIN), min(size, max(high, low + SSIM_WINDOW) + CROP_MARGIN)))
    return slices[0], slices[1]
