"""Errors that a user can act on. Every message states the expectation, the finding and a remedy."""

import errno
import re

# Names that gausim.io.files.replacing makes.
_TEMPORARY = re.compile(r"(?<![^/\\])\.([^/\\]+)\.[0-9]+\.tmp(?:\.\w+)?$")
_REMEDIES = {
    errno.ENOSPC: "Make room on the disk.",
    errno.EFBIG: "Choose a disk that takes larger files, or raise the limit (`ulimit -f`).",
    errno.EDQUOT: "Make room: the quota is used up.",
    errno.EACCES: "Correct the permissions, or choose another path.",
    errno.EPERM: "Correct the permissions, or choose another path.",
    errno.EROFS: "The disk is write-protected; choose another path.",
    errno.ENAMETOOLONG: "Choose a shorter path.",
}


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


def sentence(error: Exception) -> str | None:
    """One line on an error that a user can act on; None for a defect of gausim.

    Errors of the operating system name their file. Errors of encodings and of values come from libraries that read
    the user's files; the traceback says which.
    """
    if isinstance(error, GausSimError):
        return str(error)
    if isinstance(error, OSError):
        named = (error.filename, error.filename2)
        # A temporary file stands for the file whose name it takes at last.
        place = " -> ".join(_TEMPORARY.sub(r"\1", str(name)) for name in named if name is not None)
        cause = error.strerror or str(error) or type(error).__name__
        remedy = _REMEDIES.get(error.errno or 0, "Check the path.") if place else _REMEDIES.get(error.errno or 0, "")
        return " ".join(f"{place + ': ' if place else ''}{cause}. {remedy}".split())
    if isinstance(error, UnicodeError):
        return f"text is not in the expected encoding ({error}). Save the file as UTF-8. {_TRACEBACK}"
    if isinstance(error, ValueError):
        return f"{' '.join(str(error).split()) or 'a value is wrong'} (ValueError). {_TRACEBACK}"
    return None


_TRACEBACK = "GAUSIM_DEBUG=1 in the environment shows where."
