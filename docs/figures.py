"""Makes the figures of the results from their records: ``python docs/figures.py`` (`make results`)."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt  # noqa: E402, after the choice of a backend

from gausim.results.pivot import Pivot  # noqa: E402
from gausim.results.summary import AHEAD  # noqa: E402
from gausim.results.table import load_results  # noqa: E402

DOCS = Path(__file__).resolve().parent
# Equal input gives equal files: no date, and identifiers that follow from the content.
plt.rcParams |= {"svg.hashsalt": "gausim", "svg.fonttype": "none", "font.size": 9, "axes.spines.top": False}
plt.rcParams |= {"axes.spines.right": False}
# Methods with colour and style; those that a record lacks are left out.
METHODS = {
    "static": ("0.5", ":"), "spring_mass": ("tab:green", "-"), "physdreamer": ("tab:orange", "-"),
    "gausim_paper": ("tab:purple", "-"), "gausim": ("tab:blue", "-"),
}  # fmt: skip


def frames_ahead() -> None:
    """3D error over the frames after the last seen one, an object per panel."""
    pivot = Pivot(load_results(DOCS / "results" / "comparison.json"))
    names = ("pudding_soft", "flower_swing", "bunny_ready")
    figure, panels = plt.subplots(1, len(names), figsize=(9.6, 2.9), layout="constrained")
    for axes, name in zip(panels, names, strict=True):
        for method, (color, style) in METHODS.items():
            found = [(n, pivot.number(method, (name, f"+{n}", "points", "error_3d"))) for n in AHEAD]
            known = [(n, value) for n, value in found if value is not None]
            if known:
                axes.plot(*zip(*known, strict=True), style, color=color, marker="o", ms=3, label=method)
        axes.set(title=name, xlabel="frames after the last seen one", xscale="log", ylim=(0, None))
        axes.set_xticks([n for n, _ in known], [str(n) for n, _ in known], minor=False)
        axes.minorticks_off()
    panels[0].set_ylabel("3D error [% of the diagonal]")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
    save(figure, "frames_ahead")


def paper_schedule() -> None:
    """The paper's simulator by its schedule: loss and errors over the uses of a sequence."""
    pivot = Pivot(load_results(DOCS / "results" / "paper.json"))
    figure, panels = plt.subplots(1, 2, figsize=(9.6, 2.9), layout="constrained", sharey=True)
    titles = {"curve": "8 layers of 64, all 1,750 uses", "whole": "16 layers of 128, 900 uses"}
    lines = {"loss on frames 0..T, / static": "loss", "3D, seen 0..15": "3D, seen", "3D, unseen 16..49": "3D, unseen"}
    for axes, (name, title) in zip(panels, titles.items(), strict=True):
        rows = list(pivot.rows([name]))
        for metric, label in lines.items():
            found = [(int(row.split(" | ")[0]), pivot.number(row, (name, "", "", metric))) for row in rows]
            known = [(uses, value) for uses, value in found if value is not None]
            if known:
                axes.plot(*zip(*known, strict=True), marker="o", ms=3, label=label)
        axes.axhline(1.0, color="0.5", ls=":")
        axes.set(title=title, xlabel="uses of each sequence", ylim=(0, 1.6))
    panels[0].set_ylabel("relative to the static baseline")
    figure.legend(*panels[1].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    save(figure, "paper_schedule")


def training_curves() -> None:
    """Error in unseen frames over the processor time of the training, an object per panel."""
    pivot = Pivot(load_results(DOCS / "results" / "curves.json"))
    objects = list(dict.fromkeys(name.split(", ")[0] for name in pivot.results.objects))
    figure, grid = plt.subplots(2, -(-len(objects) // 2), figsize=(9.6, 4.2), layout="constrained")
    for axes, name in zip(grid.flat, objects, strict=False):
        for epochs, color in ((8, "tab:orange"), (30, "tab:blue")):
            curve = f"{name}, {epochs} epochs"
            if curve not in pivot.results.objects:
                continue
            found = [
                (float(row.split(" | ")[1]), pivot.number(row, (curve, "", "", "error_unseen")))
                for row in pivot.rows([curve])
            ]
            axes.plot(*zip(*found, strict=True), color=color, marker="o", ms=2, label=f"{epochs} epochs")
        axes.set(title=name, xlabel="processor time [s]", ylim=(0, None), xlim=(0, None))
    for axes in list(grid.flat)[len(objects) :]:
        axes.axis("off")
    for axes in grid[:, 0]:
        axes.set_ylabel("relative to static")
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    save(figure, "training_curves")


def save(figure: plt.Figure, name: str) -> None:
    """Writes ``docs/images/NAME.svg``."""
    figure.savefig(DOCS / "images" / f"{name}.svg", metadata={"Date": None})
    plt.close(figure)


if __name__ == "__main__":
    frames_ahead()
    paper_schedule()
    training_curves()
