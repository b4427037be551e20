"""Checks of a data set before training, with findings and remedies."""
