"""Archives of numpy arrays, read without pickles: nothing in them can run."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path

import numpy as np


def read_npz(path: Path, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of an npz file.

    Args:
        path: the file.
        names: only these, where they are there; all when None.

    Raises:
        ValueError: it is missing, no npz, damaged, or holds anything but plain arrays; says why, not which file.
    """
    try:
        with path.open("rb") as file:
            archive = np.load(file, allow_pickle=False)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise ValueError("a single array, expected an archive of arrays")
            arrays = {name: archive[name] for name in archive.files if names is None or name in names}
    except (OSError, EOFError, KeyError, RuntimeError, ValueError, zlib.error, zipfile.BadZipFile) as error:
        raise ValueError(str(error) or type(error).__name__) from error
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray):
            raise ValueError(f"member '{name}' is no array")
    return arrays
