"""Errors that a user can act on. Every message states the expectation, the finding and a remedy."""


class GausSimError(Exception):
    """Base of every error that gausim raises on purpose; the command line prints it without a traceback."""


class SceneError(GausSimError):
    """A Gaussian scene or its masks are unusable (file, property and remedy in the message)."""


class DataError(GausSimError):
    """A data set, sequence, view, frame or camera is unusable (file, field and remedy in the message)."""


class ConfigError(GausSimError):
    """A configuration has an unknown key or value, or contradicts itself."""


class RunError(GausSimError):
    """A run directory or checkpoint is unsuitable for the request (finished, another scene, another configuration)."""


class BusyError(RunError):
    """Another process is writing to the run directory."""


class DivergenceError(GausSimError):
    """Training or simulation produced NaN or infinity; the message names the step and the term."""


class FetchError(GausSimError):
    """A published run or data set cannot be fetched: unknown, unreachable, damaged, unsafe, or the disk is full."""
