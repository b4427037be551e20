"""Choice of the device that a command computes on."""

import re

import torch

from gausim.core import ConfigError


def find_device(text: str = "auto") -> torch.device:
    """Reads ``auto`` (the GPU where there is one, else the CPU), ``cpu``, ``cuda`` or ``cuda:N``.

    Raises:
        ConfigError: the text has another form, or there is no such GPU.
    """
    gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if text == "auto":
        return torch.device("cuda" if gpus else "cpu")
    if re.fullmatch(r"cpu|cuda(:\d{1,3})?", text) is None:
        raise ConfigError(f"--device {text}: expected auto, cpu, cuda or cuda:N.")
    device = torch.device(text)
    if device.type == "cuda" and (device.index or 0) >= gpus:
        raise ConfigError(f"--device {text}: PyTorch sees {gpus} CUDA devices. Take --device cpu, or install a driver.")
    return device
