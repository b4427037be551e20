"""Foreground masks: what makes them, what cleans them, pictures to check them."""
