"""Loggers of resumable runs: no duplicate rows, and none lost up to the checkpoint.

Only the first rank has loggers.
"""

from __future__ import annotations

import io
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import yaml
from lightning.pytorch.loggers import Logger, TensorBoardLogger
from PIL import Image

from gausim.io.video import read_video, video_rate, write_gif
from gausim.training.loggers.media import Media
from gausim.training.table import Table


@runtime_checkable
class Resumable(Protocol):
    """A logger that can remove later steps."""

    def resume_at(self, step: int) -> None:
        """Removes entries of optimiser steps after ``step``; 0 is a new run."""
        ...


class CsvLog(Logger):
    """One table ``csv/metrics.csv`` (Lightning's logger deletes the rows of an earlier process)."""

    version = ""

    def __init__(self, save_dir: str | Path, *, name: str = "csv") -> None:
        """The table goes to ``save_dir/name``."""
        super().__init__()
        self._name, self.table = name, Table(Path(save_dir) / name / "metrics.csv", "step")

    @property
    def name(self) -> str:
        """The folder's name."""
        return self._name

    def log_hyperparams(self, params: Any, *args: Any, **kwargs: Any) -> None:
        """Does nothing: the run directory contains the configuration."""

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Writes one row; columns not seen before are added to the table."""
        self.table.append({"step": step, **{name: float(value) for name, value in metrics.items()}})

    def resume_at(self, step: int) -> None:
        """Drops the rows of later steps."""
        self.table.resume_at(step)


class TensorBoardLog(TensorBoardLogger):
    """TensorBoard's events in one folder; events of steps that a resumed run repeats are marked as invalid.

    Videos are animated GIFs under IMAGES, tables and the configuration are under TEXT.
    """

    def __init__(self, save_dir: str | Path, *, name: str = "tensorboard") -> None:
        """The events go to ``save_dir/name``."""
        super().__init__(save_dir, name=name, version="")

    def log_hyperparams(self, params: Any, *args: Any, **kwargs: Any) -> None:
        """Logs the configuration as text."""
        text = yaml.safe_dump(dict(params), sort_keys=False)
        self.experiment.add_text("config", "    " + text.replace("\n", "\n    "))  # indented text is code in Markdown

    def resume_at(self, step: int) -> None:
        """Marks later steps in earlier event files as invalid."""
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog

        restart = Event(step=step + 1, session_log=SessionLog(status=SessionLog.START))
        self.experiment.file_writer.add_event(restart)

    def log_media(self, media: Media) -> None:
        """Logs the media of one step."""
        for name in media.names:
            self._image(f"{name}/video", _gif(media.video(name)), media.step)
            for kind, path in media.pictures(name).items():
                self._image(f"{name}/{kind}", path.read_bytes(), media.step)
            self._image(f"{name}/errors", error_plot(media, name), media.step)
        columns, rows = media.objects()
        lines = ["| " + " | ".join(cells) + " |" for cells in (columns, ["---"] * len(columns), *rows)]
        self.experiment.add_text("objects", "\n".join(lines), media.step)

    def _image(self, tag: str, encoded: bytes, step: int) -> None:
        from tensorboard.compat.proto.summary_pb2 import Summary

        with Image.open(io.BytesIO(encoded)) as read:
            width, height = read.size
        image = Summary.Image(encoded_image_string=encoded, height=height, width=width, colorspace=3)
        self.experiment.file_writer.add_summary(Summary(value=[Summary.Value(tag=tag, image=image)]), step)


def error_plot(media: Media, name: str) -> bytes:
    """The errors of a sequence by frame, as PNG."""
    from matplotlib.figure import Figure

    columns, rows = media.errors(name)
    figure = Figure(figsize=(5.0, 2.8), dpi=100, layout="constrained")
    axes = figure.subplots()
    for column, (label, style) in enumerate(zip(columns[1:], ("-", "--"), strict=False), 1):
        axes.plot([int(row[0]) for row in rows], [float(row[column] or "nan") for row in rows], style, label=label)
    axes.set(xlabel="frame", ylabel="l2 x 1000", ylim=(0, None))
    axes.set_title(f"{name}, step {media.step}", fontsize=9, parse_math=False)
    axes.legend(fontsize=8)
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def _gif(video: Path) -> bytes:
    """A video as animated GIF, TensorBoard's only video format."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "video.gif"
        write_gif(path, read_video(video), video_rate(video))
        return path.read_bytes()
