"""Media on the dashboards of Lightning's loggers."""

import io
import tempfile
from pathlib import Path

from lightning.pytorch.loggers import Logger, MLFlowLogger, TensorBoardLogger, WandbLogger
from PIL import Image

from gausim.io.video import read_video, video_rate, write_gif


def log_media(logger: Logger, folder: Path, step: int) -> None:
    """Shows the videos and pictures in a folder, if the logger shows media."""
    if isinstance(logger, TensorBoardLogger):
        for path in sorted(folder.iterdir()):
            encoded = _gif(path) if path.suffix == ".mp4" else path.read_bytes()
            _image(logger, f"{path.stem}/{'video' if path.suffix == '.mp4' else 'frames'}", encoded, step)
    elif isinstance(logger, WandbLogger):
        import wandb

        shown: dict[str, object] = {"trainer/global_step": step}  # the x axis of Lightning's metrics
        shown |= {f"media/{path.stem}/video": wandb.Video(str(path), format="mp4") for path in folder.glob("*.mp4")}
        shown |= {f"media/{path.stem}/frames": wandb.Image(str(path)) for path in folder.glob("*.png")}
        logger.experiment.log(shown)
    elif isinstance(logger, MLFlowLogger):
        logger.experiment.log_artifacts(logger.run_id, str(folder), f"media/{folder.name}")


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
