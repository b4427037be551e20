"""The options of `gausim prepare segment`, and what they choose."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from data_prep.capture.masks.onnx_segmenter import NetworkOptions, OnnxSegmenter
from data_prep.capture.masks.sam2_segmenter import Sam2Segmenter, load_predictor, make_prompt
from data_prep.capture.masks.segmenters import Backend, BackgroundSegmenter, ChromaSegmenter, alpha_masks
from data_prep.common.command import Options, numbers, option
from gausim.core import ConfigError
from gausim.io.plain_json import read_json

BACKENDS = ("alpha", "background", "chroma", "onnx", "sam2")


def colour(text: str) -> tuple[int, int, int]:
    """Red, green and blue from six hexadecimal digits."""
    try:
        red, green, blue = bytes.fromhex(text.removeprefix("#"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected six hexadecimal digits such as 00b140, got {text!r}") from None
    return red, green, blue


@dataclass(frozen=True)
class ScreenOptions(Options):
    """Of the backends background and chroma."""

    plate: Path | None = option(None, "picture of the empty scene, or a folder with one per camera (cam_0.png)")
    threshold: float | None = option(None, "difference in CIE Lab that counts (from the noise)", least=0, most=200)
    key: tuple[int, int, int] | None = option(
        None, "colour of the screen (that of the picture's border)", type=colour, metavar="RRGGBB"
    )
    no_grabcut: bool = option(False, "leave the masks as the difference gives them")


@dataclass(frozen=True)
class TrackerOptions(Options):
    """Of the backend sam2."""

    sam2_checkpoint: Path | None = option(None, "weights on this machine", metavar="FILE")
    sam2_config: str = option("configs/sam2.1/sam2.1_hiera_s.yaml", "of the package (%(default)s)")
    device: str = option("cpu", "cpu or cuda (%(default)s)")
    box: tuple[float, ...] | None = option(
        None, "around the object on every folder's first picture [pixels]", type=numbers, metavar="X0,Y0,X1,Y1"
    )
    point: tuple[tuple[float, ...], ...] = option(
        (), "on the object (1) or not (0); repeatable", type=numbers, action="append", metavar="X,Y,1|0"
    )
    prompts: Path | None = option(None, 'by folder: {"FOLDER": {"box": [...], "points": [[x, y, 1]]}}', metavar="FILE")


GROUPS = {
    "backends background and chroma": ScreenOptions,
    "backend onnx": NetworkOptions,
    "backend sam2": TrackerOptions,
}


def make_backend(name: str, screen: ScreenOptions, network: NetworkOptions, tracker: TrackerOptions) -> Backend:
    """The backend of a name.

    Raises:
        ConfigError: an option that it needs is missing, or a package.
        DataError: a file of it is unusable.
    """
    refine = not screen.no_grabcut
    if name == "background":
        return _background(screen.plate, screen.threshold, refine)
    if name == "chroma":
        settings = {"key": screen.key, "grabcut": refine}
        return Backend("chroma", ChromaSegmenter(screen.key, refine).open, settings=settings)
    if name == "onnx":
        return _onnx(network)
    return _sam2(tracker) if name == "sam2" else Backend("alpha", alpha_masks, soft=True)


def _background(plate: Path | None, threshold: float | None, refine: bool) -> Backend:
    plates = [] if plate is None else sorted(p for p in plate.rglob("*") if p.is_file()) if plate.is_dir() else [plate]
    return Backend(
        "background",
        BackgroundSegmenter(plate, threshold, refine).open,
        settings={"plate": None if plate is None else plate.name, "threshold": threshold, "grabcut": refine},
        inputs={p.name if p == plate else p.relative_to(plate).as_posix(): p for p in plates},  # type: ignore[arg-type]
    )


def _onnx(chosen: NetworkOptions) -> Backend:
    if chosen.onnx is None:
        raise ConfigError("--backend onnx: name the network with --onnx FILE.")
    names = ("size", "mean", "scale", "output", "activation")
    settings: dict[str, Any] = {name: getattr(chosen, f"onnx_{name}") for name in names}
    # Loaded once, and only if there is something to do.
    network = cache(OnnxSegmenter)
    return Backend(
        "onnx", lambda clip: network(chosen).open(clip), True, settings, {"network": chosen.onnx}, ("onnxruntime",)
    )


def _sam2(chosen: TrackerOptions) -> Backend:
    if chosen.sam2_checkpoint is None:
        raise ConfigError("--backend sam2: name the weights with --sam2-checkpoint FILE.")
    listed = read_json(chosen.prompts) if chosen.prompts else {}
    prompts = {name: make_prompt(entry, f"{chosen.prompts}: '{name}'") for name, entry in listed.items()}
    if chosen.box or chosen.point:
        prompts[""] = make_prompt({"box": chosen.box, "points": chosen.point}, "--box, --point")
    if not prompts:
        raise ConfigError("--backend sam2: say where the object is, with --box, --point or --prompts.")
    predictor = load_predictor(chosen.sam2_checkpoint, chosen.sam2_config, device=chosen.device)
    return Backend(
        "sam2",
        Sam2Segmenter(predictor, prompts, device=chosen.device).open,
        soft=True,
        settings={
            "config": chosen.sam2_config,
            "prompts": {name: {"box": prompt.box, "points": prompt.points} for name, prompt in prompts.items()},
        },
        inputs={"checkpoint": chosen.sam2_checkpoint},
        packages=("sam2", "torch"),
    )
