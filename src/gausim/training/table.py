"""CSV tables of resumable runs: no duplicate rows, none lost."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gausim.io.files import write_durably


class Table:
    """CSV table that writes each row at once; :meth:`resume_at` removes the rows that will be repeated.

    ``key`` is the counting column. Values outside ``columns`` are left out; without ``columns``, new ones are added.
    """

    def __init__(self, path: Path, key: str, columns: Sequence[str] = ()) -> None:
        self.path, self._key, self._fixed = path, key, tuple(columns)
        self._columns = list(columns)

    def append(self, row: Mapping[str, Any]) -> None:
        """Adds a row; missing columns stay empty."""
        if self._fixed:
            row = {name: row.get(name, "") for name in self._fixed}
        if self.path.is_file() and set(row) <= set(self._columns):
            with self.path.open("a", newline="") as file:
                csv.DictWriter(file, self._columns).writerow(row)
        else:
            self._write([*self.rows(), row])

    def resume_at(self, last: int) -> None:
        """Keeps the rows whose key is at most ``last``, without incomplete ones."""
        if self.path.is_file():
            whole = [row for row in self.rows() if None not in row and None not in row.values()]
            self._write([row for row in whole if float(row[self._key] or 0) <= last])

    def rows(self) -> list[dict[str, Any]]:
        """All rows, as text."""
        if not self.path.is_file():
            return []
        with self.path.open(newline="") as file:
            return list(csv.DictReader(file))

    def _write(self, rows: Sequence[Mapping[str, Any]]) -> None:
        self._columns = list(self._fixed or dict.fromkeys([self._key, *(name for row in rows for name in row)]))
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, self._columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
        write_durably(self.path, text.getvalue().encode())


def short(value: Any) -> Any:
    """Floats with five digits."""
    return float(f"{value:.5g}") if isinstance(value, float) else value
