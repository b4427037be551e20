"""Functions and kernels that Warp compiles for the CPU and CUDA. Importing anything here imports Warp."""
