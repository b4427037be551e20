"""Images of a static reconstruction for training and measuring: posed RGBA images in sets of one size."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import UInt8
from torch import Tensor
from torch.nn import functional

from gausim.core import Cameras, DataError, GaussianScene, Renderer
from gausim.data.images import composite
from gausim.data.objects import ObjectData
from gausim.data.records import STILLS_PER_HELDOUT, Stills, read_stills
from gausim.metrics.image import PSNR, SSIM, ForegroundPSNR
from gausim.render.draw import draw_still

# Number of images drawn and compared together, limited because photos have several megapixels.
MEASURED_AT_ONCE = 4


@dataclass(frozen=True, eq=False)
class ImageSet:
    """N posed images of one size."""

    name: str  # name of the set in tables
    images: UInt8[Tensor, "N H W 4"]  # straight-alpha RGBA
    cameras: Cameras  # one per image
    weight: float = 1.0  # probability of the set when training draws images, up to a factor
    # first and last step in which training draws from the set [fractions of all steps]
    span: tuple[float, float] = (0.0, 1.0)

    def select(self, index: Sequence[int]) -> "ImageSet":
        """The images at these indices."""
        return replace(self, images=self.images[list(index)], cameras=self.cameras.select(list(index)))


@dataclass(frozen=True, eq=False)
class Material:
    """Training sets (the hull is carved from the first one) and the sets on which the result is measured."""

    train: tuple[ImageSet, ...]
    measure: tuple[ImageSet, ...]


def gather_stills(
    path: Path, *, every: int = STILLS_PER_HELDOUT, longest: int | None = None, coarse: float = 0.0
) -> Material:
    """The stills of the ``transforms.json`` at ``path``; one in ``every`` is not used in training but only measured.

    Larger stills are reduced to ``longest`` [pixels]. ``coarse`` is the fraction of the steps, from the first, on
    stills of half that size, which cost a quarter.

    Raises:
        DataError: fewer than two stills, or an image or pose is unusable.
    """
    stills = read_stills(path, every=every)
    if len(stills.images) < 2:
        raise DataError(f"{path}: {len(stills.images)} stills; expected at least two views of the object.")
    train, left_out = _split(stills, "stills to train on")
    side = max(stills.cameras.width, stills.cameras.height)
    if longest is not None and side > longest:
        train, left_out = reduced(train, longest / side), reduced(left_out, longest / side)
    measured = (left_out, train) if stills.heldout else (left_out,)
    if not coarse:
        return Material((train,), measured)
    half = replace(reduced(train, 0.5), span=(0.0, coarse))
    return Material((half, replace(train, span=(coarse, 1.0))), measured)


def gather_object(data: ObjectData, *, video_fraction: float = 0.5) -> Material:
    """The stills of an object and the first frames of its training views, which show the same rest state.

    Training compares renderings with the video frames, which are often smaller than the stills, and splats are not
    scale-free (their pixel filter is 0.3 pixels^2 at every size). So the fraction ``video_fraction`` of the steps
    (0: stills only) is at the size of the video: a quarter of it on the first frames, the others on the stills
    reduced to that size. Views that are held out are only measured.
    """
    train, left_out = _split(data.stills(), "stills", weight=1 - video_fraction)
    if not (data.root / "sequences").is_dir():
        return Material((train,), (left_out,))
    first, heldout = first_frames(data, data.train_views), first_frames(data, data.heldout_views)
    measured = (left_out, *(s for s in (first, heldout) if s is not None))
    if first is None or video_fraction <= 0:
        return Material((train,), measured)
    factor = first.cameras.width / train.cameras.width
    if factor >= 1:
        return Material((train, replace(first, weight=video_fraction)), measured)
    smaller = replace(reduced(train, factor), weight=0.75 * video_fraction)
    return Material((train, smaller, replace(first, weight=0.25 * video_fraction)), measured)


def first_frames(data: ObjectData, views: Sequence[str]) -> ImageSet | None:
    """Frame 0 of these views in all sequences; of cameras in the same place only the first."""
    images, cameras, places = [], [], set()
    for sequence in data.sequences if views else []:
        here = sequence.cameras_of(views)
        for i, name in enumerate(views):
            place = (name, *here.viewmats[i].flatten().tolist())
            if place not in places:
                places.add(place)
                images.append(sequence.frames(range(1), [name])[0, 0])
                cameras.append(here.select([i]))
    if not images:
        return None
    kind = "frame 0, views to train on" if tuple(views) == data.train_views else "frame 0, views held out"
    joined = Cameras(
        torch.cat([c.viewmats for c in cameras]),
        torch.cat([c.Ks for c in cameras]),
        cameras[0].width,
        cameras[0].height,
        tuple(c.names[0] for c in cameras),
    )
    return ImageSet(kind, torch.stack(images), joined)


def reduced(images: ImageSet, factor: float) -> ImageSet:
    """The set and its cameras at ``factor`` < 1 of the size, by area means of premultiplied colours."""
    cameras = images.cameras
    width, height = (max(1, round(length * factor)) for length in (cameras.width, cameras.height))
    values = images.images.permute(0, 3, 1, 2).float()
    premultiplied = torch.cat((values[:, :3] * values[:, 3:] / 255, values[:, 3:]), 1)
    mean = functional.adaptive_avg_pool2d(premultiplied, (height, width))
    straight = torch.cat((mean[:, :3] * 255 / mean[:, 3:].clamp_min(1e-3), mean[:, 3:]), 1)
    pixels = straight.round().clamp(0, 255).to(torch.uint8).permute(0, 2, 3, 1).contiguous()
    scale = torch.tensor([width / cameras.width, height / cameras.height, 1.0])
    smaller = replace(cameras, Ks=cameras.Ks * scale[:, None], width=width, height=height)
    return replace(images, images=pixels, cameras=smaller)


def measure(scene: GaussianScene, renderer: Renderer, images: ImageSet) -> dict[str, float]:
    """PSNR [dB] of the whole image and of the foreground, and SSIM, over black: means over the images."""
    metrics = (PSNR(), ForegroundPSNR(), SSIM())
    for start in range(0, len(images.images), MEASURED_AT_ONCE):
        part = images.select(range(start, min(start + MEASURED_AT_ONCE, len(images.images))))
        truth, alpha = composite(part.images)
        drawn = draw_still(renderer, scene, part.cameras).rgb[0].clamp(0, 1)
        for metric in metrics:
            metric.update(drawn, truth, alpha > 0)
    return {metric.key: float(metric.compute()) for metric in metrics}


def _split(stills: Stills, name: str, *, weight: float = 1.0) -> tuple[ImageSet, ImageSet]:
    """The stills to train on, and those left out; of fewer than ten none is, all are used in training and measured."""
    train = ImageSet(name, stills.images, stills.cameras, weight).select(stills.train)
    if not stills.heldout:
        return train, replace(train, name="stills (all used, none left out)")
    return train, ImageSet("stills left out", stills.images, stills.cameras).select(stills.heldout)
