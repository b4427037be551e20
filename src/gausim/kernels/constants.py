"""Constants of both forms of an operation."""

# (k L)^2 of Wang et al. 2004 with k = 0.01, 0.03 and L = 1.
SSIM_C1, SSIM_C2 = 1e-4, 9e-4
