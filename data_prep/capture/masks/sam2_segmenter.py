"""Foreground masks by SAM 2 (Ravi et al. 2024), prompted on a clip's first picture and followed through the others.

Needs the package ``sam2`` and a checkpoint that lies on this machine; neither comes with gausim.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from msgspec import Struct

from data_prep.capture.masks.clips import Clip
from data_prep.capture.masks.segmenters import MaskOf
from gausim.core import ConfigError, DataError
from gausim.io.plain_json import checked

# The predictor reads JPEG files only; at this quality they differ from the frames by less than a camera's noise.
JPEG_QUALITY = 98


class Prompt(Struct, frozen=True, forbid_unknown_fields=True):
    """Point or box of the object in the first picture of a clip [pixels]."""

    box: tuple[float, float, float, float] | None = None  # left, top, right, bottom; None without
    points: tuple[tuple[float, float, float], ...] = ()  # x, y and 1 for object or 0 for background


class Sam2Segmenter:
    """SAM 2's video predictor."""

    def __init__(self, predictor: Any, prompts: Mapping[str, Prompt], *, device: str = "cpu") -> None:
        """Takes a ``sam2.sam2_video_predictor.SAM2VideoPredictor`` and prompts by clip."""
        self._predictor, self._prompts, self._device = predictor, prompts, device

    def open(self, clip: Clip) -> MaskOf:
        """See :class:`~data_prep.capture.masks.segmenters.Backend`; pictures are followed once, in order."""
        height, width = clip.rgb(0).shape[:2]
        prompt = _fitting(self._prompts.get(clip.name, self._prompts.get("")), clip, width, height)
        masks = self._follow(clip, prompt, (height, width))

        def mask(index: int) -> np.ndarray:
            for number, found in masks:
                if number == index:
                    return found
            raise ValueError(f"masks are asked for once and in order, which {index} is not")

        return mask

    def _follow(self, clip: Clip, prompt: Prompt, size: tuple[int, int]) -> Iterator[tuple[int, np.ndarray]]:
        import torch

        with tempfile.TemporaryDirectory() as folder:
            for i in range(len(clip)):
                rgb = clip.rgb(i)
                if rgb.shape[:2] != size:
                    raise DataError(f"{clip.file(i)}: has another size than the first picture of its folder.")
                pixels = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
                cv2.imwrite(f"{folder}/{i:05d}.jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            with self._precision():
                state = self._predictor.init_state(video_path=folder, offload_video_to_cpu=True)
                self._predictor.add_new_points_or_box(state, frame_idx=0, obj_id=1, **_arguments(prompt))
                frames = iter(self._predictor.propagate_in_video(state))
            for expected in range(len(clip)):
                # Entered anew for every frame: held over a yield it would change what the caller computes.
                with self._precision():
                    index, _, logits = next(frames, (-1, [], np.zeros(0)))
                if index != expected or tuple(logits.shape[-2:]) != size:
                    raise DataError(f"{clip.file(expected)}: the predictor gave no mask of this picture (got {index}).")
                values = torch.sigmoid(torch.as_tensor(logits).float()[0]).reshape(size)
                yield expected, values.cpu().numpy().astype(np.float32)

    def _precision(self) -> AbstractContextManager[Any]:
        import torch

        return torch.autocast("cuda", dtype=torch.bfloat16) if self._device.startswith("cuda") else nullcontext()


def load_predictor(checkpoint: Path, config: str, *, device: str) -> Any:
    """SAM 2's video predictor with the weights of a local checkpoint, read without pickles of code.

    Raises:
        ConfigError: the package is not installed, or has no such configuration.
        DataError: the checkpoint is missing, broken, or of another configuration.
    """
    try:
        from sam2.build_sam import build_sam2_video_predictor
    except ImportError as error:
        raise ConfigError(
            "this backend needs the package sam2 (Meta's SAM 2), which is not installed. Install it beside gausim, "
            "download a checkpoint, and name it with --sam2-checkpoint; or choose another --backend."
        ) from error
    import torch

    if not checkpoint.is_file():
        raise DataError(f"{checkpoint}: no such checkpoint. Download one of SAM 2's and name it here.")
    try:
        weights = torch.load(checkpoint, map_location="cpu", weights_only=True)["model"]
    except Exception as error:  # anything may be wrong with a file
        raise DataError(f"{checkpoint}: is no checkpoint of SAM 2 ({error}).") from error
    try:
        predictor = build_sam2_video_predictor(config, ckpt_path=None, device=device)
    except Exception as error:  # Hydra's and the package's own
        raise ConfigError(f"--sam2-config: '{config}' cannot be built by the package sam2 ({error}).") from error
    try:
        predictor.load_state_dict(weights)
    except (RuntimeError, TypeError, AttributeError) as error:
        raise DataError(f"{checkpoint}: does not fit the configuration '{config}' ({error}).") from error
    return predictor


def make_prompt(given: Any, where: str) -> Prompt:
    """A checked prompt from plain data.

    Raises:
        DataError: numbers are missing, not finite, or not in order.
    """
    prompt = checked(given, Prompt, where, "Expected a box [x0, y0, x1, y1] and points [[x, y, 1 or 0]].")
    x0, y0, x1, y1 = prompt.box or (0.0, 0.0, 1.0, 1.0)
    numbers = [x0, y0, x1, y1, *(v for mark in prompt.points for v in mark)]
    labels = [label for *_, label in prompt.points]
    if not np.isfinite(numbers).all() or not (x0 < x1 and y0 < y1) or not set(labels) <= {0, 1}:
        raise DataError(f"{where}: expected finite numbers, a box x0 < x1, y0 < y1 and labels 0 or 1, got {given}.")
    if prompt.box is None and not any(labels):
        raise DataError(f"{where}: needs a box, or a point on the object.")
    return prompt


def _fitting(prompt: Prompt | None, clip: Clip, width: int, height: int) -> Prompt:
    if prompt is None:
        raise DataError(f"prompts: none for '{clip.name}'. Give --box or --point for all, or a file with --prompts.")
    places = [(x, y) for x, y, _ in prompt.points]
    places += [prompt.box[:2], prompt.box[2:]] if prompt.box else []
    if any(not (0 <= x <= width and 0 <= y <= height) for x, y in places):
        raise DataError(f"prompts: '{clip.name}': {places} lie outside of its pictures of {width}x{height}.")
    return prompt


def _arguments(prompt: Prompt) -> dict[str, Any]:
    found: dict[str, Any] = {}
    if prompt.box:
        found["box"] = np.array(prompt.box, np.float32)
    if prompt.points:
        found["points"] = np.array([point[:2] for point in prompt.points], np.float32)
        found["labels"] = np.array([point[2] for point in prompt.points], np.int32)
    return found
