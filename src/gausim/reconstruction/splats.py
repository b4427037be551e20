"""Trainable Gaussians: raw 3DGS parameters with an Adam optimiser that survives splitting and pruning."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gausim.core.scene import GaussianScene
from gausim.ops.covariance import covariance_from_scales
from gausim.ops.rotation import quaternion_to_matrix
from gausim.ops.spherical_harmonics import C0, evaluate_sh

# 3DGS divides a split kernel's scales by 1.6; along the axis of the split only, that keeps the covered area.
SPLIT_SHRINK = 1.6
# Distance of both halves from the old centre [standard deviations].
SPLIT_OFFSET = 0.6


@dataclass(frozen=True)
class LearningRates:
    """Adam's step sizes per parameter: those of 3DGS, raised for schedules ten times shorter than its 30,000 steps."""

    means: float = 5e-4  # step of the positions [fraction of the scene's diagonal]
    log_scales: float = 1e-2  # step of the log-scales
    quats: float = 3e-3  # step of the quaternions
    opacity: float = 5e-2  # step of the opacity logits
    color: float = 1e-2  # step of the constant colour coefficient
    color_rest: float = 1e-3  # step of the direction-dependent coefficients (3DGS: a twentieth)


class Splats:
    """K Gaussians as leaf tensors, their optimiser, and the records for densification.

    Attributes:
        optimizer: Adam, one group per parameter.
        error: the largest error (K,) from :meth:`note_error` since :meth:`forget`.
        seen: kernels (K,) with a loss gradient other than 0 since :meth:`forget`.
    """

    def __init__(
        self,
        points: Float[Tensor, "K 3"],
        colors: Float[Tensor, "K 3"],
        scale: Float[Tensor, " K"],
        *,
        sh_degree: int,
        opacity: float,
        rates: LearningRates,
        extent: float,
    ) -> None:
        """Balls at ``points`` with standard deviations ``scale``; ``extent`` is the unit of the positions' rate."""
        count = points.shape[0]
        quats = torch.zeros(count, 4)
        quats[:, 0] = 1
        values = {
            "means": points.clone(),
            "log_scales": scale.log()[:, None].repeat(1, 3),
            "quats": quats,
            "opacity": torch.full((count,), math.log(opacity / (1 - opacity))),
            "color": ((colors - 0.5) / C0)[:, None].clone(),
            "color_rest": torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3),
        }
        groups = []
        for name, value in values.items():
            rate = getattr(rates, name) * (extent if name == "means" else 1.0)
            groups.append({"params": [value.float().requires_grad_()], "lr": rate, "base": rate, "name": name})
        self.optimizer = torch.optim.Adam(groups, eps=1e-15)
        self.error, self.seen = torch.zeros(count), torch.zeros(count, dtype=torch.bool)

    def __getitem__(self, name: str) -> Tensor:
        return next(g["params"][0] for g in self.optimizer.param_groups if g["name"] == name)

    @property
    def count(self) -> int:
        """Number of kernels K."""
        return self["means"].shape[0]

    def sh(self) -> Float[Tensor, "K B 3"]:
        """All colour coefficients."""
        return torch.cat((self["color"], self["color_rest"]), 1)

    def scene(self, name: str = "scene") -> GaussianScene:
        """A detached copy as a scene."""
        return GaussianScene.create(
            means=self["means"].detach().clone(),
            log_scales=self["log_scales"].detach().clone(),
            quats=torch.nn.functional.normalize(self["quats"].detach(), dim=-1),
            opacity_logits=self["opacity"].detach().clone(),
            sh=self.sh().detach().clone(),
            name=name,
        )

    def drawable(self, center: Float[Tensor, " 3"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Means, covariances, colours seen from a camera centre, and opacities; differentiable."""
        directions = torch.nn.functional.normalize(self["means"].detach() - center, dim=-1)
        covars = covariance_from_scales(self["log_scales"], self["quats"])
        return self["means"], covars, evaluate_sh(self.sh(), directions), torch.sigmoid(self["opacity"])

    def note_error(self, error: Float[Tensor, " K"]) -> None:
        """Records each kernel's part of an image's error."""
        self.error = torch.maximum(self.error, error)

    def step(self, decay: dict[str, float]) -> None:
        """One Adam step with the base step sizes times ``decay`` (by name, "" for all others)."""
        loss_gradient = self["means"].grad
        if loss_gradient is not None:
            self.seen |= (loss_gradient != 0).any(-1)
        for group in self.optimizer.param_groups:
            group["lr"] = group["base"] * decay.get(group["name"], decay[""])
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)

    @torch.no_grad()
    def keep(self, mask: Bool[Tensor, " K"]) -> None:
        """Drops the kernels outside the mask; the others keep their records."""
        error, seen = self.error[mask], self.seen[mask]
        if not mask.all():
            self._change(lambda value: value[mask])
        self.error, self.seen = error, seen

    @torch.no_grad()
    def split(self, index: Int[Tensor, " n"]) -> None:
        """Splits kernels in two along their longest axis."""
        scales = self["log_scales"][index].exp()
        longest = scales.argmax(-1)
        rows = torch.arange(len(index))
        axis = quaternion_to_matrix(self["quats"][index])[rows, :, longest]
        shift = SPLIT_OFFSET * scales[rows, longest][:, None] * axis
        self["log_scales"][index, longest] -= math.log(SPLIT_SHRINK)
        self["means"][index] += shift
        copies = {g["name"]: g["params"][0][index].clone() for g in self.optimizer.param_groups}
        copies["means"] -= 2 * shift
        self._change(lambda value: value, copies)

    def _change(self, select: Callable[[Tensor], Tensor], copies: dict[str, Tensor] | None = None) -> None:
        """Selects rows of every parameter and of its Adam moments and appends ``copies`` with zero moments."""
        for group in self.optimizer.param_groups:
            old = group["params"][0]
            added = old[:0].detach() if copies is None else copies[group["name"]]
            new = torch.cat((select(old.detach()), added)).requires_grad_()
            state = self.optimizer.state.pop(old, None)
            if state:
                for key in ("exp_avg", "exp_avg_sq"):
                    state[key] = torch.cat((select(state[key]), torch.zeros_like(added)))
                self.optimizer.state[new] = state
            group["params"] = [new]
        self.forget()

    def forget(self) -> None:
        """Resets the records of errors and of seen kernels."""
        self.error, self.seen = torch.zeros(self.count), torch.zeros(self.count, dtype=torch.bool)
