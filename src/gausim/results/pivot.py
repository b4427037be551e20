"""Pivot of the long table: columns say which figures, rows are those that have any; and its Markdown."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from gausim.results.table import INFORMED, PAPER, Cell, Entry, Metric, Results, pooled

Place = tuple[str, str, str, str]  # object, split, views, metric


@dataclass(frozen=True)
class Column:
    """A column: the place of its figures, heading, digits after the point, and which figures are better."""

    place: Place
    label: str
    digits: int | None = 2
    better: Literal["", "low", "high", "one"] = ""
    group: str = ""  # common heading of several columns


@dataclass(frozen=True)
class Line:
    """One row of a grid; ``best`` marks its cells that are printed bold."""

    label: str
    kind: str
    cells: tuple[Cell | None, ...]
    best: tuple[bool, ...]


@dataclass(frozen=True)
class Grid:
    """A table to print."""

    columns: tuple[Column, ...]
    lines: tuple[Line, ...]
    stub: str = "method"  # heading of the labels; " | " separates several
    title: str = ""
    caption: str = ""
    section: str = ""


class Pivot:
    """Figures of a table by their place."""

    def __init__(self, results: Results) -> None:
        self.results = results
        self._entries: dict[Place, dict[str, list[Entry]]] = defaultdict(lambda: defaultdict(list))
        self._kinds: dict[str, dict[str, str]] = defaultdict(dict)
        for entry in results.table:
            place = entry.object, entry.split, entry.views, entry.metric
            self._entries[place][entry.row].append(entry)
            self._kinds[entry.object].setdefault(entry.row, entry.kind)

    def cell(self, row: str, place: Place) -> Cell | None:
        """A figure over its seeds; None where there is none."""
        found = self._entries.get(place, {}).get(row)
        return pooled(found) if found else None

    def number(self, row: str, place: Place) -> float | None:
        """The mean over seeds; None where there is none."""
        cell = self.cell(row, place)
        return None if cell is None else cell.number

    def rows(self, names: Iterable[str]) -> dict[str, str]:
        """Rows of some objects with their kinds, in the order of the table."""
        return {row: kind for name in names for row, kind in self._kinds[name].items()}

    def metrics(self, name: str, split: str, views: str) -> list[str]:
        """Metrics of an object in a range of frames and a group of views, in the order of the table."""
        return [metric for *place, metric in self._entries if place == [name, split, views]]

    def column(self, place: Place, label: str | None = None, *, more: str = "", group: str = "") -> Column | None:
        """The column of a place, labelled with metric and unit unless ``label`` is given; None without figures."""
        if place not in self._entries:
            return None
        name, _, _, key = place
        metric: Metric = self.results.metrics[key]
        shown = metric.label.replace("{reference}", self.results.objects[name].reference)
        head = (f"{shown} [{metric.unit}]" if metric.unit else shown) if label is None else label
        return Column(place, head + more, metric.digits, metric.better, group)

    def grid(self, columns: Iterable[Column | None], *, rows: Sequence[str] | None = None, **texts: str) -> Grid | None:
        """A grid of the columns and of the rows that have figures in them; None without any.

        ``rows`` are all rows of the objects unless given; ``texts`` are further fields of the grid.
        """
        kept = tuple(column for column in columns if column is not None)
        kinds = self.rows(dict.fromkeys(column.place[0] for column in kept))
        found = {row: tuple(self.cell(row, c.place) for c in kept) for row in (kinds if rows is None else rows)}
        found = {row: cells for row, cells in found.items() if any(cell is not None for cell in cells)}
        rivals = [cells for row, cells in found.items() if kinds[row] not in (INFORMED, PAPER)]
        best = [_best([cells[i] for cells in rivals], column) for i, column in enumerate(kept)]
        lines = tuple(
            Line(row, kinds[row], cells, tuple(
                kinds[row] not in (INFORMED, PAPER) and cell is not None and b is not None and _merit(cell, c) == b
                for cell, c, b in zip(cells, kept, best, strict=True)
            ))
            for row, cells in found.items()
        )  # fmt: skip
        return Grid(kept, lines, **texts) if lines else None


def _best(cells: Sequence[Cell | None], column: Column) -> float | None:
    """Merit of the best of at least two figures."""
    merits = [merit for cell in cells if cell is not None and (merit := _merit(cell, column)) is not None]
    return min(merits) if column.better and len(merits) > 1 else None


def _merit(cell: Cell, column: Column) -> float | None:
    """A figure, as printed, so that the smallest is the best."""
    if cell.number is None or not column.better:
        return None
    digits = 6 if column.digits is None else column.digits
    value = round(cell.number, digits)
    return {"low": value, "high": -value, "one": round(abs(value - 1), digits)}[column.better]


def cell_texts(cell: Cell | None, digits: int | None) -> tuple[str, str]:
    """A figure, and its deviations: over seeds after ±, over sequences in brackets."""
    if cell is None or cell.number is None:
        return ("" if cell is None else str(cell.value)), ""
    spread = "" if cell.seed_std is None else f"± {_number(cell.seed_std, digits)}"
    parts = [spread, "" if cell.std is None else f"(± {_number(cell.std, digits)})"]
    return "0" if cell.number == 0 else _number(cell.number, digits), " ".join(filter(None, parts))


def _number(value: float, digits: int | None) -> str:
    return f"{value:,.{digits}f}" if digits is not None else f"{value:,.10g}"


def texts(grid: Grid, escape: Callable[[str], str] = str, bold: str = "**{}**") -> list[list[str]]:
    """Headings, then labels and figures of every row, escaped; ``bold`` formats the best figures."""
    stubs = grid.stub.split(" | ")
    lines = [[escape(text) for text in (*stubs, *(column.label for column in grid.columns))]]
    for line in grid.lines:
        labels = line.label.split(" | ", len(stubs) - 1)
        shown = [" ".join(filter(None, cell_texts(cell, column.digits)))
                 for cell, column in zip(line.cells, grid.columns, strict=True)]  # fmt: skip
        marked = [(bold if best else "{}").format(escape(text)) for text, best in zip(shown, line.best, strict=True)]
        lines.append([*map(escape, labels), *marked])
    return lines


def markdown_table(grid: Grid, escape: Callable[[str], str] = str) -> str:
    """The grid as GitHub Markdown, the best figures bold; ``escape`` is applied to every text."""
    head, *rows = texts(grid, escape)
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("|" + "|".join(f" {text} " if text else " " for text in line) + "|" for line in lines)
