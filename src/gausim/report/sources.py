"""Where every number of a report comes from: run, configuration, commit, hashes of the data."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

import yaml

from gausim.report.gather.runs import RunRecord
from gausim.report.tables.sheets import Sheet

_DIGITS = 12


@dataclass(frozen=True)
class Source:
    """What is known of one run, as text.

    Attributes:
        anchor: its place in the report.
        name: its path below the searched directory.
        link: relative address of its directory from the report.
        status: its state.
        detail: more about that.
        seed: its seed.
        config_hash: of its configuration.
        config: the configuration as YAML text.
        commit: of the program that evaluated it.
        checkpoint: epoch and updates.
        data: per object: name, hash of the scene, hash of the manifest.
    """

    anchor: str
    name: str
    link: str
    status: str
    detail: str
    seed: str
    config_hash: str
    config: str
    commit: str
    checkpoint: str
    data: tuple[tuple[str, str, str], ...] = field(default=())


class Sources:
    """Gives every set of runs that a number comes from a place in the report to link to."""

    def __init__(self, runs: Sequence[RunRecord], sheets: Sequence[Sheet], out: Path) -> None:
        """Collects the runs, and the sets of several runs that some number was computed from."""
        self.runs = [_source(run, f"run-{i}", out) for i, run in enumerate(runs, 1)]
        self._of_run = {id(run): source.anchor for run, source in zip(runs, self.runs, strict=True)}
        self.sets: dict[tuple[str, ...], str] = {}
        for sheet in sheets:
            for line in sheet.lines:
                for entry in line.entries:
                    self._register(self._anchors(entry.runs))

    def _anchors(self, runs: Sequence[RunRecord]) -> tuple[str, ...]:
        return tuple(dict.fromkeys(self._of_run[id(run)] for run in runs))

    def _register(self, anchors: tuple[str, ...]) -> None:
        if len(anchors) > 1 and anchors not in self.sets:
            self.sets[anchors] = f"runs-{len(self.sets) + 1}"

    def anchor(self, runs: Sequence[RunRecord]) -> str:
        """Where a number computed from these runs links to; empty where it comes from none."""
        anchors = self._anchors(runs)
        return self.sets.get(anchors, anchors[0]) if anchors else ""

    def by_anchor(self) -> dict[str, Source]:
        """All runs by their anchors."""
        return {source.anchor: source for source in self.runs}


def _source(run: RunRecord, anchor: str, out: Path) -> Source:
    summary = run.summary or {}
    state: dict[str, Any] = summary.get("run", {})
    epoch, updates = state.get("epoch"), state.get("updates")
    objects: dict[str, Any] = summary.get("objects", {})
    relative = os.path.relpath(run.path.resolve(), out.resolve())
    return Source(
        anchor=anchor,
        name=run.name,
        link=quote(Path(relative).as_posix()),
        status=run.status,
        detail=run.detail,
        seed="?" if run.seed is None else str(run.seed),
        config_hash=run.config_hash,
        config=yaml.safe_dump(run.config, sort_keys=False) if run.config else "",
        commit=commit_of(run),
        checkpoint=f"epoch {epoch}, {updates} updates" if epoch is not None else "?",
        data=tuple((name, *data_hashes(run, name)) for name in objects),
    )


def commit_of(run: RunRecord) -> str:
    """Commit of the program that evaluated the run, ``+`` where it was modified; else its version; else ``?``."""
    facts = (run.summary or {}).get("provenance")
    if not isinstance(facts, dict):
        return "?"
    commit = facts.get("commit")
    if isinstance(commit, str):
        return commit[:_DIGITS] + ("+" if facts.get("modified") else "")
    return f"gausim {facts['gausim']}" if isinstance(facts.get("gausim"), str) else "?"


def data_hashes(run: RunRecord, name: str) -> tuple[str, str]:
    """First digits of the hashes of an object's scene and manifest; ``?`` where the run did not record them."""
    entry = (run.summary or {}).get("objects", {}).get(name, {})
    sources = entry.get("sources") if isinstance(entry, dict) else None
    found = []
    for key in ("scene", "manifest"):
        file = sources.get(key) if isinstance(sources, dict) else None
        digest = file.get("sha256") if isinstance(file, dict) else None
        found.append(digest[:_DIGITS] if isinstance(digest, str) else "?")
    return found[0], found[1]
