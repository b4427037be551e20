"""A report's tables as Markdown, LaTeX and CSV."""

from __future__ import annotations

import csv
import io
import itertools
import re
from collections.abc import Sequence

from gausim.report.gather.study import Group, Study, Value, cell
from gausim.report.opening import Opening
from gausim.report.sources import Sources, commit_of, data_hashes
from gausim.report.tables.sheets import PAPER, Entry, Line, Sheet, metric_info

CSV_HEAD = (
    "row", "kind", "object", "split", "first_frame", "end_frame", "views", "metric", "mean", "std_sequences",
    "std_seeds", "seeds", "scale", "unit", "status", "runs", "config", "commit", "scene_sha256", "manifest_sha256",
)  # fmt: skip
_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "|": r"\textbar{}", '"': r"\textquotedbl{}", "±": r"$\pm$", "×": r"$\times$", "–": "--", "→": r"$\to$",
    "↑": r"$\uparrow$", "↓": r"$\downarrow$", "⁻": "$^{-}$", "¹": "$^{1}$", "²": "$^{2}$", "³": "$^{3}$",
    "σ": r"$\sigma$", "−": "$-$",
}  # fmt: skip


def latex_escape(text: str) -> str:
    """Text that LaTeX prints as it is, on one line; control characters are dropped."""
    flat = re.sub(r"\s+", " ", text)
    return "".join(_LATEX.get(c, c) for c in flat if c.isprintable())


def markdown_escape(text: str) -> str:
    """Text that Markdown prints as it is, also inside a table; backquotes stay, for commands."""
    flat = re.sub(r"\s+", " ", text)
    return re.sub(r"([\\*_\[\]|<>#~&])", r"\\\1", flat)


def markdown_report(
    title: str, study: Study, sheets: Sequence[Sheet], sources: Sources, openings: Sequence[Opening]
) -> str:
    """The whole report without its pictures."""
    parts = [f"# {markdown_escape(title)}", ""]
    # Further seeds of a row have its sentences.
    told = {opening.title: opening for opening in reversed(openings)}
    for opening in reversed(told.values()):
        parts += [f"**{markdown_escape(opening.title)}.** {markdown_escape(' '.join(opening.sentences))}", ""]
    parts += ["Numbers link to the runs that they come from.", ""]
    parts += [f"> {markdown_escape(note)}\n" for note in study.notes]
    for sheet in sheets:
        parts += [
            f"## {markdown_escape(sheet.title)}",
            "",
            markdown_escape(sheet.caption),
            "",
            *_markdown_table(sheet, sources),
            "",
        ]
    parts += ["## Runs", "", *_markdown_runs(sources)]
    return "\n".join(parts) + "\n"


def _markdown_table(sheet: Sheet, sources: Sources) -> list[str]:
    heads = [f"{group} {sub}".strip() for group, subs in sheet.columns for sub in subs]
    text = ["| " + " | ".join(map(markdown_escape, [sheet.stub, *heads])) + " |", "| --- |" + " ---: |" * len(heads)]
    for line in sheet.lines:
        label = markdown_escape(line.label)
        shown = [f"*{label}*" if line.kind == PAPER else label, *(_markdown_entry(e, sources) for e in line.entries)]
        text.append("| " + " | ".join(shown) + " |")
    return text


def _markdown_entry(entry: Entry, sources: Sources) -> str:
    text = markdown_escape(entry.text)
    text = f"**{text}**" if entry.best else f"*{text}*" if entry.missing and entry.runs else text
    anchor = sources.anchor(entry.runs)
    linked = f"[{text}](#{anchor})" if anchor else text
    return f"{linked} ({markdown_escape(entry.extra)})" if entry.extra else linked


def _markdown_runs(sources: Sources) -> list[str]:
    text = []
    for anchors, name in sources.sets.items():
        links = ", ".join(f"[{markdown_escape(sources.by_anchor()[a].name)}](#{a})" for a in anchors)
        text.append(f'* <a id="{name}"></a>{links}')
    text += [
        "",
        "| run | state | seed | config | evaluated by | checkpoint | data: scene, manifest |",
        "| --- " * 7 + "|",
    ]
    for run in sources.runs:
        data = "; ".join(f"{name}: {scene}, {manifest}" for name, scene, manifest in run.data)
        state = f"{run.status}: {run.detail}" if run.detail else run.status
        cells = [state, run.seed, run.config_hash, run.commit, run.checkpoint, data]
        link = f'<a id="{run.anchor}"></a>[{markdown_escape(run.name)}]({run.link})'
        text.append("| " + " | ".join([link, *map(markdown_escape, cells)]) + " |")
    return text


def latex_tables(sheets: Sequence[Sheet], sources: Sources) -> str:
    r"""All tables for ``\input``; needs booktabs, graphicx and xcolor. Comments name the runs of every row."""
    parts = [r"% \usepackage{booktabs,graphicx,xcolor} and T1 font encoding", ""]
    return "\n".join([*parts, *("\n".join(_latex_table(sheet, sources)) for sheet in sheets)])


def _latex_table(sheet: Sheet, sources: Sources) -> list[str]:
    count = sum(len(subs) for _, subs in sheet.columns)
    label = re.sub(r"[^A-Za-z0-9]+", "-", sheet.key)
    lines = [r"\begin{table*}[ht]", r"\centering", r"\caption{" + latex_escape(f"{sheet.title}. {sheet.caption}") + "}",
             rf"\label{{tab:{label}}}", r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
             r"\begin{tabular}{l" + "c" * count + "}", r"\toprule"]  # fmt: skip
    if any(group for group, _ in sheet.columns):
        groups = [rf"\multicolumn{{{len(subs)}}}{{c}}{{\textbf{{{latex_escape(g)}}}}}" for g, subs in sheet.columns]
        lines.append(" & ".join(["", *groups]) + r" \\")
        ends = list(itertools.accumulate(len(subs) for _, subs in sheet.columns))
        starts = [end - len(subs) for end, (_, subs) in zip(ends, sheet.columns, strict=True)]
        lines.append(" ".join(rf"\cmidrule(lr){{{s + 2}-{e + 1}}}" for s, e in zip(starts, ends, strict=True)))
    subs = [latex_escape(sub) for _, names in sheet.columns for sub in names]
    lines += [" & ".join([latex_escape(sheet.stub), *subs]) + r" \\", r"\midrule"]
    before = None
    for line in sheet.lines:
        if before not in (None, line.kind):
            lines.append(r"\midrule")
        before = line.kind
        lines += _latex_line(line, sources)
    return [*lines, r"\bottomrule", r"\end{tabular}}", r"\end{table*}", ""]


def _latex_line(line: Line, sources: Sources) -> list[str]:
    grey = line.kind == PAPER
    cells = []
    for entry in line.entries:
        text = latex_escape(entry.text)
        text = rf"\textbf{{{text}}}" if entry.best else rf"\textit{{{text}}}" if entry.missing and entry.runs else text
        cells.append(text + (rf" {{\scriptsize ({latex_escape(entry.extra)})}}" if entry.extra else ""))
    shown = [latex_escape(line.label), *cells]
    shown = [rf"\textcolor{{gray}}{{{c}}}" for c in shown] if grey else shown
    runs = dict.fromkeys(run.name for entry in line.entries for run in entry.runs)
    # A line break in a name would end the comment.
    comment = [f"% runs: {', '.join(latex_escape(r) for r in runs)}"] if runs else []
    return [*comment, " & ".join(shown) + r" \\"]


def csv_numbers(study: Study) -> str:
    """Every figure of every row at full precision, not scaled; columns as in :data:`CSV_HEAD`."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(CSV_HEAD)
    for group in study.groups:
        for name in group.objects:
            rows = {str(row): e["methods"] for _, e in group.entries(name) for row in e["rows"]}
            for row in [group.method, *(r for r, methods in rows.items() if r not in methods)]:
                for line in _csv_rows(study, group, name, row):
                    writer.writerow(line)
    return stream.getvalue()


def _csv_rows(study: Study, group: Group, name: str, row: str) -> list[list[object]]:
    entries = [e["rows"].get(row) for _, e in group.entries(name)]
    kind = "method" if row == group.method else "reference"
    label = group.label if kind == "method" else f"{row} (with {group.label})"
    if not entries:
        c = cell(group, name, "seen", "train", "l2")
        return [[label, kind, name, *[""] * 11, c.status, *_csv_sources(group, name)]]
    places = dict.fromkeys(
        (split, views, metric)
        for found in entries if isinstance(found, dict)
        for split, by_views in found.items() if split in study.splits(name) and isinstance(by_views, dict)
        for views, cells in by_views.items() if isinstance(cells, dict)
        for metric in cells
    )  # fmt: skip
    lines: list[list[object]] = []
    for split, views, metric in places:
        c, info = cell(group, name, split, views, metric, row=row), metric_info(study, metric)
        start, stop = study.splits(name)[split]
        figures = _csv_value(c.value)
        printed = [info["scale"], info["unit"]] if info else ["", ""]
        lines.append([label, kind, name, split, start, stop, views, metric, *figures, *printed, c.status,
                      *_csv_sources(group, name)])  # fmt: skip
    return lines


def _csv_value(value: Value | None) -> list[object]:
    if value is None:
        return [""] * 4
    return [
        value.mean,
        "" if value.std is None else value.std,
        "" if value.seed_std is None else value.seed_std,
        value.seeds,
    ]


def _csv_sources(group: Group, name: str) -> list[str]:
    runs = [r for r, _ in group.entries(name)] or list(group.of(name))
    hashes = [data_hashes(run, name) for run in runs]
    columns = ([r.name for r in runs], [r.config_hash for r in runs], [commit_of(r) for r in runs],
               [h[0] for h in hashes], [h[1] for h in hashes])  # fmt: skip
    return [";".join(dict.fromkeys(column)) for column in columns]
