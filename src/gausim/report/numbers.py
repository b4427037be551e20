"""Every figure of a report as CSV, at full precision and not scaled."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator

from gausim.report.gather.study import Group, Study, cell
from gausim.report.tables.sheets import metric_info

CSV_HEAD = (
    "row", "kind", "object", "split", "first_frame", "end_frame", "views", "metric", "mean", "std_sequences",
    "std_seeds", "seeds", "scale", "unit", "status", "runs", "config", "commit", "scene_sha256", "manifest_sha256",
)  # fmt: skip


def csv_numbers(study: Study) -> str:
    """One line per figure of every row; columns as in :data:`CSV_HEAD`."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, CSV_HEAD, restval="", lineterminator="\n")
    writer.writeheader()
    for group in study.groups:
        for name in group.objects:
            rows = {str(row): e["methods"] for _, e in group.entries(name) for row in e["rows"]}
            for row in [group.method, *(r for r, methods in rows.items() if r not in methods)]:
                writer.writerows(_lines(study, group, name, row))
    return stream.getvalue()


def _lines(study: Study, group: Group, name: str, row: str) -> Iterator[dict[str, object]]:
    is_method = row == group.method
    line: dict[str, object] = {
        "row": group.label if is_method else f"{row} (with {group.label})",
        "kind": "method" if is_method else "reference",
        "object": name,
        **_sources(group, name),
    }
    entries = [e["rows"].get(row) for _, e in group.entries(name)]
    if not entries:
        yield line | {"status": cell(group, name, "seen", "train", "l2").status}
        return
    splits = study.splits(name)
    places = dict.fromkeys(
        (split, views, metric)
        for found in entries if isinstance(found, dict)
        for split, by_views in found.items() if split in splits and isinstance(by_views, dict)
        for views, cells in by_views.items() if isinstance(cells, dict)
        for metric in cells
    )  # fmt: skip
    for split, views, metric in places:
        c, info = cell(group, name, split, views, metric, row=row), metric_info(study, metric) or {}
        where = {"split": split, "first_frame": splits[split][0], "end_frame": splits[split][1], "views": views}
        figures: dict[str, object] = {"status": c.status, "metric": metric}
        figures |= {key: info.get(key, "") for key in ("scale", "unit")}
        if c.value is not None:
            figures |= {"mean": c.value.mean, "std_sequences": c.value.std, "std_seeds": c.value.seed_std}
            figures["seeds"] = c.value.seeds
        yield line | where | figures


def _sources(group: Group, name: str) -> dict[str, str]:
    runs = [r for r, _ in group.entries(name)] or list(group.of(name))
    hashes = [run.data_hashes.get(name, ("?", "?")) for run in runs]
    columns = {
        "runs": [r.name for r in runs], "config": [r.config_hash for r in runs], "commit": [r.commit for r in runs],
        "scene_sha256": [h[0] for h in hashes], "manifest_sha256": [h[1] for h in hashes],
    }  # fmt: skip
    return {key: ";".join(dict.fromkeys(column)) for key, column in columns.items()}
