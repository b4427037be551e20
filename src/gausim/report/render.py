"""Tables as Markdown and LaTeX."""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace

from gausim.metrics.lpips import NO_LPIPS, NO_WEIGHTS
from gausim.report.layouts import layout
from gausim.results.pivot import Grid, Pivot, markdown_table, texts
from gausim.results.table import SPLIT_TITLES, VIEW_TITLES, Made, Results

LEGEND = (
    "Mean, in brackets standard deviation over sequences; `÷ static` is the ratio to the static prediction (below 1 is "
    "better), `÷ ballistic` and `÷ follow hands` to rigid flight and to following the hands at once, of bodies that "
    "move so; motion energy is the predicted over the true one, all sequences together (1 is right, 0 is no motion); "
    "the floor is the reconstruction itself against frame 0. Images are foreground on black."
)
_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "|": r"\textbar{}", '"': r"\textquotedbl{}", "±": r"$\pm$", "×": r"$\times$", "–": "--", "→": r"$\to$",
    "↑": r"$\uparrow$", "↓": r"$\downarrow$", "⁻": "$^{-}$", "¹": "$^{1}$", "²": "$^{2}$", "³": "$^{3}$",
    "÷": r"$\div$", "σ": r"$\sigma$", "−": "$-$", "°": r"$^{\circ}$",
}  # fmt: skip


def latex_table(grid: Grid, made: Made) -> str:
    """The table for LaTeX, its origin in comments and caption."""
    head, *body = (" & ".join(line) + r" \\" for line in texts(_flat(grid), latex_escape, r"\textbf{{{}}}"))
    label = re.sub(r"[^A-Za-z0-9]+", "-", grid.title)
    caption = latex_escape(f"{grid.title}. {grid.caption}")
    stubs = len(grid.stub.split(" | "))
    return "\n".join([
        *(f"% {' '.join(line.split())}" for line in origin(made)),
        r"\begin{table*}[ht]", r"\centering", rf"\caption{{{caption}}}", rf"\label{{tab:{label}}}",
        r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
        rf"\begin{{tabular}}{{{'l' * stubs}{'c' * len(grid.columns)}}}", r"\toprule",
        head, r"\midrule", *body, r"\bottomrule", r"\end{tabular}}",
        r"\end{table*}", "",
    ])  # fmt: skip


def grouped(grid: Grid) -> list[tuple[str, int]]:
    """Common headings of columns with their numbers of columns; empty if there are none."""
    found: list[tuple[str, int]] = []
    for column in grid.columns:
        if found and found[-1][0] == column.group:
            found[-1] = column.group, found[-1][1] + 1
        else:
            found.append((column.group, 1))
    return found if any(name for name, _ in found) else []


def _flat(grid: Grid) -> Grid:
    """The grid with the common headings in those of the columns, for formats without them."""
    columns = [replace(c, label=f"{c.group}: {c.label}" if c.group else c.label) for c in grid.columns]
    return replace(grid, columns=tuple(columns))


def origin(made: Made) -> list[str]:
    """Date, commits, hardware, commands and runs without figures, one line each."""
    return [
        f"Recorded: {made.recorded}",
        f"Commits: {', '.join(made.commits) or 'unknown'}",
        f"Hardware: {'; '.join(made.hardware) or 'unknown'}",
        *(f"Command: {command}" for command in made.commands),
        *(f"Without figures: {run}" for run in made.missing),
    ]


def results_page(title: str, made: Made, grids: Iterable[Grid], notes: Sequence[str] = ()) -> str:
    """All tables as a Markdown page, with origin and ``notes``; texts are escaped, as runs have any name."""
    heads = (line.partition(": ") for line in origin(made))
    told = [f"* {head}: " + (f"`{text}`" if head == "Command" else markdown_escape(text)) for head, _, text in heads]
    parts = [f"# {markdown_escape(title)}", markdown_escape(made.test), "\n".join(told)]
    parts.append("\n".join(f"* {markdown_escape(note)}" for note in notes))
    for grid in grids:
        parts += [f"## {markdown_escape(grid.title)}", markdown_escape(grid.caption)]
        parts.append(markdown_table(_flat(grid), markdown_escape))
    return "\n\n".join(filter(None, parts)) + "\n"


def results_latex(made: Made, grids: Iterable[Grid]) -> str:
    r"""All tables for ``\input``."""
    head = "% \\usepackage{booktabs,graphicx} and T1 font encoding\n\n"
    return head + "\n".join(latex_table(grid, made) for grid in grids)


def latex_escape(text: str) -> str:
    """Text escaped for LaTeX, on one line; control characters are removed."""
    flat = re.sub(r"\s+", " ", text)
    return "".join(_LATEX.get(c, c) for c in flat if c.isprintable())


def markdown_escape(text: str) -> str:
    """Text escaped for Markdown, also in tables; backquotes stay, for commands."""
    flat = re.sub(r"\s+", " ", text)
    return re.sub(r"([\\*_\[\]|<>#~&])", r"\\\1", flat)


def evaluation_page(results: Results) -> str:
    """``table.md`` of an evaluation: every figure of each object, and notes on its methods."""
    pivot, run = Pivot(results), ", ".join(f"{key} {value}" for key, value in results.run.items())
    absent = [NO_LPIPS] if any(info.absent.get("lpips") == NO_WEIGHTS for info in results.objects.values()) else []
    parts = ["# Evaluation", run, " ".join([LEGEND, *absent])]
    for name, info in results.objects.items():
        parts.append(f"## {name}\n\n{len(info.sequences)} sequences of {max(info.frames)} frames at {info.fps:g} fps.")
        places = [(split, views) for views in VIEW_TITLES for split in info.splits]
        kinds = {f"{split} {views}": f"{SPLIT_TITLES[split]} {info.splits[split][0]}..{info.splits[split][1] - 1}, "
                 f"{VIEW_TITLES[views]}" for split, views in places}  # fmt: skip
        kinds |= {"ahead": "3D error by frames after the last seen one", "bounce": "bounce", "": "cost"}
        for kind, title in kinds.items():
            grid = layout(pivot, name, kind, stub="row")
            parts += [] if grid is None else [f"### {title}\n\n{markdown_table(grid, markdown_escape)}"]
        color = info.mean_color or (0.0, 0.0, 0.0)
        parts.append(
            f"Contrast: mean foreground colour ({', '.join(f'{c:.2f}' for c in color)}), its norm "
            f"{math.hypot(*color):.2f}; largest l2 of a pixel {info.max_l2:.2f}."
        )
        parts += [f"* {row}: {note}" for row in info.methods for note in info.notes.get(row, [])]
    return "\n\n".join(parts) + "\n"
