"""The fast CPU renderer."""

from gausim.render.cpu.renderer import CpuRenderer

__all__ = ["CpuRenderer"]
