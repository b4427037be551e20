"""Media of training for dashboards: predictions of seen frames, every few epochs."""

import math
from pathlib import Path

import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from gausim.core import ConfigError, DivergenceError
from gausim.data.dataset import SequenceSample
from gausim.data.images import composite
from gausim.metrics.image import L2
from gausim.render.draw import to_bytes
from gausim.runs.randomness import undisturbed
from gausim.training.callbacks.cadence import has_come, training_data
from gausim.training.dashboards import log_media
from gausim.training.media import Clip, forget_media, safe_name, write_media
from gausim.training.module import GausSimModule

# Objects that are shown.
MOST_OBJECTS = 4


class Panels(Callback):
    """Renders predictions of the first sequence of the first objects in its first training camera.

    Frames 0..``t_max`` of the plan are predicted, whatever the current T; unseen frames are not read. Videos and
    pictures go to ``panels/`` of the run and to every logger that shows media, errors as numbers to every logger. There
    is no effect on training.
    """

    def __init__(self, *, every_epochs: int = 5) -> None:
        """Renders every ``every_epochs`` epochs (0: never) and after the last."""
        if every_epochs < 0:
            raise ConfigError(f"trainer.panel_epochs: expected at least 0, got {every_epochs}.")
        self._every = every_epochs

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Removes the media of steps that a resumed run repeats."""
        if trainer.is_global_zero:
            forget_media(Path(trainer.default_root_dir), trainer.global_step)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Renders the predictions if the epoch is due."""
        if trainer.is_global_zero and has_come(trainer, self._every):
            assert isinstance(pl_module, GausSimModule)
            with undisturbed():
                self._show(trainer, pl_module)

    def _show(self, trainer: Trainer, module: GausSimModule) -> None:
        clips, numbers = [], dict[str, float]()
        for sample in self._samples(trainer, module):
            try:
                clip, own, ratio = _clip(module, sample)
            except DivergenceError as error:
                module.print(f"no panel of {sample.object_name} at step {trainer.global_step}: {error}")
                continue
            clips.append(clip)
            prefix = f"objects/{sample.object_name}"
            numbers |= {f"{prefix}/l2": own, f"{prefix}/ratio_static": ratio}
        if not clips:
            return
        folder = write_media(Path(trainer.default_root_dir), trainer.global_step, clips)
        for logger in trainer.loggers:
            logger.log_metrics(numbers, step=trainer.global_step)
            log_media(logger, folder, trainer.global_step)

    def _samples(self, trainer: Trainer, module: GausSimModule) -> list[SequenceSample]:
        data = training_data(trainer)
        first: dict[int, int] = {}
        for sequence, (scene_id, _) in enumerate(data.index.entries):
            first.setdefault(scene_id, sequence)
        frames = range((data.plan.t_max or 0) + 1 if data.plan else 0)
        chosen = list(first.items())[:MOST_OBJECTS]
        return [data.index.sample(s, frames, data.objects[i].train_views[:1]).to(module.device) for i, s in chosen]


def _clip(module: GausSimModule, sample: SequenceSample) -> tuple[Clip, float, float]:
    """The media of a sequence, its l2 over the predicted frames, and that over the static prediction's."""
    prediction = module.predict_images(sample)[:, 0].clamp(0, 1)
    if not bool(torch.isfinite(prediction).all()):
        raise DivergenceError("the predicted images are not finite")
    truth, alpha = (x[:, 0] for x in composite(sample.frames))
    truth, metric = truth.to(prediction), L2()
    own, still = (
        float(metric.per_image(images, truth, alpha > 0)[1:].double().mean())
        for images in (prediction, prediction[:1].expand_as(truth))
    )
    name = safe_name(sample.object_name, sample.sequence_name)
    title = f"{sample.object_name}/{sample.sequence_name} {sample.cameras.names[0]}"
    drawn = [to_bytes(images).cpu().numpy() for images in (truth, prediction)]
    return Clip(name, title, sample.fps, *drawn), own, own / still if still > 0 else math.nan
