"""Tables of records as Markdown and LaTeX, and pages from templates that name them."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from jinja2 import Environment, StrictUndefined, TemplateError

from gausim.core import RunError
from gausim.report.records.record import Cell, Column, Figure, Made, Record, RecordTable, load_record, value_of
from gausim.results.table import markdown_rows

TEMPLATE = "page.md"
SEEDS_APART = "± deviation over seeds; in brackets, deviation over sequences (root mean square over seeds)."
_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "|": r"\textbar{}", '"': r"\textquotedbl{}", "±": r"$\pm$", "×": r"$\times$", "–": "--", "→": r"$\to$",
    "↑": r"$\uparrow$", "↓": r"$\downarrow$", "⁻": "$^{-}$", "¹": "$^{1}$", "²": "$^{2}$", "³": "$^{3}$",
    "÷": r"$\div$", "σ": r"$\sigma$", "−": "$-$",
}  # fmt: skip


def markdown_table(table: RecordTable, escape: Callable[[str], str] = str) -> str:
    """The table as GitHub Markdown, the best figures bold; ``escape`` is applied to every text."""
    head, *rows = _printed(table, escape, "**{}**")
    return markdown_rows([head, ["---"] * len(head), *rows]).replace("|  |", "| |").replace("|  |", "| |")


def latex_table(table: RecordTable, record: Record) -> str:
    """The table for LaTeX, its origin in comments and caption."""
    head, *body = (" & ".join(line) + r" \\" for line in _printed(table, latex_escape, r"\textbf{{{}}}"))
    label = re.sub(r"[^A-Za-z0-9]+", "-", table.key)
    caption = latex_escape(" ".join(filter(None, (f"{table.title or record.title}.", table.caption, record.made.test))))
    return "\n".join([
        *(f"% {' '.join(line.split())}" for line in origin(record.made)),
        r"\begin{table*}[ht]", r"\centering", rf"\caption{{{caption}}}", rf"\label{{tab:{label}}}",
        r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
        rf"\begin{{tabular}}{{{'l' * len(table.stub)}{'c' * len(table.columns)}}}", r"\toprule",
        head, r"\midrule", *body, r"\bottomrule", r"\end{tabular}}",
        r"\end{table*}", "",
    ])  # fmt: skip


def origin(made: Made) -> list[str]:
    """Date, commits, hardware, commands and runs without figures, one line each."""
    return [
        f"Recorded: {made.recorded}",
        f"Commits: {', '.join(made.commits) or 'unknown'}",
        f"Hardware: {'; '.join(made.hardware) or 'unknown'}",
        *(f"Command: {command}" for command in made.commands),
        *(f"Without figures: {run}" for run in made.missing),
    ]


def results_page(record: Record, notes: Sequence[str] = ()) -> str:
    """All tables of one record as a page, with their origin and ``notes``; texts are escaped, as runs have any name."""
    parts = [f"# {markdown_escape(record.title)}", markdown_escape(record.made.test), "\n".join(_listed(record.made))]
    parts.append("\n".join(f"* {markdown_escape(note)}" for note in notes))
    for table in record.tables:
        parts += [f"## {markdown_escape(table.title or table.key)}", markdown_escape(table.caption)]
        parts.append(markdown_table(table, markdown_escape))
    return "\n\n".join(filter(None, parts)) + "\n"


def results_latex(record: Record) -> str:
    r"""All tables of one record for ``\input``."""
    return "% \\usepackage{booktabs,graphicx} and T1 font encoding\n\n" + "\n".join(
        latex_table(table, record) for table in record.tables
    )


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

    In the template ``table("RECORD", "KEY")`` is a table, ``made("RECORD")`` its commits and commands, and
    ``RECORD.NAME`` a fact.

    Raises:
        RunError: the template or a record is missing or malformed, or names something that is not there.
    """
    records = {path.stem: load_record(path) for path in sorted(folder.glob("*.json"))}

    def known(name: str) -> Record:
        if name not in records:
            raise RunError(f"{folder / TEMPLATE}: names the record '{name}', expected one of {list(records)}.")
        return records[name]

    environment = Environment(
        undefined=StrictUndefined,
        keep_trailing_newline=True,
        comment_start_string="<#",  # anchors such as {#step} are no comments
        comment_end_string="#>",
    )
    environment.globals = {
        "table": lambda name, key: markdown_table(known(name).table(key)),
        "made": lambda name: _block(known(name).made),
        **{name: {key: _text(fact, None) for key, fact in record.facts.items()} for name, record in records.items()},
    }
    try:
        text = environment.from_string((folder / TEMPLATE).read_text()).render()
    except (OSError, TemplateError) as error:
        raise RunError(f"{folder / TEMPLATE}: cannot be made into a page ({error}).") from error
    return f"<!-- Made by `make results` from docs/results/: change the template or the records there. -->\n{text}"


def _block(made: Made) -> str:
    """Commits, commands, and looks at the test part for a page."""
    told = [made.test, ""] if made.test else []
    told += [f"Made by ({', '.join(made.commits)}; recorded {made.recorded})", ""]
    return "\n".join([*told, *(f"    {line}" for command in made.commands for line in command.splitlines())])


def _listed(made: Made) -> list[str]:
    heads = (line.partition(": ") for line in origin(made))
    return [f"* {head}: " + (f"`{text}`" if head == "Command" else markdown_escape(text)) for head, _, text in heads]


def _printed(table: RecordTable, escape: Callable[[str], str], bold: str) -> list[list[str]]:
    """Headings, then labels and figures of every row, escaped; ``bold`` formats the best figures."""
    lines = [[escape(text) for text in (*table.stub, *(column.label for column in table.columns))]]
    for row in table.rows:
        group = row.label[: table.groups]
        rivals = [other for other in table.rows if other.label[: table.groups] == group and not other.reference]
        line = [escape(text) for text in row.label]
        for i, (own, column) in enumerate(zip(row.cells, table.columns, strict=True)):
            best = not row.reference and _is_best(own, [other.cells[i] for other in rivals], column)
            line.append((bold if best else "{}").format(escape(_text(own, column.digits))))
        lines.append(line)
    return lines


def _is_best(cell: Cell, rivals: Sequence[Cell], column: Column) -> bool:
    """Whether a figure, as printed, is the best of at least two."""
    digits = 6 if column.digits is None else column.digits
    values = [round(v, digits) for c in rivals if (v := value_of(c)) is not None]
    own = value_of(cell)
    if not column.better or own is None or len(values) < 2:
        return False
    merit = {"low": lambda v: v, "high": lambda v: -v, "one": lambda v: round(abs(v - 1), digits)}[column.better]
    return merit(round(own, digits)) == min(map(merit, values))


def _text(cell: Cell, digits: int | None) -> str:
    if cell is None or isinstance(cell, str):
        return cell or ""
    if not isinstance(cell, Figure):
        return _number(cell, digits)
    if cell.seed_std is None and len(cell.seeds) > 1:
        text = ", ".join(_number(value, digits) for value in cell.seeds)
    else:
        spread = "" if cell.seed_std is None else f" ± {_printed_number(cell.seed_std, digits)}"
        text = _number(cell.mean, digits) + spread
    return text if cell.std is None else f"{text} (± {_printed_number(cell.std, digits)})"


def _number(value: float, digits: int | None) -> str:
    """A number as printed; 0 itself, which is exact, is 0."""
    return "0" if value == 0 else _printed_number(value, digits)


def _printed_number(value: float, digits: int | None) -> str:
    """A number without a zero before the point."""
    text = f"{value:,.{digits}f}" if digits is not None else f"{value:,.10g}"
    return re.sub(r"^(-?)0\.", r"\1.", text)
