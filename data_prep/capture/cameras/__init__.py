"""Poses: found or taken over, without distortion, in a world with an up and a scale."""
