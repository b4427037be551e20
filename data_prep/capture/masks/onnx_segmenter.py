"""Foreground masks by a salient-object network in ONNX form, run by onnxruntime (extra ``segment``)."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from data_prep.capture.masks.clips import Clip
from data_prep.capture.masks.segmenters import MaskOf
from data_prep.common.command import Options, numbers, option
from gausim.core import ConfigError, DataError

ACTIVATIONS = ("none", "sigmoid", "minmax")


@dataclass(frozen=True)
class NetworkOptions(Options):
    """Of the backend onnx."""

    onnx: Path | None = option(None, "a salient-object network, [1, 3, H, W] to a map", metavar="FILE")
    onnx_size: int | None = option(None, "side of its input, where the file leaves it open", least=16, metavar="PIXELS")
    onnx_mean: tuple[float, ...] = option((128.0,), "taken from RGB in 0..255 (128)", type=numbers, metavar="M[,M,M]")
    onnx_scale: tuple[float, ...] = option((256.0,), "what is left is divided by it (256)", type=numbers,
                                           metavar="S[,S,S]")  # fmt: skip
    onnx_output: int = option(0, "which output is the mask (%(default)s)", least=0)
    onnx_activation: str = option("none", "what makes it 0..1 (%(default)s)", choices=ACTIVATIONS)


class OnnxSegmenter:
    """Any network that maps one picture, (1, 3, H, W) float32, to one map of saliency."""

    def __init__(self, options: NetworkOptions) -> None:
        """Loads the network.

        Raises:
            ConfigError: onnxruntime is not installed, or an option does not fit the network.
            DataError: the file is no such network.
        """
        try:
            import onnxruntime
        except ImportError as error:
            raise ConfigError("onnxruntime runs this backend. Install it: `pip install 'gausim[segment]'`.") from error
        path = options.onnx
        if path is None or not path.is_file():
            raise DataError(f"{path}: no such network.")
        session = onnxruntime.SessionOptions()
        session.intra_op_num_threads = int(os.environ.get("OMP_NUM_THREADS") or 0)
        session.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(str(path), session, providers=["CPUExecutionProvider"])
        except Exception as error:  # its exceptions have no common base
            raise DataError(f"{path}: cannot be loaded as an ONNX network ({error}).") from error
        mean, scale = options.onnx_mean, options.onnx_scale
        self._path, self._output, self._activation = path, options.onnx_output, options.onnx_activation
        self._mean, self._scale = np.asarray(mean, np.float32), np.asarray(scale, np.float32)
        self._size = self._input_size(options.onnx_size)
        outputs = self._session.get_outputs()
        if self._output >= len(outputs):
            raise ConfigError(f"{path}: has outputs 0 to {len(outputs) - 1}, asked for {self._output}.")
        if len(mean) not in (1, 3) or len(scale) not in (1, 3) or 0 in scale:
            raise ConfigError(f"{path}: expected one or three means and scales that are not 0; got {mean}, {scale}.")

    def open(self, clip: Clip) -> MaskOf:
        """See :class:`data_prep.capture.masks.segmenters.Backend`."""
        return lambda index: self.mask(clip.rgb(index))

    def mask(self, rgb: np.ndarray) -> np.ndarray:
        """The mask of an (H, W, 3) uint8 picture, (H, W) float32 in 0..1.

        Raises:
            DataError: the network fails, or gives no map of numbers in 0..1.
        """
        height, width = rgb.shape[:2]
        values = cv2.resize(rgb, self._size, interpolation=cv2.INTER_LINEAR).astype(np.float32)
        values = np.ascontiguousarray(((values - self._mean) / self._scale).transpose(2, 0, 1)[None], np.float32)
        name = self._session.get_inputs()[0].name
        try:
            found: Any = self._session.run([self._session.get_outputs()[self._output].name], {name: values})[0]
        except Exception as error:  # its exceptions have no common base
            raise DataError(f"{self._path}: fails on an input of {values.shape} ({error}). Try --onnx-size.") from error
        saliency = np.asarray(found, np.float32).squeeze()
        if saliency.ndim != 2 or not np.isfinite(saliency).all():
            raise DataError(
                f"{self._path}: output {self._output} has shape {np.shape(found)}"
                f"{'' if np.isfinite(saliency).all() else ' and values that are no numbers'}, expected one map of "
                "finite numbers. Choose another with --onnx-output."
            )
        return cv2.resize(self._activated(saliency), (width, height), interpolation=cv2.INTER_LINEAR).clip(0, 1)

    def _activated(self, saliency: np.ndarray) -> np.ndarray:
        if self._activation == "sigmoid":
            return np.asarray(1 / (1 + np.exp(-saliency.clip(-60, 60))), np.float32)
        low, high = float(saliency.min()), float(saliency.max())
        if self._activation == "minmax":
            return (saliency - low) / max(high - low, 1e-6)
        if low < -0.01 or high > 1.01:
            raise DataError(
                f"{self._path}: output {self._output} has values of {low:.3g} to {high:.3g}, expected 0 to 1. Try "
                "--onnx-activation sigmoid, or another --onnx-output."
            )
        return saliency

    def _input_size(self, size: int | None) -> tuple[int, int]:
        """Width and height of the input."""
        inputs = self._session.get_inputs()
        shape = inputs[0].shape
        if len(inputs) != 1 or len(shape) != 4 or shape[1] != 3 or inputs[0].type != "tensor(float)":
            found = [(i.name, i.type, i.shape) for i in inputs]
            raise DataError(f"{self._path}: expected one input of float32, [1, 3, H, W]; got {found}.")
        height, width = (n if isinstance(n, int) and n > 0 else size for n in shape[2:])
        if not height or not width:
            raise ConfigError(f"{self._path}: leaves the size of its input open ({shape}). State it with --onnx-size.")
        if size and (height, width) != (size, size):
            raise ConfigError(f"{self._path}: its input is {width}x{height}, --onnx-size says {size}.")
        return width, height
