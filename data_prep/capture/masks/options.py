"""The options of `gausim prepare segment`, and what they choose."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from data_prep.capture.masks.cleanup import UNTOUCHED, Cleanup
from data_prep.capture.masks.onnx_segmenter import OnnxSegmenter
from data_prep.capture.masks.sam2_segmenter import Sam2Segmenter, load_predictor, make_prompt, read_prompts
from data_prep.capture.masks.segmenters import AlphaSegmenter, Backend, BackgroundSegmenter, ChromaSegmenter
from data_prep.common.command import Options, add_options, option
from gausim.core import ConfigError

BACKENDS = ("alpha", "background", "chroma", "onnx", "sam2")


def numbers(text: str) -> tuple[float, ...]:
    """Finite numbers between commas."""
    values = tuple(float(part) for part in text.split(","))
    if not all(math.isfinite(value) for value in values):
        raise argparse.ArgumentTypeError("must be finite")
    return values


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
class NetworkOptions(Options):
    """Of the backend onnx."""

    onnx: Path | None = option(None, "a salient-object network, [1, 3, H, W] to a map", metavar="FILE")
    onnx_size: int | None = option(None, "side of its input, where the file leaves it open", least=16, metavar="PIXELS")
    onnx_mean: tuple[float, ...] = option((128.0,), "taken from RGB in 0..255 (128)", type=numbers, metavar="M[,M,M]")
    onnx_scale: tuple[float, ...] = option((256.0,), "what is left is divided by it (256)", type=numbers,
                                           metavar="S[,S,S]")  # fmt: skip
    onnx_output: int = option(0, "which output is the mask (%(default)s)", least=0)
    onnx_activation: str = option("none", "what makes it 0..1 (%(default)s)", choices=("none", "sigmoid", "minmax"))


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


def add_segment_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options of cleaning and of all backends."""
    cleaning = parser.add_argument_group("cleaning (backend alpha: nothing unless asked for)")
    add_options(cleaning, Cleanup, unset=True)
    for title, kind in GROUPS.items():
        add_options(parser.add_argument_group(title), kind)


def make_cleanup(arguments: argparse.Namespace) -> Cleanup:
    """Options for the cleaning of masks; their defaults depend on the backend."""
    usual = UNTOUCHED if arguments.backend == "alpha" else Cleanup()
    given = {each.name: getattr(arguments, each.name) for each in fields(Cleanup)}
    return Cleanup(**{name: getattr(usual, name) if value is None else value for name, value in given.items()})


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
        return Backend("chroma", lambda: ChromaSegmenter(screen.key, grabcut=refine), settings=settings)
    if name == "onnx":
        return _onnx(network)
    return _sam2(tracker) if name == "sam2" else Backend("alpha", AlphaSegmenter, soft=True)


def _background(plate: Path | None, threshold: float | None, refine: bool) -> Backend:
    plates = [] if plate is None else sorted(p for p in plate.rglob("*") if p.is_file()) if plate.is_dir() else [plate]
    return Backend(
        "background",
        lambda: BackgroundSegmenter(plate, threshold, refine),
        settings={"plate": None if plate is None else plate.name, "threshold": threshold, "grabcut": refine},
        inputs={p.name if p == plate else p.relative_to(plate).as_posix(): p for p in plates},  # type: ignore[arg-type]
    )


def _onnx(chosen: NetworkOptions) -> Backend:
    path = chosen.onnx
    if path is None:
        raise ConfigError("--backend onnx: name the network with --onnx FILE.")
    names = ("size", "mean", "scale", "output", "activation")
    settings: dict[str, Any] = {name: getattr(chosen, f"onnx_{name}") for name in names}
    make = lambda: OnnxSegmenter(path, **settings)  # noqa: E731
    return Backend("onnx", make, True, settings, {"network": path}, ("onnxruntime",))


def _sam2(chosen: TrackerOptions) -> Backend:
    if chosen.sam2_checkpoint is None:
        raise ConfigError("--backend sam2: name the weights with --sam2-checkpoint FILE.")
    prompts = read_prompts(chosen.prompts) if chosen.prompts else {}
    if chosen.box or chosen.point:
        prompts[""] = make_prompt({"box": chosen.box, "points": chosen.point}, "--box, --point")
    if not prompts:
        raise ConfigError("--backend sam2: say where the object is, with --box, --point or --prompts.")
    predictor = load_predictor(chosen.sam2_checkpoint, chosen.sam2_config, device=chosen.device)
    return Backend(
        "sam2",
        lambda: Sam2Segmenter(predictor, prompts, device=chosen.device),
        soft=True,
        settings={
            "config": chosen.sam2_config,
            "prompts": {name: {"box": prompt.box, "points": prompt.points} for name, prompt in prompts.items()},
        },
        inputs={"checkpoint": chosen.sam2_checkpoint},
        packages=("sam2", "torch"),
    )
