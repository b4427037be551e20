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

    def __post_init__(self) -> None:
        """Checks the numbers."""
        super().__post_init__()
        if not {len(self.onnx_mean), len(self.onnx_scale)} <= {1, 3} or 0 in self.onnx_scale:
            raise ConfigError("--onnx-mean, --onnx-scale: expected one or three numbers, scales other than 0.")


class OnnxSegmenter:
    """Any network that maps one picture, (1, 3, H, W) float32, to one map of saliency."""

    def __init__(self, options: NetworkOptions) -> None:
        """Loads the network."""
        try:
            import onnxruntime
        except ImportError as error:
            raise ConfigError("onnxruntime runs this backend. Install it: `pip install 'gausim[segment]'`.") from error
        self._path, self._options = options.onnx, options
        if self._path is None or not self._path.is_file():
            raise DataError(f"{self._path}: no such network.")
        session = onnxruntime.SessionOptions()
        session.intra_op_num_threads = int(os.environ.get("OMP_NUM_THREADS") or 0)
        session.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(str(self._path), session, providers=["CPUExecutionProvider"])
        except Exception as error:  # its exceptions have no common base
            raise DataError(f"{self._path}: cannot be loaded as an ONNX network ({error}).") from error
        self._size = self._input_size(options.onnx_size)
        if options.onnx_output >= (count := len(self._session.get_outputs())):
            raise ConfigError(f"{self._path}: has outputs 0 to {count - 1}, asked for {options.onnx_output}.")

    def open(self, clip: Clip) -> MaskOf:
        """See :class:`data_prep.capture.masks.segmenters.Backend`."""
        return lambda index: self.mask(clip.rgb(index))

    def mask(self, rgb: np.ndarray) -> np.ndarray:
        """The mask of an (H, W, 3) uint8 picture, (H, W) float32 in 0..1."""
        options, (height, width) = self._options, rgb.shape[:2]
        values = cv2.resize(rgb, self._size, interpolation=cv2.INTER_LINEAR).astype(np.float32)
        values = (values - np.array(options.onnx_mean, np.float32)) / np.array(options.onnx_scale, np.float32)
        values = np.ascontiguousarray(values.transpose(2, 0, 1)[None], np.float32)
        name, output = self._session.get_inputs()[0].name, self._session.get_outputs()[options.onnx_output].name
        try:
            found: Any = self._session.run([output], {name: values})[0]
        except Exception as error:  # its exceptions have no common base
            raise DataError(f"{self._path}: fails on an input of {values.shape} ({error}). Try --onnx-size.") from error
        map_ = np.asarray(found, np.float32).squeeze()
        if map_.ndim != 2 or not np.isfinite(map_).all():
            raise DataError(
                f"{self._path}: output {options.onnx_output} of shape {np.shape(found)} is no map of finite numbers. "
                "Choose another with --onnx-output."
            )
        return cv2.resize(self._activated(map_), (width, height), interpolation=cv2.INTER_LINEAR).clip(0, 1)

    def _activated(self, saliency: np.ndarray) -> np.ndarray:
        if self._options.onnx_activation == "sigmoid":
            return np.asarray(1 / (1 + np.exp(-saliency.clip(-60, 60))), np.float32)
        low, high = float(saliency.min()), float(saliency.max())
        if self._options.onnx_activation == "minmax":
            return (saliency - low) / max(high - low, 1e-6)
        if low < -0.01 or high > 1.01:
            raise DataError(
                f"{self._path}: its output has values of {low:.3g} to {high:.3g}, expected 0 to 1. Try "
                "--onnx-activation sigmoid, or another --onnx-output."
            )
        return saliency

    def _input_size(self, size: int | None) -> tuple[int, int]:
        """Width and height of the input."""
        given = self._session.get_inputs()
        shape = given[0].shape
        if len(given) != 1 or len(shape) != 4 or shape[1] != 3 or given[0].type != "tensor(float)":
            found = [(i.name, i.type, i.shape) for i in given]
            raise DataError(f"{self._path}: expected one input of float32, [1, 3, H, W]; got {found}.")
        height, width = (n if isinstance(n, int) and n > 0 else size for n in shape[2:])
        if not height or not width or (size and (height, width) != (size, size)):
            raise ConfigError(f"{self._path}: its input is {shape}, --onnx-size is {size}. State a size that fits.")
        return width, height
