"""Warp, imported when a simulation first needs it."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch

from gausim.core import ConfigError


def warp() -> Any:
    """The module ``warp``, initialised without its banner.

    Raises:
        ConfigError: Warp is not installed.
    """
    try:
        import warp as wp
    except ImportError as error:
        raise ConfigError(
            "the material point method needs NVIDIA Warp, which is not installed: pip install 'gausim[baselines]'."
        ) from error
    if wp.config.log_level < wp.LOG_WARNING:
        wp.config.log_level = wp.LOG_WARNING
    wp.init()
    return wp


def on_stream_of(device: torch.device) -> AbstractContextManager[Any]:
    """Runs a block on torch's stream of a CUDA device, so that the work of both libraries stays in order."""
    wp = warp()
    if device.type != "cuda":
        return nullcontext()
    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device)))
