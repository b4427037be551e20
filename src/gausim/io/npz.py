"""Archives of numpy arrays, read without pickles and with a bound on their size."""

from collections.abc import Collection
from pathlib import Path

import numpy as np

from gausim.core.errors import DataError

# Highest compression ratio of deflate; a member that claims more is damaged.
_MOST_PACKED = 1100


def read_npz(path: Path, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of an npz file, optionally only existing ones of these names, in native byte order.

    Raises:
        ValueError: the file is missing, damaged, not npz, or has other content than arrays; without the file name.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            for info in archive.zip.infolist():
                if info.file_size > _MOST_PACKED * (info.compress_size + 1):
                    raise ValueError(f"member '{info.filename}' claims {info.file_size} bytes")
            arrays = {name: archive[name] for name in archive.files if names is None or name in names}
    except Exception as error:  # numpy raises many kinds of exceptions on damaged files
        raise ValueError(f"expected an archive of arrays ({error or type(error).__name__})") from error
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "biufcSU":
            raise ValueError(f"member '{name}': expected numbers, truth values or texts")
    return {name: array.astype(array.dtype.newbyteorder("="), copy=False) for name, array in arrays.items()}


def read_array(path: Path, field: str) -> np.ndarray:
    """One array of an npz file, of numbers that are finite in float32.

    Raises:
        DataError: the file is missing or damaged, has no such array, or one of anything else; names file and field.
    """
    try:
        arrays = read_npz(path, [field])
    except ValueError as error:
        raise DataError(f"{path}: cannot be read as npz ({error}).") from error
    if field not in arrays:
        raise DataError(f"{path}: array '{field}' is missing.")
    values = arrays[field]
    if values.dtype.kind not in "biuf":
        raise DataError(f"{path}: array '{field}' holds {values.dtype}, expected numbers.")
    with np.errstate(over="ignore"):
        if values.dtype.kind == "f" and not np.isfinite(values.astype(np.float32, copy=False)).all():
            raise DataError(f"{path}: array '{field}' holds values that are no finite numbers in float32.")
    return values
