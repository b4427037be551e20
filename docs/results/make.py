"""Makes docs/results.md from its template page.md and the records *.json beside this file: `make results`."""

from __future__ import annotations

from pathlib import Path

from jinja2 import Environment, StrictUndefined, TemplateError

from gausim.core import RunError
from gausim.io.files import write_durably
from gausim.report.layouts import compact, layout, summary
from gausim.results.pivot import Grid, Pivot, markdown_table
from gausim.results.table import Made, Results, load_results

TEMPLATE = "page.md"


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


if __name__ == "__main__":
    here = Path(__file__).resolve().parent
    write_durably(here.with_suffix(".md"), page(here).encode())
