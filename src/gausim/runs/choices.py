"""Hydra's record of the command of a run."""

from pathlib import Path
from typing import Any

from gausim.io.files import read_yaml
from gausim.runs.names import HYDRA


def hydra_record(folder: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """Hydra's record of a job, and the file that it chose of every config group; empty where there is none."""
    try:
        job = dict(read_yaml(folder / HYDRA / "hydra.yaml"))
    except ValueError:
        job = {}
    chosen = dig(job, "hydra", "runtime", "choices")
    return job, {str(k): str(v) for k, v in chosen.items()} if isinstance(chosen, dict) else {}


def dig(node: Any, *keys: str) -> Any:
    """The value in nested dictionaries under these keys; None if there is none."""
    for key in keys:
        node = node.get(key) if isinstance(node, dict) else None
    return node
