"""Differentiable rendering of Gaussians; renderers are interchangeable (core.Renderer)."""

from gausim.render.draw import SceneAppearance, draw, draw_still, draw_trajectory, film, to_bytes

__all__ = ["SceneAppearance", "draw", "draw_still", "draw_trajectory", "film", "to_bytes"]
