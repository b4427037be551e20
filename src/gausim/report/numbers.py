"""All figures of a report as CSV, at full precision and unscaled."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator

from gausim.report.gather.study import Group, Study, cell

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
        "kind": "method" if is_method else "reference", "object": name, **_sources(group, name),
    }  # fmt: skip
    entries = group.entries(name)
    if not entries:
        yield line | {"status": cell(group, name, "seen", "train", "l2").status}
    splits = study.splits(name)
    places = dict.fromkeys(
        (split, views, metric) for _, entry in entries for split, by_views in entry["rows"].get(row, {}).items()
        for views, cells in by_views.items() for metric in cells if split in splits
    )  # fmt: skip
    for split, views, metric in places:
        c, info = cell(group, name, split, views, metric, row=row), study.info(metric) or {}
        start, end = splits[split]
        line |= {"split": split, "first_frame": start, "end_frame": end, "views": views, "metric": metric}
        line |= {"status": c.status, "scale": info.get("scale", ""), "unit": info.get("unit", "")}
        figures: dict[str, object] = {}
        if c.value is not None:
            figures = {"mean": c.value.mean, "std_sequences": c.value.std, "std_seeds": c.value.seed_std}
            figures["seeds"] = c.value.seeds
        yield line | figures


def _sources(group: Group, name: str) -> dict[str, str]:
    runs = [r for r, _ in group.entries(name)] or list(group.of(name))
    hashes = [run.data_hashes.get(name, ("?", "?")) for run in runs]
    columns = {
        "runs": [r.name for r in runs], "config": [r.config_hash for r in runs], "commit": [r.commit for r in runs],
        "scene_sha256": [h[0] for h in hashes], "manifest_sha256": [h[1] for h in hashes],
    }  # fmt: skip
    return {key: ";".join(dict.fromkeys(column)) for key, column in columns.items()}
