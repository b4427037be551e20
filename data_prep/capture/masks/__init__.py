"""Foreground masks: segmenters, cleaning, and pictures to check them."""
