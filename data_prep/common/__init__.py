"""Common parts of the stages: atomic results, photos, progress, the command line."""
