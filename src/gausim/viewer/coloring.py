"""Colour modes of the kernels: appearance, hierarchy, strain, speed, mass or the learned material."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gausim.core import Frame, GaussianScene
from gausim.models.template.template import Property
from gausim.ops.covariance import transport_covariance
from gausim.ops.spherical_harmonics import C0
from gausim.pictures.kernels import scale_colors, unit_colors
from gausim.render.draw import SceneAppearance, deformed_appearance

VIEW, BASE, STRAIN, SPEED, MASS = (
    "As seen from the camera (SH)", "Base colour (DC)", "Strain", "Velocity", "Mass",
)  # fmt: skip
_SELECTED, _HELD = (1.0, 0.55, 0.1), (0.25, 0.5, 1.0)


@dataclass(frozen=True)
class Legend:
    """Meaning of the colours: one line, and the values at both ends of the scale if there is one."""

    text: str
    low: float | None = None
    high: float | None = None
    unit: str = ""


class Painter:
    """Colours and covariances of the frames of one scene."""

    def __init__(
        self,
        scene: GaussianScene,
        units: Sequence[Int[Tensor, " K"]],
        masses: Float[Tensor, " K"],
        material: Mapping[str, Property] | None = None,
    ) -> None:
        """Takes the scene, its units of levels 1..L, masses, and learned properties of the kernels by name."""
        self._look = SceneAppearance.of(scene.to("cpu"))
        self._masses, self._diagonal = masses.float().cpu(), scene.diagonal
        self._moving = (scene.simulated & ~scene.pinned).cpu()
        self._levels = {f"Hierarchy, level {i} ({int(u.max()) + 1} units)": u for i, u in enumerate(units, 1)}
        self._material = {
            name.capitalize(): replace(found, values=found.values.cpu()) for name, found in (material or {}).items()
        }
        self._highest: dict[str, float] = {}
        self.opacities = self._look.opacities

    @property
    def modes(self) -> tuple[str, ...]:
        """Names of the colour modes."""
        return (VIEW, BASE, *self._levels, STRAIN, SPEED, MASS, *self._material)

    def forget(self) -> None:
        """Restarts the scales, which otherwise extend to the largest value so far."""
        self._highest.clear()

    def __call__(
        self,
        frame: Frame,
        unit_of_kernel: Int[Tensor, " K"],
        speed: Float[Tensor, " K"],
        mode: str,
        eye: Float[Tensor, " 3"],
    ) -> tuple[Float[Tensor, "K 3 3"], Float[Tensor, "K 3"], Legend]:
        """Covariances [scene units^2], colours in [0, 1] and their legend, in one of the :attr:`modes`.

        Speeds are in scene units / s, ``eye`` is the position of the camera [scene units].
        """
        positions, unit = frame.positions.cpu(), unit_of_kernel.cpu()
        deformation_gradients, look = frame.deformation_gradients.cpu(), self._look.to(positions)
        if mode == VIEW:
            covars, rgb = deformed_appearance(
                positions[None], deformation_gradients[None], frame.rotations.cpu()[None], unit, look.covars, look.sh,
                eye[None].to(positions),
            )  # fmt: skip
            return covars[0], rgb[0, 0], Legend("spherical harmonics for the camera that moved last")
        of_kernels = deformation_gradients[unit]
        return transport_covariance(look.covars, of_kernels), *self._value(of_kernels, speed.cpu(), mode)

    def _value(self, deformation_gradients: Tensor, speed: Tensor, mode: str) -> tuple[Tensor, Legend]:
        if mode == STRAIN:
            stretch = torch.linalg.svdvals(deformation_gradients.double()).clamp_min(1e-12).log().abs().amax(-1).float()
            return self._scaled(mode, stretch, "strain: largest |log| of the singular values of G", "")
        if mode == SPEED:
            return self._scaled(mode, speed / self._diagonal, "speed", "diagonals / s")
        if mode == MASS:
            return self._logarithmic(self._masses, self._moving, "mass")
        if mode in self._material:
            found, known = self._material[mode], torch.isfinite(self._material[mode].values)
            rgb, legend = self._logarithmic(found.values, known, found.text)
            return torch.where(known[:, None], rgb, 0.5), legend
        if mode in self._levels:
            return hues(self._levels[mode].cpu()), Legend("one colour per unit of this level; grey: never simulated")
        return (0.5 + C0 * self._look.sh[:, 0]).clamp(0, 1), Legend("base colours, the same from every side")

    def _logarithmic(self, value: Tensor, known: Tensor, text: str) -> tuple[Tensor, Legend]:
        logarithm = value.nan_to_num().clamp_min(1e-12).log10()
        low, high = float(logarithm[known].min()), float(logarithm[known].max())
        colors = scale_colors((logarithm - low) / max(high - low, 1e-6))
        return colors, Legend(f"{text}, logarithm to base 10", low, high)

    def _scaled(self, mode: str, value: Tensor, text: str, unit: str) -> tuple[Tensor, Legend]:
        value = torch.where(self._moving, value, torch.zeros_like(value))
        self._highest[mode] = high = max(self._highest.get(mode, 1e-3), float(value.max()))
        return scale_colors(value / high), Legend(f"{text} (scale: largest so far)", 0.0, high, unit)


def highlighted(rgb: Float[Tensor, "K 3"], selected: Bool[Tensor, " K"], held: Bool[Tensor, " K"]) -> Tensor:
    """Colours, blended with orange for selected kernels and with blue for those pinned by events."""
    rgb = rgb.clone()
    for mask, color, weight in ((selected, _SELECTED, 0.45), (held, _HELD, 0.6)):
        rgb[mask] = rgb[mask] * (1 - weight) + rgb.new_tensor(color) * weight
    return rgb


def hues(units: Int[Tensor, " K"]) -> Float[Tensor, "K 3"]:
    """Distinct colours of neighbouring indices; grey for -1."""
    return torch.where(units[:, None] < 0, 0.5, torch.from_numpy(unit_colors(units.numpy())).float())


def gradient_css() -> str:
    """The scale as a CSS gradient, for the legend."""
    colors = (255 * scale_colors(torch.linspace(0, 1, 6))).int().tolist()
    return "linear-gradient(to right," + ",".join(f"rgb({r},{g},{b})" for r, g, b in colors) + ")"
