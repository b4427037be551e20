"""Lenses of COLMAP's models: where they see a direction, and photos without their distortion."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from data_prep.common.colmap import ColmapCamera
from data_prep.common.photos import premultiplied, straight
from gausim.core.errors import DataError

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, eq=False)
class Straightened:
    """A pinhole camera and the way to it."""

    intrinsics: np.ndarray  # (3, 3) float64 K of the pinhole camera [pixels]; its image has the size of the photo
    # (H, W) float32 columns and rows of the photo that its pixels show; None where nothing changes
    maps: tuple[np.ndarray, np.ndarray] | None

    def __call__(self, pixels: np.ndarray) -> np.ndarray:
        """The (H, W, 4) uint8 RGBA photo without distortion; colours under alpha 0 do not bleed into the rest."""
        if self.maps is None:
            return pixels
        # Lanczos rings at hard edges of a mask, and photos seldom need more than two pixels of a neighbourhood.
        if pixels[..., 3].min() == 255:
            return cv2.remap(pixels, *self.maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        bent = premultiplied(pixels)
        return straight(cv2.remap(bent, *self.maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT))


def lens(camera: ColmapCamera) -> pycolmap.Camera:
    """The same camera as pycolmap's, which has the formulas of all models."""
    import pycolmap

    return pycolmap.Camera(model=camera.model, width=camera.width, height=camera.height, params=camera.params.tolist())


def straighten(camera: ColmapCamera, where: Path) -> Straightened:
    """The pinhole camera of the photo's size whose image the lens fills to the last pixel.

    COLMAP's undistortion chooses focal length and size so that no pixel is blank; that image is magnified until it
    covers the photo's size, and cropped to it around its middle. So all photos of one size stay of one size.
    """
    import pycolmap

    if not camera.distorted:
        fx, fy, cx, cy = camera.intrinsics
        return Straightened(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), None)
    options = pycolmap.UndistortCameraOptions()
    options.blank_pixels = 0.0
    bent, what = lens(camera), f"{where}: a {camera.model} camera {camera.params.tolist()} cannot be undistorted"
    try:
        pinhole = pycolmap.undistort_camera(options, bent)
        k = np.array(pinhole.calibration_matrix())
    except (RuntimeError, ValueError) as error:
        raise DataError(f"{what} ({error}).") from error
    grow = max(camera.width / pinhole.width, camera.height / pinhole.height)
    k[:2] *= grow
    k[0, 2] -= (pinhole.width * grow - camera.width) / 2
    k[1, 2] -= (pinhole.height * grow - camera.height) / 2
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack(((x - k[0, 2]) / k[0, 0], (y - k[1, 2]) / k[1, 1], np.ones_like(x)), -1).reshape(-1, 3)
    seen = np.asarray(bent.img_from_cam(np.ascontiguousarray(rays))).reshape(*x.shape, 2) - 0.5
    if not (np.isfinite(k).all() and np.isfinite(seen).all() and k[0, 0] > 0 and k[1, 1] > 0):
        raise DataError(f"{what}: its lens folds over. Calibrate it again, with a simpler model.")
    maps = tuple(np.ascontiguousarray(seen[..., i], np.float32) for i in (0, 1))
    return Straightened(k, (maps[0], maps[1]))
