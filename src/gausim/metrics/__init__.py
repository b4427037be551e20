"""Figures of merit, one small file each; those of images reduce over ranks."""

from gausim.metrics.flip import FLIP
from gausim.metrics.image import ImageMetric
from gausim.metrics.l2 import L2, ForegroundL2
from gausim.metrics.lpips import LPIPS
from gausim.metrics.motion import motion_energy, point_error
from gausim.metrics.psnr import PSNR, ForegroundPSNR
from gausim.metrics.ssim import SSIM

__all__ = [
    "FLIP",
    "L2",
    "LPIPS",
    "PSNR",
    "SSIM",
    "ForegroundL2",
    "ForegroundPSNR",
    "ImageMetric",
    "motion_energy",
    "point_error",
]
