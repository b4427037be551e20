"""Media on the dashboards of Lightning's loggers."""

from __future__ import annotations

import io
import tempfile
from pathlib import Path

from lightning.pytorch.loggers import Logger, MLFlowLogger, TensorBoardLogger, WandbLogger
from PIL import Image

from gausim.io.video import read_video, video_rate, write_gif
from gausim.training.media import Media


def log_media(logger: Logger, media: Media) -> None:
    """Shows the media of one optimiser step, if the logger shows media."""
    if isinstance(logger, TensorBoardLogger):
        _to_tensorboard(logger, media)
    elif isinstance(logger, WandbLogger):
        _to_wandb(logger, media)
    elif isinstance(logger, MLFlowLogger):
        logger.experiment.log_artifacts(logger.run_id, str(media.folder), f"media/{media.folder.name}")


def _to_tensorboard(logger: TensorBoardLogger, media: Media) -> None:
    for name in media.names:
        _image(logger, f"{name}/video", _gif(media.video(name)), media.step)
        for kind, path in media.pictures(name).items():
            _image(logger, f"{name}/{kind}", path.read_bytes(), media.step)
    columns, rows = media.objects()
    lines = ["| " + " | ".join(cells) + " |" for cells in (columns, ["---"] * len(columns), *rows)]
    logger.experiment.add_text("objects", "\n".join(lines), media.step)


def _image(logger: TensorBoardLogger, tag: str, encoded: bytes, step: int) -> None:
    """Adds an encoded image; the writer's own method takes no animation."""
    from tensorboard.compat.proto.summary_pb2 import Summary

    with Image.open(io.BytesIO(encoded)) as read:
        width, height = read.size
    image = Summary.Image(encoded_image_string=encoded, height=height, width=width, colorspace=3)
    logger.experiment.file_writer.add_summary(Summary(value=[Summary.Value(tag=tag, image=image)]), step)


def _gif(video: Path) -> bytes:
    """A video as animated GIF, TensorBoard's only video format."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "video.gif"
        write_gif(path, read_video(video), video_rate(video))
        return path.read_bytes()


def _to_wandb(logger: WandbLogger, media: Media) -> None:
    import wandb

    shown: dict[str, object] = {"trainer/global_step": media.step}  # the x axis of Lightning's metrics
    for name in media.names:
        shown[f"media/{name}/video"] = wandb.Video(str(media.video(name)), format="mp4")
        shown |= {f"media/{name}/{kind}": wandb.Image(str(path)) for kind, path in media.pictures(name).items()}
    columns, rows = media.objects()
    shown["media/objects"] = wandb.Table(columns=list[str | int](columns), data=rows)
    logger.experiment.log(shown)
