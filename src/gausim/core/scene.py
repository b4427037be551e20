"""The rest scene: 3D Gaussians with masks of simulated, pinned and foreground kernels."""

from dataclasses import dataclass, field, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gausim.core.errors import SceneError
from gausim.core.surroundings import Surroundings

SH_COEFFICIENTS = {0: 1, 1: 4, 2: 9, 3: 16}


LAWS = ("solid", "springs")


@dataclass(frozen=True, eq=False)
class GaussianScene:
    """K Gaussians exactly as a 3DGS file stores them (raw parameters, neither activated nor normalised)."""

    means: Float[Tensor, "K 3"]  # rest positions X [scene units]
    # natural logarithm of the standard deviations along the principal axes [log scene units]
    log_scales: Float[Tensor, "K 3"]
    quats: Float[Tensor, "K 4"]  # orientation, w x y z, any non-zero length
    opacity_logits: Float[Tensor, " K"]  # opacity before the sigmoid
    sh: Float[Tensor, "K B 3"]  # spherical-harmonics colour coefficients, ((d+1)^2, RGB) per kernel, d = 0..3
    simulated: Bool[Tensor, " K"]  # kernels that the dynamics may move; the others stay in place and are rendered
    pinned: Bool[Tensor, " K"]  # simulated kernels that are held at their rest position (the roots)
    foreground: Bool[Tensor, " K"]  # kernels that are compared with segmented video
    volume_scale: float = 1.0  # c of V = prod(c s_i) (METHOD section 1), so that the mean kernel mass is of order 1
    name: str = "scene"  # name of the scene in messages, tables and checkpoints
    surroundings: Surroundings = field(default_factory=Surroundings)  # what acts on the body besides its own elasticity
    # the hand that holds each pinned kernel, -1 for those that nobody moves; None: there are no hands
    hand: Int[Tensor, " K"] | None = None
    # law of large deformations, one of :data:`LAWS`: finite strain of a solid body, or a net of springs
    law: str = "solid"

    @staticmethod
    def create(
        *,
        means: Tensor,
        log_scales: Tensor,
        quats: Tensor,
        opacity_logits: Tensor,
        sh: Tensor,
        simulated: Tensor | None = None,
        pinned: Tensor | None = None,
        foreground: Tensor | None = None,
        volume_scale: float | None = None,
        name: str = "scene",
    ) -> "GaussianScene":
        """Builds a scene; masks default to all simulated, none pinned, all foreground.

        The default ``volume_scale`` makes the mean kernel volume, and with unit density the mean mass, 1.
        """
        count = means.shape[0]
        every = torch.ones(count, dtype=torch.bool, device=means.device)
        if volume_scale is None:
            volume_scale = float(torch.exp(log_scales.double().sum(-1)).mean()) ** (-1 / 3) if count else 1.0
        scene = GaussianScene(
            means=means,
            log_scales=log_scales,
            quats=quats,
            opacity_logits=opacity_logits,
            sh=sh,
            simulated=every if simulated is None else simulated,
            pinned=~every if pinned is None else pinned,
            foreground=every if foreground is None else foreground,
            volume_scale=volume_scale,
            name=name,
        )
        return scene.validated()

    @property
    def count(self) -> int:
        """Number of kernels K."""
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Degree d of the spherical harmonics, 0..3."""
        return {n: d for d, n in SH_COEFFICIENTS.items()}[self.sh.shape[1]]

    @property
    def diagonal(self) -> float:
        """Length of the simulated kernels' bounding-box diagonal [scene units]; all radii are fractions of it."""
        x = self.means[self.simulated]
        return float((x.amax(0) - x.amin(0)).norm())

    def validated(self) -> "GaussianScene":
        """Returns itself, or raises :class:`SceneError` naming the field that is wrong."""
        if self.count == 0:
            raise SceneError(f"{self.name}: expected at least one Gaussian, got none.")
        if self.sh.shape[1] not in SH_COEFFICIENTS.values():
            raise SceneError(
                f"{self.name}: field 'sh' has {self.sh.shape[1]} coefficients per channel; expected 1, 4, 9 or 16."
            )
        for name in ("means", "log_scales", "quats", "opacity_logits", "sh"):
            value = getattr(self, name)
            bad = ~torch.isfinite(value).reshape(self.count, -1).all(-1)
            if bad.any():
                raise SceneError(
                    f"{self.name}: field '{name}' is NaN or infinite for {int(bad.sum())} of {self.count} Gaussians "
                    f"(first: number {int(bad.nonzero()[0])}). Remove them or repair the reconstruction."
                )
        zero = self.quats.norm(dim=-1) == 0
        if zero.any():
            raise SceneError(
                f"{self.name}: field 'quats' is zero for {int(zero.sum())} of {self.count} Gaussians "
                f"(first: number {int(zero.nonzero()[0])}); a rotation needs a non-zero quaternion."
            )
        if (self.pinned & ~self.simulated).any():
            raise SceneError(f"{self.name}: mask 'pinned' marks kernels that mask 'simulated' leaves out.")
        return self

    def select(self, mask: Bool[Tensor, " K"]) -> "GaussianScene":
        """The sub-scene of the kernels where ``mask`` holds, in the same order."""
        return replace(self, **{n: x[mask] for n in self._tensor_names() if (x := getattr(self, n)) is not None})

    def to(self, device: torch.device | str) -> "GaussianScene":
        """The same scene on another device."""
        return replace(self, **{n: x.to(device) for n in self._tensor_names() if (x := getattr(self, n)) is not None})

    @classmethod
    def _tensor_names(cls) -> list[str]:
        return [f.name for f in fields(cls) if f.name not in ("volume_scale", "name", "surroundings", "law")]
