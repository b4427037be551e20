"""Constants of splatting that all renderers share; they are those of gsplat."""

NEAR = 0.01  # kernels closer than this to the camera plane are dropped [scene units]
DILATION = 0.3  # [pixels^2], low-pass filter of 3DGS
ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.999  # ceiling of a kernel's opacity at a pixel; compiled into gsplat 1.5.3 (0.99 on its main branch)
CLAMP_MARGIN = 0.3  # x/z and y/z are clamped to the field of view widened by this fraction
