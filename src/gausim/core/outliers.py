"""Kernels of a scene that are most likely wrong: far outside of the body, or larger than it."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from gausim.core.errors import SceneError
from gausim.core.scene import GaussianScene

# A kernel so many extents away from the median is alone; a kernel's standard deviation beyond this many is a sky.
FAR, LARGE = 5.0, 1.0
# Typical standard deviation, in extents, from which positive log scales are taken for plain ones.
PLAIN = 0.25
# Spread of opacities between 0 and 1 that logits do not have by chance.
_SPREAD = 0.5
_FEWEST = 4  # kernels, fewer have no extent


@dataclass(frozen=True, eq=False)
class Outliers:
    """Kernels with the same fault."""

    mask: Bool[Tensor, " K"]  # which kernels
    what: str  # the fault in a sentence, with their number and the first of them


def outliers(scene: GaussianScene) -> list[Outliers]:
    """The simulated kernels that are most likely wrong, by fault; none for a sound scene.

    The extent, to which sizes and distances refer, is the diagonal of the box that holds the middle 90 % of the
    simulated kernels along every axis.
    """
    if int(scene.simulated.sum()) < _FEWEST:
        return []
    x = scene.means.double()
    body = x[scene.simulated]
    ends = torch.tensor((5, 50, 95)) * (len(body) - 1) // 100
    low, middle, high = body.sort(0).values[ends]
    extent = float((high - low).norm())
    sizes = scene.log_scales.double().amax(-1).exp()
    if extent == 0:
        return []
    far = scene.simulated & ((x - middle).norm(dim=-1) > FAR * extent)
    large = scene.simulated & (sizes > LARGE * extent)
    typical = float(sizes[scene.simulated].median()) / extent
    if bool((scene.log_scales[scene.simulated] > 0).all()) and typical > PLAIN:
        return [Outliers(scene.simulated, f"all {len(body)} log scales are positive, the typical kernel spans "
            f"{typical:.3g} of the body: scales seem to be stored without the logarithm. Export them as 3DGS does."
        )]  # fmt: skip
    found = [
        (large, f"larger than the body (standard deviation up to {float(sizes.max()) / extent:.3g} of its extent)"),
        (far, f"outside of the body by more than {FAR:g} times its extent"),
    ]
    faults = [
        Outliers(mask, f"{int(mask.sum())} of {scene.count} kernels are {text} (first: number "
                 f"{int(mask.nonzero()[0])}). They distort the diagonal and the masses.")
        for mask, text in found if mask.any()
    ]  # fmt: skip
    opacity = scene.opacity_logits[scene.simulated]
    if bool(((opacity >= 0) & (opacity <= 1)).all()) and float(opacity.max() - opacity.min()) > _SPREAD:
        what = f"all {len(body)} opacities lie between 0 and 1: they seem to be stored without the logit. Export them "
        faults.insert(0, Outliers(torch.zeros_like(scene.simulated), f"{what}as 3DGS does."))
    return faults


def without_outliers(scene: GaussianScene) -> GaussianScene:
    """The scene without them, with the mean kernel volume 1.

    Raises:
        SceneError: nothing is left.
    """
    keep = torch.ones_like(scene.simulated)
    for found in outliers(scene):
        keep &= ~found.mask
    if not keep.any() or not (keep & scene.simulated).any():
        raise SceneError(f"{scene.name}: no kernel is sound. " + " ".join(found.what for found in outliers(scene)))
    left = scene.select(keep)
    return GaussianScene.create(
        means=left.means, log_scales=left.log_scales, quats=left.quats, opacity_logits=left.opacity_logits, sh=left.sh,
        simulated=left.simulated, pinned=left.pinned, foreground=left.foreground, name=scene.name,
    )  # fmt: skip
