"""Makes README's moving picture from runs of one object: the video, predictions, and their errors beneath.

    python docs/pictures.py docs/images/comparison.gif gausim=RUN spring-mass=RUN physdreamer=RUN --sequence seq_001

The time line turns orange where the frames end that training has seen.
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import torch
from matplotlib.figure import Figure

from gausim.compose.build import load_run
from gausim.compose.predict import run_object
from gausim.data.images import composite
from gausim.io.video import write_gif
from gausim.metrics.motion import point_error
from gausim.pictures.figures import METHOD_COLORS, SEEN_SHADE
from gausim.pictures.frames import SEEN, UNSEEN
from gausim.render.draw import film, to_bytes
from gausim.training.supervision.points import attach_points

LABEL, PLOT, LINE = 24, 110, 6
WHITE = torch.ones(3)


def predictions(
    runs: dict[str, Path], sequence: str, view: str
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], int, float]:
    """Films (F, H, W, 3), 3D errors per frame [% of the diagonal], the first unseen frame, and the frame rate."""
    films: dict[str, np.ndarray] = {}
    errors: dict[str, np.ndarray] = {}
    for label, path in runs.items():
        item = run_object(load_run(path))
        record, scene = item.sequence(sequence), item.scene
        truth, predicted = item.data.ground_truth(record), item(record)
        if truth is None:
            raise SystemExit(f"{record.root}: expected true positions (ground_truth.npz).")
        kernels = attach_points(scene, truth.rest)
        if not films:
            frames = record.frames(range(record.count), [view])[:, 0]
            films["video"] = to_bytes(composite(frames, WHITE)[0]).numpy()
            still = truth.rest.expand_as(truth.positions)
            errors["static"] = point_error(still, truth.positions, scene.diagonal).numpy()
        moved = predicted.positions[:, kernels] - scene.means[kernels] + truth.rest
        errors[label] = point_error(moved, truth.positions, scene.diagonal).numpy()
        cameras = record.cameras_of([view])
        drawn = film(item.run.renderer, scene, predicted, cameras, background=WHITE, mask=scene.foreground)
        films[label] = drawn[:, 0].numpy()
    return films, errors, item.data.train_frames.stop, item.data.fps


def plot(lines: dict[str, np.ndarray], frame: int, unseen: int, width: int) -> np.ndarray:
    """The errors up to a frame, (PLOT, width, 3)."""
    figure = Figure((width / 100, PLOT / 100), dpi=100)
    axes = figure.add_axes((0.07, 0.2, 0.915, 0.74))
    count, colors = len(next(iter(lines.values()))), iter(METHOD_COLORS)
    axes.axvspan(0, unseen - 0.5, color=SEEN_SHADE)
    for label, values in lines.items():
        color = "#888888" if label == "static" else next(colors)
        axes.plot(values[: frame + 1], color=color, linewidth=1.6)
        axes.annotate(label, (frame, values[frame]), (4, -3), textcoords="offset points", fontsize=7, color=color)
    axes.set(xlim=(0, count + 5), ylim=(0, 1.05 * max(v.max() for v in lines.values())))
    axes.set_ylabel("3D error [%]", fontsize=7)
    axes.tick_params(labelsize=6)
    stream = io.BytesIO()
    figure.savefig(stream, format="raw")
    return np.frombuffer(stream.getvalue(), np.uint8).reshape(PLOT, -1, 4)[:, :width, :3]


def pictures(
    films: dict[str, np.ndarray], lines: dict[str, np.ndarray], unseen: int, crop: tuple[float, float]
) -> Iterator[np.ndarray]:
    """Frames of the GIF."""
    count, size = len(films["video"]), films["video"].shape[2]
    cut = slice(round(crop[0] * size), round(crop[1] * size))
    for frame in range(count):
        columns = []
        for label, shown in films.items():
            panel = shown[frame][:, cut]
            head = np.full((LABEL, panel.shape[1], 3), 255, np.uint8)
            cv2.putText(head, label, (8, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (40, 40, 40), 1, cv2.LINE_AA)
            columns.append(np.concatenate((head, panel)))
        row = np.concatenate(columns, 1)
        line = np.full((LINE, row.shape[1], 3), 235, np.uint8)
        begin, now = (round(row.shape[1] * f / count) for f in (unseen, frame + 1))
        line[:, : min(begin, now)] = SEEN
        line[:, begin:now] = UNSEEN
        yield np.concatenate((row, line, plot(lines, frame, unseen, row.shape[1])))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("runs", nargs="+", metavar="LABEL=RUN")
    parser.add_argument("--sequence", default="seq_000")
    parser.add_argument("--view", default="cam_0")
    parser.add_argument("--crop", type=float, nargs=2, default=(0.125, 0.875), help="part of the width that is shown")
    arguments = parser.parse_args()
    runs = {label: Path(path) for label, path in (pair.split("=", 1) for pair in arguments.runs)}
    films, lines, unseen, fps = predictions(runs, arguments.sequence, arguments.view)
    write_gif(arguments.out, pictures(films, lines, unseen, tuple(arguments.crop)), fps / 2)


if __name__ == "__main__":
    main()
