"""Differentiable rendering of Gaussians; renderers are interchangeable (core.Renderer)."""
