"""Foreground masks by a salient-object network in ONNX form, run by onnxruntime (extra ``segment``)."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from data_prep.capture.masks.clips import Clip
from data_prep.capture.masks.segmenters import MaskOf
from gausim.core import ConfigError, DataError

ACTIVATIONS = ("none", "sigmoid", "minmax")


class OnnxSegmenter:
    """Any network that maps one picture, (1, 3, H, W) float32, to one map of saliency."""

    def __init__(
        self,
        path: Path,
        *,
        size: int | None = None,
        mean: tuple[float, ...] = (128.0,),
        scale: tuple[float, ...] = (256.0,),
        output: int = 0,
        activation: str = "none",
    ) -> None:
        """Loads the network.

        Raises:
            ConfigError: onnxruntime is not installed, or an option does not fit the network.
            DataError: the file is no such network.
        """
        try:
            import onnxruntime
        except ImportError as error:
            raise ConfigError("onnxruntime runs this backend. Install it: `pip install 'gausim[segment]'`.") from error
        if not path.is_file():
            raise DataError(f"{path}: no such network.")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = int(os.environ.get("OMP_NUM_THREADS") or 0)
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # its exceptions have no common base
            raise DataError(f"{path}: cannot be loaded as an ONNX network ({error}).") from error
        self._path, self._output, self._activation = path, output, activation
        self._mean, self._scale = np.asarray(mean, np.float32), np.asarray(scale, np.float32)
        self._size = self._input_size(size)
        outputs = self._session.get_outputs()
        if not 0 <= output < len(outputs):
            raise ConfigError(f"{path}: has outputs 0 to {len(outputs) - 1}, asked for {output}.")
        if activation not in ACTIVATIONS or len(mean) not in (1, 3) or len(scale) not in (1, 3) or 0 in scale:
            raise ConfigError(
                f"{path}: expected an activation of {ACTIVATIONS}, one or three means and scales that are not 0; got "
                f"'{activation}', {mean}, {scale}."
            )

    def open(self, clip: Clip) -> MaskOf:
        """See :class:`data_prep.capture.masks.segmenters.Segmenter`."""
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
