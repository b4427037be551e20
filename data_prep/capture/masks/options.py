"""The options of ``gausim prepare segment``, and what they choose."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from data_prep.common.command import add_result
from gausim.core import ConfigError

if TYPE_CHECKING:
    from data_prep.capture.masks.backend import Backend
    from data_prep.capture.masks.cleanup import Cleanup


def add_options(parser: argparse.ArgumentParser, backends: tuple[str, ...]) -> None:
    """Adds all options, grouped."""
    parser.add_argument(
        "pictures", type=Path, metavar="PICTURES", help="folder of pictures, a result of ingest, or a film"
    )
    parser.add_argument("--backend", choices=backends, required=True, help="what makes the masks")
    parser.add_argument(
        "--every", type=whole(1), default=1, metavar="N", help="only each N-th picture, to try out (%(default)s)"
    )
    kinds = "film: a camera that stands still, frames in order; auto: films, and folders in sequences/ (%(default)s)"
    parser.add_argument("--kind", choices=("auto", "film", "stills"), default="auto", help=kinds)
    add_result(parser)
    _cleanup_options(parser.add_argument_group("cleaning (backend alpha: nothing unless asked for)"))
    group = parser.add_argument_group("backends background and chroma")
    group.add_argument(
        "--plate", type=Path, help="picture of the empty scene, or a folder with one per camera (cam_0.png)"
    )
    group.add_argument("--threshold", type=number(0, 200), help="difference in CIE Lab that counts (from the noise)")
    group.add_argument(
        "--key", type=colour, metavar="RRGGBB", help="colour of the screen (that of the picture's border)"
    )
    group.add_argument("--no-grabcut", action="store_true", help="leave the masks as the difference gives them")
    group = parser.add_argument_group("backend onnx")
    group.add_argument("--onnx", type=Path, metavar="FILE", help="a salient-object network, [1, 3, H, W] to a map")
    group.add_argument(
        "--onnx-size", type=whole(16), metavar="PIXELS", help="side of its input, where the file leaves it open"
    )
    group.add_argument(
        "--onnx-mean", type=numbers, default=(128.0,), metavar="M[,M,M]", help="taken from RGB in 0..255 (128)"
    )
    group.add_argument(
        "--onnx-scale", type=numbers, default=(256.0,), metavar="S[,S,S]", help="what is left is divided by it (256)"
    )
    group.add_argument("--onnx-output", type=whole(0), default=0, help="which output is the mask (%(default)s)")
    group.add_argument(
        "--onnx-activation",
        choices=("none", "sigmoid", "minmax"),
        default="none",
        help="what makes it 0..1 (%(default)s)",
    )
    group = parser.add_argument_group("backend sam2")
    group.add_argument("--sam2-checkpoint", type=Path, metavar="FILE", help="weights on this machine")
    group.add_argument(
        "--sam2-config", default="configs/sam2.1/sam2.1_hiera_s.yaml", help="of the package (%(default)s)"
    )
    group.add_argument("--device", default="cpu", help="cpu or cuda (%(default)s)")
    group.add_argument(
        "--box", type=numbers, metavar="X0,Y0,X1,Y1", help="around the object on every folder's first picture [pixels]"
    )
    group.add_argument(
        "--point", type=numbers, action="append", default=[], metavar="X,Y,1|0", help="on the object (1) or not (0)"
    )
    group.add_argument(
        "--prompts", type=Path, metavar="FILE", help='by folder: {"FOLDER": {"box": [...], "points": [[x, y, 1]]}}'
    )


def _cleanup_options(group: Any) -> None:
    group.add_argument("--components", type=whole(0), metavar="N", help="keep the N largest parts; 0 keeps all (1)")
    group.add_argument("--least", type=number(0, 1), help="drop parts below this part of the picture (0.0005)")
    group.add_argument("--holes", type=number(0, 1), help="fill holes up to this part of the foreground (0.02)")
    group.add_argument(
        "--radius", type=whole(0), metavar="FRAMES", help="neighbours in time on each side to agree with (2)"
    )
    group.add_argument(
        "--motion", type=number(0, 1), help="how far edges move per frame, as part of the longer side (0.02)"
    )
    group.add_argument(
        "--reach", type=number(0, 1), help="soft edges' width, as part of the longer side; 0: any (0.01)"
    )
    group.add_argument("--floor", type=number(0, 1), help="alpha below this becomes 0 (0.05)")
    group.add_argument(
        "--edge", type=number(0, 0.1), help="width of softened edges, as part of the longer side (0.004)"
    )


def make_cleanup(arguments: argparse.Namespace) -> Cleanup:
    """What is done to the masks; the backend decides what is usual."""
    from data_prep.capture.masks.cleanup import UNTOUCHED, Cleanup

    usual = UNTOUCHED if arguments.backend == "alpha" else Cleanup()
    chosen = {name: getattr(arguments, name) for name in Cleanup.__dataclass_fields__}
    return replace(usual, **{name: value for name, value in chosen.items() if value is not None})


def make_backend(arguments: argparse.Namespace) -> Backend:
    """The backend that was asked for.

    Raises:
        ConfigError: an option that it needs is missing, or a package.
        DataError: a file of it is unusable.
    """
    makers = {"alpha": _alpha, "background": _background, "chroma": _chroma, "onnx": _onnx, "sam2": _sam2}
    return makers[arguments.backend](arguments)


def _alpha(arguments: argparse.Namespace) -> Backend:
    from data_prep.capture.masks.backend import Backend
    from data_prep.capture.masks.segmenters import AlphaSegmenter

    return Backend("alpha", AlphaSegmenter, soft=True)


def _background(arguments: argparse.Namespace) -> Backend:
    from data_prep.capture.masks.backend import Backend
    from data_prep.capture.masks.segmenters import BackgroundSegmenter

    plate, threshold, refine = arguments.plate, arguments.threshold, not arguments.no_grabcut
    plates = [] if plate is None else sorted(p for p in plate.rglob("*") if p.is_file()) if plate.is_dir() else [plate]
    return Backend(
        "background",
        lambda: BackgroundSegmenter(plate, threshold, refine),
        settings={"plate": None if plate is None else plate.name, "threshold": threshold, "grabcut": refine},
        inputs={p.name if p == plate else p.relative_to(plate).as_posix(): p for p in plates},
    )


def _chroma(arguments: argparse.Namespace) -> Backend:
    from data_prep.capture.masks.backend import Backend
    from data_prep.capture.masks.segmenters import ChromaSegmenter

    key, refine = arguments.key, not arguments.no_grabcut
    settings = {"key": key, "grabcut": refine}
    return Backend("chroma", lambda: ChromaSegmenter(key, grabcut=refine), settings=settings)


def _onnx(arguments: argparse.Namespace) -> Backend:
    from data_prep.capture.masks.backend import Backend
    from data_prep.capture.masks.onnx_segmenter import OnnxSegmenter

    if arguments.onnx is None:
        raise ConfigError("--backend onnx: name the network with --onnx FILE.")
    names = ("size", "mean", "scale", "output", "activation")
    options = {name: getattr(arguments, f"onnx_{name}") for name in names}
    path = arguments.onnx
    return Backend(
        "onnx", lambda: OnnxSegmenter(path, **options), True, options, {"network": path}, packages=("onnxruntime",)
    )


def _sam2(arguments: argparse.Namespace) -> Backend:
    from data_prep.capture.masks.backend import Backend
    from data_prep.capture.masks.sam2_segmenter import Sam2Segmenter, load_predictor, make_prompt, read_prompts

    if arguments.sam2_checkpoint is None:
        raise ConfigError("--backend sam2: name the weights with --sam2-checkpoint FILE.")
    prompts = read_prompts(arguments.prompts) if arguments.prompts else {}
    if arguments.box or arguments.point:
        prompts[""] = make_prompt(arguments.box, arguments.point, "--box, --point")
    if not prompts:
        raise ConfigError("--backend sam2: say where the object is, with --box, --point or --prompts.")
    predictor = load_predictor(arguments.sam2_checkpoint, arguments.sam2_config, device=arguments.device)
    return Backend(
        "sam2",
        lambda: Sam2Segmenter(predictor, prompts, device=arguments.device),
        soft=True,
        settings={
            "config": arguments.sam2_config,
            "prompts": {name: {"box": prompt.box, "points": prompt.points} for name, prompt in prompts.items()},
        },
        inputs={"checkpoint": arguments.sam2_checkpoint},
        packages=("sam2", "torch"),
    )


def whole(least: int) -> Any:
    """A parser of whole numbers from ``least`` on."""

    def parse(text: str) -> int:
        value = int(text)
        if value < least:
            raise argparse.ArgumentTypeError(f"must be at least {least}")
        return value

    return parse


def number(least: float, most: float) -> Any:
    """A parser of numbers in a range."""

    def parse(text: str) -> float:
        value = float(text)
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"must be in {least:g} to {most:g}")
        return value

    return parse


def numbers(text: str) -> tuple[float, ...]:
    """Finite numbers between commas."""
    values = tuple(float(part) for part in text.split(","))
    if not all(math.isfinite(value) for value in values):
        raise argparse.ArgumentTypeError("must be finite")
    return values


def colour(text: str) -> tuple[int, int, int]:
    """Red, green and blue from six hexadecimal digits."""
    digits = text.removeprefix("#")
    try:
        red, green, blue = bytes.fromhex(digits)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected six hexadecimal digits such as 00b140, got {text!r}") from None
    return red, green, blue
