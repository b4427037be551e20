"""A finished object is checked as `gausim verify` does, before it takes its name."""

from __future__ import annotations

from pathlib import Path

from gausim.core.errors import DataError

MOST_FAULTS = 5


def refuse_faults(work: Path, out: Path) -> None:
    """Raises :class:`DataError` with the first faults of the object in ``work``, which is to become ``out``."""
    from gausim.data.verify import verify

    faults = verify(work)
    if faults:
        shown = [f"{fault.where}: {fault.what.replace(str(work), str(out))}" for fault in faults]
        more = f" And {len(faults) - MOST_FAULTS} more." if len(faults) > MOST_FAULTS else ""
        raise DataError(f"{out}: the object would have faults:\n  " + "\n  ".join(shown[:MOST_FAULTS]) + more)
