"""Tables as Markdown and LaTeX, and pages from templates that name tables of records."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from jinja2 import Environment, StrictUndefined, TemplateError

from gausim.core import RunError
from gausim.report.layouts import compact, layout, summary
from gausim.results.pivot import Grid, Pivot, markdown_table, texts
from gausim.results.table import Made, Results, load_results

TEMPLATE = "page.md"
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
    heads = [f"{c.group}: {c.label}" if c.group else c.label for c in grid.columns]
    columns = tuple(c.__class__(c.place, head, c.digits, c.better) for c, head in zip(grid.columns, heads, strict=True))
    return Grid(columns, grid.lines, grid.stub, grid.title, grid.caption, grid.section)


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


def page(folder: Path) -> str:
    """The page of ``folder/page.md``, a template that names tables and facts of the records ``folder/*.json``.

    In the template ``table("RECORD", "OBJECT", "KIND")`` is a table of an object (see
    :func:`gausim.report.layouts.layout`; ``stub`` is the heading of its labels), ``summary("RECORD", ROWS)`` that of
    all objects, ``compact("RECORD", OBJECTS, PLACES, ROWS)`` means of several objects, ``number("RECORD", ROW, OBJECT,
    METRIC, VIEWS, SPLIT)`` one mean, ``made("RECORD")`` commits and commands of the record, ``RECORD.NAME`` a fact.

    Raises:
        RunError: the template or a record is missing or malformed, or names something that is not there.
    """
    advice = "Record it again with `gausim report DIR --record FILE.json`."
    pivots = {path.stem: Pivot(load_results(path, advice)) for path in sorted(folder.glob("*.json"))}

    def known(name: str) -> Pivot:
        if name not in pivots:
            raise RunError(f"{folder / TEMPLATE}: names the record '{name}', expected one of {list(pivots)}.")
        return pivots[name]

    def table(record: str, name: str, kind: str = "", stub: str = "method") -> str:
        pivot = known(record)
        if name not in pivot.results.objects:
            told = list(pivot.results.objects)
            raise RunError(f"{folder / TEMPLATE}: record '{record}' has no object '{name}', expected one of {told}.")
        return _shown(layout(pivot, name, kind, stub=stub), f"'{kind}' of {name} in the record '{record}'")

    def number(record: str, row: str, name: str, metric: str, views: str = "", split: str = "", digits: int = 2) -> str:
        value = known(record).number(row, (name, split, views, metric))
        if value is None:
            raise RunError(f"{folder / TEMPLATE}: record '{record}' has no {metric} {views} {split} of {row}, {name}.")
        return f"{value:,.{digits}f}"

    def _shown(grid: Grid | None, what: str) -> str:
        if grid is None:
            raise RunError(f"{folder / TEMPLATE}: there are no figures for {what}.")
        return markdown_table(grid)

    environment = Environment(
        undefined=StrictUndefined,
        keep_trailing_newline=True,
        comment_start_string="<#",  # anchors such as {#step} are no comments
        comment_end_string="#>",
    )
    environment.globals = {
        "table": table,
        "number": number,
        "summary": lambda name, rows=None: _shown(summary(known(name), rows), f"a summary of the record '{name}'"),
        "compact": lambda name, *arguments, **options: _shown(
            compact(known(name), *arguments, **options), f"a compact table of the record '{name}'"
        ),
        "made": lambda name: _block(known(name).results),
        **{name: {key: _fact(fact) for key, fact in p.results.facts.items()} for name, p in pivots.items()},
    }
    try:
        text = environment.from_string((folder / TEMPLATE).read_text()).render()
    except (OSError, TemplateError) as error:
        raise RunError(f"{folder / TEMPLATE}: cannot be made into a page ({error}).") from error
    return f"<!-- Made by `make results` from docs/results/: change the template or the records there. -->\n{text}"


def _fact(fact: float | str) -> str:
    return fact if isinstance(fact, str) else f"{fact:,.10g}"


def _block(results: Results) -> str:
    """Commits, commands, and looks at the test part for a page."""
    made = results.made or Made("unknown")
    told = [made.test, ""] if made.test else []
    told += [f"Made by ({', '.join(made.commits)}; recorded {made.recorded})", ""]
    return "\n".join([*told, *(f"    {line}" for command in made.commands for line in command.splitlines())])
