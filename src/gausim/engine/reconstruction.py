"""Static reconstruction: the Gaussians of the rest scene from posed RGBA stills, through any renderer."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from gausim.core import ConfigError, DataError, DivergenceError, GaussianScene, Renderer
from gausim.data.images import composite
from gausim.engine.splats import LearningRates, Splats
from gausim.engine.stills import ImageSet
from gausim.losses.image import structural_similarity
from gausim.ops.visual_hull import VoxelHull, carve, farthest_points, project

# Adam's step sizes fall to these shares of their start, exponentially: positions as in 3DGS, the rest less.
FINAL_MEANS_RATE = 0.01
FINAL_RATE = 0.1
SSIM_WINDOW = 11
# Opaque foreground is what initial colours are read from; the rim mixes in what lies behind.
OPAQUE = 200
# Pixels around the masks' bounding box that the structural loss sees as well.
CROP_MARGIN = 6


@dataclass(frozen=True)
class ReconstructionOptions:
    """What a reconstruction is made with.

    Attributes:
        kernels: number of kernels aimed at (pruning may leave fewer).
        iterations: optimiser steps, one image each.
        sh_degree: degree of the spherical harmonics, 0..3.
        hull_resolution: voxels along the longest side of the visual hull.
        hull_margin: voxels by which a kernel's centre may leave the hull.
        start_share: share of the kernels placed at the start; splitting adds the rest.
        rounds: times that kernels are pruned and split.
        minimum_opacity: kernels below are pruned.
        maximum_scale: ceiling of a standard deviation [mean distances between neighbours at the start].
        ssim_weight: share of D-SSIM against L1 (3DGS: 0.2).
        alpha_weight: weight of the L1 error of alpha against the mask.
        anisotropy_limit: r of the penalty mean(max(s_max / s_min, r) - r) (PhysGaussian).
        anisotropy_weight: its weight.
        random_background: composite over a random colour in every step instead of black.
        seed: of everything random.
        rates: Adam's step sizes.
    """

    kernels: int = 2000
    iterations: int = 4000
    sh_degree: int = 1
    hull_resolution: int = 96
    hull_margin: int = 1
    start_share: float = 0.6
    rounds: int = 8
    minimum_opacity: float = 0.05
    maximum_scale: float = 1.5
    ssim_weight: float = 0.2
    alpha_weight: float = 0.2
    anisotropy_limit: float = 3.0
    anisotropy_weight: float = 0.02
    random_background: bool = True
    seed: int = 0
    rates: LearningRates = field(default_factory=LearningRates)

    def __post_init__(self) -> None:
        """Checks the ranges, or raises :class:`ConfigError`."""
        for name in ("kernels", "iterations", "hull_resolution"):
            if getattr(self, name) < 1:
                raise ConfigError(f"reconstruction: {name} must be at least 1, got {getattr(self, name)}.")
        if self.sh_degree not in (0, 1, 2, 3):
            raise ConfigError(f"reconstruction: sh_degree must be 0, 1, 2 or 3, got {self.sh_degree}.")


def reconstruct(
    sets: Sequence[ImageSet],
    renderer: Renderer,
    options: ReconstructionOptions,
    *,
    points: Float[Tensor, "P 3"] | None = None,
    name: str = "scene",
    progress: Callable[[int, dict[str, float]], None] | None = None,
) -> GaussianScene:
    """Fits Gaussians to images by L1 + D-SSIM + mask loss (3DGS, with the mask against floaters).

    Kernels start on the surface of the visual hull (or on given points), are split where the images pull most and
    pruned where they are transparent, never seen or outside the hull: the dynamics moves every kernel that is left.

    Args:
        sets: training images; the hull is carved from the first set.
        renderer: what draws the Gaussians.
        options: see there.
        points: where to start instead of the hull's surface [scene units].
        name: name of the scene.
        progress: called after every step with its number and {"loss": ..., "kernels": ...}.

    Returns:
        The scene: all kernels simulated and foreground, none pinned.

    Raises:
        DataError: no body projects into all masks.
        DivergenceError: the loss stopped being finite.
    """
    generator = torch.Generator().manual_seed(options.seed)
    first = sets[0]
    masks = first.images[..., 3] > 0
    hull = carve(masks, first.cameras.viewmats, first.cameras.Ks, options.hull_resolution)
    if hull is None:
        raise DataError(
            f"{name}: the visual hull of {len(masks)} masks is empty; expected a body that all views see. "
            "Check that the alpha channel is the object's mask and that the poses belong to the images."
        )
    splats, spacing = _initial_splats(first, hull, options, points)
    hull = hull.dilated(options.hull_margin)
    rounds = _round_steps(options)
    for step, (image_set, i) in enumerate(_draw(sets, options.iterations, generator)):
        loss = _loss(splats, renderer, image_set, i, options, generator)
        if not math.isfinite(float(loss.detach())):
            raise DivergenceError(f"{name}: reconstruction loss is {float(loss)} at step {step}. Lower the rates.")
        loss.backward()
        done = step / options.iterations
        splats.step({"means": FINAL_MEANS_RATE**done, "": FINAL_RATE**done})
        _limit_scales(splats, options.maximum_scale * spacing)
        if step in rounds:
            _prune(splats, hull, options)
            _densify(splats, options.kernels, rounds.index(step), len(rounds))
            splats.forget()
        if progress is not None:
            progress(step, {"loss": float(loss.detach()), "kernels": splats.count})
    splats.keep(_inside(splats, hull) & (torch.sigmoid(splats["opacity"]) > options.minimum_opacity))
    return splats.scene(name)


def _draw(sets: Sequence[ImageSet], steps: int, generator: torch.Generator) -> Iterator[tuple[ImageSet, int]]:
    """Draws images: the set by its share, within a set every image once before any comes again."""
    shares = torch.tensor([s.share for s in sets])
    queues: list[list[int]] = [[] for _ in sets]
    for _ in range(steps):
        k = int(torch.multinomial(shares, 1, generator=generator))
        if not queues[k]:
            queues[k] = torch.randperm(len(sets[k].images), generator=generator).tolist()
        yield sets[k], queues[k].pop()


def _round_steps(options: ReconstructionOptions) -> list[int]:
    """Steps after which kernels are pruned and split: between 10 % and 70 % of the way."""
    first, last = 0.1 * options.iterations, 0.7 * options.iterations
    return sorted({int(first + (last - first) * i / max(1, options.rounds - 1)) for i in range(options.rounds)})


def _initial_splats(
    images: ImageSet, hull: VoxelHull, options: ReconstructionOptions, points: Tensor | None
) -> tuple[Splats, float]:
    """Balls spread over the surface (or the given points), and their mean distance to their neighbours."""
    surface, normals = hull.surface()
    if points is not None:
        normals = torch.zeros_like(points)
        surface = points.float()
    index = farthest_points(surface, max(2, round(options.start_share * options.kernels)))
    chosen, normals = surface[index], normals[index]
    distance = torch.cdist(chosen, chosen).topk(min(4, len(chosen)), largest=False).values[:, 1:].mean(-1)
    splats = Splats(
        chosen,
        _surface_colors(chosen, normals, images),
        0.6 * distance.clamp_min(1e-3 * hull.spacing),
        sh_degree=options.sh_degree,
        opacity=0.8,
        rates=options.rates,
        extent=hull.diagonal,
    )
    return splats, float(distance.mean())


def _surface_colors(
    points: Float[Tensor, "K 3"], normals: Float[Tensor, "K 3"], images: ImageSet
) -> Float[Tensor, "K 3"]:
    """Mean colour over the views that a point's normal faces; occlusion by other parts is left to the optimiser."""
    pixels, _ = project(points, images.cameras.viewmats, images.cameras.Ks)
    total, weight = torch.zeros_like(points), torch.full((len(points), 1), 1e-6)
    mean = images.images[..., :3][images.images[..., 3] > OPAQUE].float().mean(0) / 255
    for view, center in enumerate(images.cameras.centers):
        x, y = pixels[view].floor().long().unbind(-1)
        x, y = x.clamp(0, images.cameras.width - 1), y.clamp(0, images.cameras.height - 1)
        rgba = images.images[view, y, x]
        facing = (normals * functional.normalize(center - points, dim=-1)).sum(-1).clamp_min(1e-3)
        w = (facing**4 * (rgba[:, 3] > OPAQUE))[:, None]
        total, weight = total + w * rgba[:, :3].float() / 255, weight + w
    return (total + 1e-6 * mean) / weight


def _loss(
    splats: Splats,
    renderer: Renderer,
    images: ImageSet,
    i: int,
    options: ReconstructionOptions,
    generator: torch.Generator,
) -> Tensor:
    cameras = images.cameras
    background = torch.rand(3, generator=generator) if options.random_background else torch.zeros(3)
    means, covars, colors, opacities = splats.drawable(cameras.centers[i])
    size = (cameras.width, cameras.height)
    camera = cameras.viewmats[None, i : i + 1], cameras.Ks[None, i : i + 1]
    drawn = renderer(
        means[None], covars[None], colors[None, None], opacities[None], *camera, size, background=background
    )
    rgb, alpha = drawn.rgb[0, 0], drawn.alpha[0, 0]
    truth, mask = composite(images.images[i], background)
    loss = (1 - options.ssim_weight) * (rgb - truth).abs().mean() + options.alpha_weight * (alpha - mask).abs().mean()
    if options.ssim_weight > 0:
        rows, columns = _crop(mask > 0)
        first, second = (x[rows, columns].permute(2, 0, 1).contiguous() for x in (rgb, truth))
        share = first[0].numel() / mask.numel()  # outside the crop both are background: D-SSIM is about zero there
        similarity = structural_similarity(first, second, SSIM_WINDOW).mean()
        loss = loss + options.ssim_weight * share * (1 - similarity) / 2
    ratio = (splats["log_scales"].amax(-1) - splats["log_scales"].amin(-1)).exp()
    return loss + options.anisotropy_weight * (ratio - options.anisotropy_limit).clamp_min(0).mean()


def _crop(mask: Bool[Tensor, "H W"]) -> tuple[slice, slice]:
    """Rows and columns of the mask's bounding box with a margin, at least as large as the SSIM window."""
    slices = []
    for dim, size in enumerate(mask.shape):
        used = mask.any(1 - dim).nonzero()[:, 0]
        low, high = (int(used[0]), int(used[-1]) + 1) if len(used) else (0, size)
        slices.append(slice(max(0, low - CROP_MARGIN), min(size, max(high, low + SSIM_WINDOW) + CROP_MARGIN)))
    return slices[0], slices[1]


@torch.no_grad()
def _limit_scales(splats: Splats, ceiling: float) -> None:
    splats["log_scales"].clamp_max_(math.log(ceiling))


def _inside(splats: Splats, hull: VoxelHull) -> Bool[Tensor, " K"]:
    return hull.contains(splats["means"].detach())


def _prune(splats: Splats, hull: VoxelHull, options: ReconstructionOptions) -> None:
    opaque = torch.sigmoid(splats["opacity"].detach()) > options.minimum_opacity
    keep = opaque & splats.seen & _inside(splats, hull)
    if keep.sum() < 2:
        raise DivergenceError(
            f"reconstruction: only {int(keep.sum())} of {splats.count} kernels are left after pruning (opaque: "
            f"{int(opaque.sum())}, seen: {int(splats.seen.sum())}). Check masks and poses, or take more iterations."
        )
    splats.keep(keep)


def _densify(splats: Splats, budget: int, done: int, rounds: int) -> None:
    """Splits the kernels that the images pull most, so that the last round but one reaches the budget."""
    missing = budget - splats.count
    count = min(math.ceil(missing / max(1, rounds - 1 - done)), splats.count)
    if count > 0 and done < rounds - 1:
        splats.split(splats.pull.topk(count).indices)
