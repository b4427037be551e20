"""Tables of one evaluation as Markdown, from its long table."""

from __future__ import annotations

import math
from dataclasses import replace

from gausim.metrics.lpips import NO_LPIPS, NO_WEIGHTS
from gausim.results.pivot import Column, Grid, Pivot, joined, markdown_table
from gausim.results.summary import AHEAD, ERROR_3D, MOTION_ENERGY
from gausim.results.table import SPLIT_TITLES, VIEW_TITLES, Results

LEGEND = (
    "Mean, in brackets standard deviation over sequences; `÷ static` is the ratio to the static prediction (below 1 is "
    "better), `÷ ballistic` and `÷ follow hands` to rigid flight and to following the hands at once, of bodies that "
    "move so; motion energy is the predicted over the true one, all sequences together (1 is right, 0 stands still); "
    "the floor is the reconstruction itself against frame 0. Images are foreground on black."
)
_BOUNCE = ("height", "height_error", "rise", "rise_error", "depth")


def markdown(results: Results) -> str:
    """The whole ``table.md`` of an evaluation."""
    pivot = Pivot(results)
    run = ", ".join(f"{key} {value}" for key, value in results.run.items())
    absent = [NO_LPIPS] if any(info.absent.get("lpips") == NO_WEIGHTS for info in results.objects.values()) else []
    parts = ["# Evaluation", "", run, "", " ".join([LEGEND, *absent]), ""]
    for name, info in results.objects.items():
        parts += [f"## {name}", ""]
        parts += [f"{len(info.sequences)} sequences of {max(info.frames, default=0)} frames at {info.fps:g} fps.", ""]
        for grid in object_grids(pivot, name):
            parts += [f"### {grid.title}", "", markdown_table(grid), ""]
        color = info.mean_color or (0.0, 0.0, 0.0)
        parts += [
            f"Contrast: mean foreground colour ({', '.join(f'{c:.2f}' for c in color)}), its norm "
            f"{math.hypot(*color):.2f}; largest l2 of a pixel {info.max_l2:.2f}.\n"
        ]
        parts += [f"* {row}: {note}\n" for row in info.methods for note in info.notes.get(row, [])]
    return "\n".join(parts)


def object_grids(pivot: Pivot, name: str) -> list[Grid]:
    """The tables of one object: 3D if the truth is known, training and held-out views, bounce, frames ahead."""
    grids = [_splits(pivot, name, views) for views in VIEW_TITLES]
    bounce = [pivot.column((name, "bounce", "points", metric)) for metric in _BOUNCE]
    title = f"{name}: centre after the first contact with the floor"
    grids.append(pivot.grid(bounce, stub="row", title=title))
    for metric, views in ((ERROR_3D, "points"), ("psnr", "train"), ("psnr", "heldout")):
        columns = [pivot.column((name, f"+{n}", views, metric), f"+{n}") for n in AHEAD]
        shown = pivot.results.metrics[metric].label if metric in pivot.results.metrics else metric
        title = f"{name}: {shown} by frames ahead of the last seen one, {VIEW_TITLES[views]}"
        grids.append(pivot.grid(columns, stub="row", title=title))
    return [grid for grid in grids if grid is not None]


def _splits(pivot: Pivot, name: str, views: str) -> Grid | None:
    """Rows of every range of frames, columns of metrics, the energy last."""
    grids, splits = [], pivot.results.objects[name].splits
    found = [metric for split in splits for metric in pivot.metrics(name, split, views)]
    metrics = sorted(dict.fromkeys(found), key=lambda metric: metric == MOTION_ENERGY)
    known = [next(c for s in splits if (c := pivot.column((name, s, views, metric)))) for metric in metrics]
    for split, (start, stop) in splits.items():
        columns = [Column((name, split, views, c.place[3]), c.label, c.digits) for c in known]
        grid = pivot.grid(columns, stub="frames | row", title=f"{name}: {VIEW_TITLES[views]}")
        frames = f"{SPLIT_TITLES.get(split, split)} {start}..{stop - 1}"
        if grid is not None:
            lines = tuple(replace(line, label=f"{frames} | {line.label}") for line in grid.lines)
            grids.append(replace(grid, lines=lines))
    return joined(grids)
