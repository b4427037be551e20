"""A small elastic column and an interaction with it."""

from helpers.column import make_column, make_interaction, make_simulator  # noqa: F401
