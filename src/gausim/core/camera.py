"""Calibrated pinhole cameras, OpenCV convention."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core.errors import DataError

# A rotation read from six-digit text is orthonormal to about 1e-5; 1e-3 still distinguishes it from scale or shear.
ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class Cameras:
    """V cameras of one image size."""

    viewmats: Float[Tensor, "V 4 4"]  # world to camera, x right, y down, z forward (OpenCV)
    Ks: Float[Tensor, "V 3 3"]  # intrinsics [pixels]; pixel (i, j) has its centre at (i + 0.5, j + 0.5)
    width: int  # image width [pixels]
    height: int  # image height [pixels]
    names: tuple[str, ...]  # one name per view, as in the data set

    def validated(self, source: str) -> "Cameras":
        """Returns itself, or raises :class:`DataError` naming ``source`` and the camera with an invalid pose."""
        r = self.viewmats[:, :3, :3].double()
        error = (r @ r.mT - torch.eye(3, dtype=r.dtype)).abs().amax((-1, -2))
        for i, name in enumerate(self.names):
            if not torch.isfinite(error[i]) or error[i] > ROTATION_TOLERANCE or torch.det(r[i]) < 0:
                raise DataError(
                    f"{source}: transform_matrix of '{name}' is not a rotation plus a translation "
                    f"(R R^T - I up to {float(error[i]):.3g}, det {float(torch.det(r[i])):.3g}; expected 0 and 1). "
                    "Remove scale and reflection from the pose."
                )
            if not torch.isfinite(self.viewmats[i]).all() or not torch.isfinite(self.Ks[i]).all():
                raise DataError(f"{source}: pose or lens of '{name}' holds numbers beyond float32. Export it again.")
        return self

    @property
    def centers(self) -> Float[Tensor, "V 3"]:
        """Camera centres in the world [scene units]."""
        r, t = self.viewmats[:, :3, :3], self.viewmats[:, :3, 3]
        return -(r.mT @ t[..., None])[..., 0]

    def select(self, index: list[int]) -> "Cameras":
        """The cameras at these indices, in that order."""
        return Cameras(
            self.viewmats[index], self.Ks[index], self.width, self.height, tuple(self.names[i] for i in index)
        )

    def to(self, device: torch.device | str) -> "Cameras":
        """The same cameras on another device."""
        return Cameras(self.viewmats.to(device), self.Ks.to(device), self.width, self.height, self.names)
