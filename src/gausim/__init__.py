"""gausim: learn, compare and play with neural simulators of elastic objects made of 3D Gaussians."""

__version__ = "0.1.0"
