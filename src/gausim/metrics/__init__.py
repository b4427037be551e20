"""Figures of merit, one small file each; they reduce over ranks."""

from gausim.metrics.error3d import Error3D, point_error
from gausim.metrics.flip import FLIP
from gausim.metrics.image import ImageMetric
from gausim.metrics.l2 import L2, ForegroundL2
from gausim.metrics.lpips import LPIPS
from gausim.metrics.motion_energy import MotionEnergyRatio, motion_energy
from gausim.metrics.psnr import PSNR, ForegroundPSNR
from gausim.metrics.ssim import SSIM

__all__ = [
    "FLIP",
    "L2",
    "LPIPS",
    "PSNR",
    "SSIM",
    "Error3D",
    "ForegroundL2",
    "ForegroundPSNR",
    "ImageMetric",
    "MotionEnergyRatio",
    "motion_energy",
    "point_error",
]
