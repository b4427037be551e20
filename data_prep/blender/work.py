"""The work of ``data_prep.blender_bunny``: hands Blender what is missing of a set, and writes what describes it."""

from __future__ import annotations

import itertools
import json
import shutil
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import numpy as np

from data_prep.blender import plan as planned
from data_prep.blender.environment import BlenderError, BlenderProcess
from data_prep.blender.meshes import Surface, make_surface, read_mesh
from data_prep.blender.plan import FPS, Plan, action, intrinsics, sequence_folder
from data_prep.common.progress import Tick
from data_prep.common.stage import PLAN, files_in, write_npz
from gausim.core import DataError
from gausim.io.files import write_json
from gausim.io.npz import read_array

FACTS = "dataset.json"
STILLS_PER_JOB = 20


def make_images(
    mesh: Path, work: Path, plan: Plan, blender: BlenderProcess, *, workers: int, tick: Tick
) -> dict[str, Any]:
    """Makes what is missing of a set in ``work``.

    Returns:
        What the manifest tells: Blender's versions, sequences, number of images, and every file with its hash.

    Raises:
        DataError: the mesh is unusable.
        BlenderError: Blender gave up, or left out a picture.
    """
    surface = make_surface(read_mesh(mesh), mesh, up=plan.up, points=plan.points, seed=plan.seed)
    # Absolute: Blender has a working directory of its own mind.
    root = work.absolute()
    versions = blender.versions()
    _start(root, {**planned.dataset_facts(plan, surface), "blender": versions})
    write_npz(root / "rest_mesh.npz", **vars(surface))
    stills, frames = planned.still_entries(plan, surface), planned.frame_entries(plan, surface)
    parts = [stills[i : i + STILLS_PER_JOB] for i in range(0, len(stills), STILLS_PER_JOB)]
    jobs = [planned.still_job(plan, surface, root, part) for part in parts]
    jobs += [planned.sequence_job(plan, surface, root, number, frames) for number in range(plan.sequences)]
    _run(jobs, blender, workers, tick)
    lens = intrinsics(plan.pictures.still_resolution)
    write_json(root / "static" / "transforms.json", {**lens, "frames": stills})
    video = {**intrinsics(plan.pictures.resolution), "fps": FPS, "frames": frames}
    sequences = []
    for number in range(plan.sequences):
        write_json(sequence_folder(root, number) / "transforms.json", video)
        sequences.append(_describe_sequence(root, plan, surface, number))
    for half in (path for path in root.rglob(".*") if path.is_file()):
        half.unlink()  # of a Blender that was killed
    images = len(stills) + plan.sequences * len(frames)
    return {"blender": versions, "sequences": sequences, "images": images, "files": files_in(root)}


def _start(root: Path, facts: Mapping[str, Any]) -> None:
    """Empties the directory of what another Blender made, whose pictures would not be the same."""
    try:
        same = json.loads((root / FACTS).read_bytes())["blender"] == facts["blender"]
    except (OSError, ValueError, KeyError, TypeError):
        same = False
    if not same:
        for path in root.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
            elif path.name != PLAN:
                path.unlink()
    write_json(root / FACTS, facts)


def _run(jobs: list[dict[str, Any]], blender: BlenderProcess, workers: int, tick: Tick) -> None:
    """Does the jobs, those of interrupted work only in part, several at a time; the first error ends all."""
    stop = threading.Event()
    total = sum(len(job["images"]) for job in jobs)
    left = [job for job in map(_left, jobs) if job is not None]
    done = itertools.count(total - sum(len(job["images"]) for job in left) + 1)

    def told(step: str) -> None:
        if step == "image":
            tick("rendering", next(done), total)

    with ThreadPoolExecutor(workers) as pool:
        pending = [pool.submit(_do, job, blender, told, stop) for job in left]
        try:
            finished, _ = wait(pending, return_when=FIRST_EXCEPTION)
            failed = [future for future in pending if future in finished and future.exception() is not None]
        finally:
            if not all(future.done() for future in pending):
                stop.set()
                pool.shutdown(wait=False, cancel_futures=True)
    if failed:
        failed[0].result()


def _left(job: dict[str, Any]) -> dict[str, Any] | None:
    """The unfinished part of a job; None where it is complete."""
    images = [image for image in job["images"] if not _is_there(Path(image["file"]))]
    moved = job["motion"] is None or _is_there(Path(job["motion"]["file"]))
    return None if moved and not images else {**job, "images": images}


def _is_there(path: Path) -> bool:
    return path.is_file() and path.stat().st_size > 0


def _do(job: dict[str, Any], blender: BlenderProcess, told: Callable[[str], None], stop: threading.Event) -> None:
    blender.run(job, told, stop)
    rest = _left(job)
    if rest is not None:
        missing = [image["file"] for image in rest["images"]] or [job["motion"]["file"]]
        raise BlenderError(f"{missing[0]}: Blender ended without writing it ({len(missing)} files are missing).")


def _describe_sequence(root: Path, plan: Plan, surface: Surface, number: int) -> dict[str, Any]:
    """Writes ``meta.json``; returns what the manifest tells of the sequence."""
    folder = sequence_folder(root, number)
    chosen, (strength, largest) = action(plan, surface, number), _motion(folder / "ground_truth.npz", plan)
    percent = 100 * float(largest.max()) / surface.diagonal
    meta = {
        **chosen, "strength": strength, "largest_displacement_percent": round(percent, 3),
        "largest_displacement_per_frame": [round(float(value), 4) for value in largest],
    }  # fmt: skip
    write_json(folder / "meta.json", meta)
    wanted = round(100 * chosen["amplitude"] / surface.diagonal, 3)
    return {
        "name": folder.name, "kind": chosen["kind"], "amplitude_wanted_percent": wanted,
        "amplitude_percent": round(percent, 3),
    }  # fmt: skip


def _motion(path: Path, plan: Plan) -> tuple[float, np.ndarray]:
    """Strength of the push and the largest displacement (F,) of each frame [scene units]."""
    displacement, strength = (read_array(path, name) for name in ("displacement", "strength"))
    if displacement.ndim != 3 or len(displacement) != plan.frames or strength.shape:
        raise DataError(
            f"{path}: field 'displacement' has shape {displacement.shape}, expected {plan.frames} frames. "
            "Remove it and run the command again."
        )
    return float(strength), np.linalg.norm(displacement, axis=-1).max(1)
