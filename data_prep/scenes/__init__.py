"""Scenes of kernels: selections as texts, and the layout of READY."""
