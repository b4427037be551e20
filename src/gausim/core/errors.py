"""Errors a user can act on. Every message says what was expected, what was found and what to do about it."""


class GausSimError(Exception):
    """Base of every error that gausim raises on purpose; the command line prints it without a traceback."""


class SceneError(GausSimError):
    """A Gaussian scene or its masks are unusable (file, property and remedy in the message)."""


class DataError(GausSimError):
    """A data set, sequence, view, frame or camera is unusable (file, field and remedy in the message)."""


class ConfigError(GausSimError):
    """A configuration names something unknown or contradicts itself."""


class RunError(GausSimError):
    """A run directory or checkpoint cannot be used as asked (finished, of another scene, of another config)."""


class BusyError(RunError):
    """Another process works in the run directory, which is left to it."""


class DivergenceError(GausSimError):
    """Training or simulation left the finite numbers; the message names the step and the term that broke."""


class FetchError(GausSimError):
    """A published run or data set cannot be had: unknown, out of reach, damaged, unsafe, or no room for it."""
