"""Figures of merit; those of images reduce over ranks."""

from gausim.metrics.image import L2, PSNR, SSIM, ForegroundL2, ForegroundPSNR, ImageMetric, mask_iou
from gausim.metrics.lpips import LPIPS
from gausim.metrics.motion import Bounce, bounce, chamfer, motion_energy, point_error, track_error

__all__ = [
    "L2", "LPIPS", "PSNR", "SSIM", "Bounce", "ForegroundL2", "ForegroundPSNR", "ImageMetric", "bounce",
    "chamfer", "mask_iou", "motion_energy", "point_error", "track_error",
]  # fmt: skip
