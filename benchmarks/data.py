"""Packed frames against decoding images; streaming a set of the paper's size, of sparse files."""

from __future__ import annotations

import resource
import tempfile
from functools import partial
from pathlib import Path
from statistics import fmean

import numpy as np
import torch

from benchmarks.harness import Options, Row, medians, seconds_of
from gausim.core import Cameras
from gausim.data.frames import ImageSource, PackedSource
from gausim.data.images import write_rgba
from gausim.io.packed import read_packed, view_path, write_header, write_packed
from gausim.io.transforms import write_transforms
from gausim.runs.cost import process_memory

FPS, FRAMES, VIEWS, CROPPED = 24.0, 16, 4, 0.2
# Sequences, frames, views, width and height: the paper's data set, and a quick one.
SETS = {False: (30, 100, 6, 960, 540), True: (3, 20, 2, 96, 54)}
EPOCHS = 3


def run(options: Options) -> list[Row]:
    """Throughput of a training sample, and memory over epochs of a large set."""
    with tempfile.TemporaryDirectory() as folder:
        return _throughput(Path(folder), 64 if options.quick else 512, options) + _large(Path(folder, "large"), options)


def _throughput(folder: Path, size: int, options: Options) -> list[Row]:
    cameras, images, entries = _cameras(VIEWS, size, size), _images(size), []
    for view, name in enumerate(cameras.names):
        (folder / name).mkdir()
        for frame, pixels in enumerate(images[view]):
            write_rgba(folder / name / f"{frame:04d}.png", pixels)
            entries.append({"file_path": f"{name}/{frame:04d}.png", "camera": name, "frame": frame})
    of_entries = cameras.select([v for v in range(VIEWS) for _ in range(FRAMES)])
    write_transforms(folder / "transforms.json", of_entries, entries, fps=FPS)
    write_packed(folder, cameras, list(images), FPS, margin=2)
    frames, columns = range(FRAMES), list(range(VIEWS))
    packed = PackedSource(folder, cameras.names, FPS)
    calls = {
        "image files": lambda: ImageSource(folder, cameras.names, FPS).read(frames, columns),
        "packed": lambda: packed.read(frames, columns),
    }
    times = medians(calls, options)
    case, count = f"{FRAMES} frames x {VIEWS} views of {size} x {size}", FRAMES * VIEWS
    rows = [Row(case, name, count / seconds, "images/s") for name, seconds in times.items()]
    rows.append(Row(case, "packed", times["image files"] / times["packed"], "x", "decoding PNG"))
    return [*rows, Row(case, "stored", read_packed(folder).size / (4 * count * size * size), "1", "whole images")]


def _large(folder: Path, options: Options) -> list[Row]:
    """Opens a set and reads the training frames of every sequence several times."""
    sequences, frames, views, width, height = SETS[options.quick]
    cameras, side = _cameras(views, width, height), CROPPED**0.5
    shape = (frames, int(side * height), int(side * width), 4)
    total = views * int(np.prod(shape))
    for number in range(sequences):
        place = folder / f"seq_{number:03d}"
        place.mkdir(parents=True)
        for view in range(views):
            np.lib.format.open_memmap(view_path(place, view), mode="w+", dtype=np.uint8, shape=shape)
        write_header(place, cameras, [(0, 0)] * views, FPS)
    sources: list[PackedSource] = []
    places, shown = sorted(folder.iterdir()), list(range(min(VIEWS, views)))
    opening = seconds_of(lambda: sources.extend(PackedSource(p, cameras.names, FPS) for p in places), options.device)
    resident, spent = [], []
    for _ in range(EPOCHS):
        calls = [partial(source.read, range(FRAMES), shown) for source in sources]
        spent.append(fmean(seconds_of(call, options.device) for call in calls))
        resident.append(process_memory("VmRSS") or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    case = f"{sequences} sequences x {frames} frames x {views} views of {width} x {height}"
    return [
        Row(case, "size", sequences * total / 1e9, "GB"),
        Row(case, "opening", opening, "s"),
        Row(case, f"sample of {FRAMES} frames x {len(shown)} views", min(spent), "s"),
        Row(case, f"resident memory, epoch {EPOCHS}", resident[-1] / resident[0], "x", "epoch 1"),
    ]


def _cameras(views: int, width: int, height: int) -> Cameras:
    k = torch.tensor([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]])
    return Cameras(
        torch.eye(4).repeat(views, 1, 1), k.repeat(views, 1, 1), width, height, tuple(f"cam_{i}" for i in range(views))
    )


def _images(size: int) -> np.ndarray:
    """(V, F, H, W, 4): a noisy oscillating disc on a fifth of the image."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:size, :size] / size - 0.5
    texture = (60 * np.sin(30 * x) * np.cos(25 * y))[..., None] + rng.normal(120, 6, (VIEWS, size, size, 3))
    images = np.zeros((VIEWS, FRAMES, size, size, 4), np.uint8)
    for frame in range(FRAMES):
        disc = (x - 0.03 * np.sin(0.4 * frame)) ** 2 + y**2 < (0.5 * (CROPPED**0.5) - 0.03) ** 2
        images[:, frame, ..., 3] = 255 * disc
        images[:, frame, ..., :3] = np.clip(texture, 0, 255) * disc[..., None]
    return images
