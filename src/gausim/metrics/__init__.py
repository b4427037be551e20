"""Figures of merit, one small file each; those of images reduce over ranks."""

from gausim.metrics.bounce import Bounce, bounce
from gausim.metrics.chamfer import chamfer
from gausim.metrics.flip import FLIP
from gausim.metrics.image import ImageMetric, mask_iou
from gausim.metrics.l2 import L2, ForegroundL2
from gausim.metrics.lpips import LPIPS
from gausim.metrics.motion import motion_energy, point_error, track_error
from gausim.metrics.psnr import PSNR, ForegroundPSNR
from gausim.metrics.ssim import SSIM

__all__ = [
    "FLIP",
    "L2",
    "LPIPS",
    "PSNR",
    "SSIM",
    "Bounce",
    "ForegroundL2",
    "ForegroundPSNR",
    "ImageMetric",
    "bounce",
    "chamfer",
    "mask_iou",
    "motion_energy",
    "point_error",
    "track_error",
]
