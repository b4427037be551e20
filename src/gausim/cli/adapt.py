"""`gausim adapt RUN`: fit the initial states of new sequences with the trained simulator of a run frozen."""

import argparse
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from gausim.cli.arguments import add_names, command_parser
from gausim.compose.data_paths import located
from gausim.core.errors import ConfigError, DataError

if TYPE_CHECKING:
    from gausim.data.objects import ObjectData

logger = logging.getLogger(__name__)

EPILOG = """States are fitted to the motion tracked in the videos, then to the images. The result is a run of its
own: `gausim evaluate`, `simulate` and `report` take it. What is learned is the state before frame 0 of each sequence,
nothing else: network, densities, attributes and template stay bit by bit.
Only frames 0 .. FRAMES - 1 of the training views are read.

  gausim adapt outputs/bunny/seed_0 --sequences seq_009 seq_010 seq_011
  gausim adapt outputs/bunny/seed_0 --data NEW_STORE --frames 3
  gausim adapt outputs/bunny/seed_0 --data NEW_STORE --set trainer.threads=1 optimizer.initial_lr=0.02"""
# Epochs from tracked motion, and from rest; shows of each sequence per epoch.
WARM_EPOCHS, EPOCHS, REPEATS = 1, 60, 4
# Targets of `--supervision`, with the same defaults as conf/supervision.
SUPERVISIONS = {
    "images": "gausim.training.supervision.images.training_views",
    "points": "gausim.training.supervision.points.PointSupervision",
    "tracks": "gausim.training.supervision.motion_tracks.TrackSupervision",
}


def main(argv: list[str]) -> int:
    """Runs the command; returns the exit status."""
    arguments = _parser().parse_args(argv)
    from omegaconf import OmegaConf

    from gausim.cli.training_run import train_run
    from gausim.runs.directory import RunDirectory
    from gausim.training.ranks.launch import claim_first

    source = RunDirectory(arguments.run)
    config = _config(source.config(), source.path, arguments)
    # outputs/bunny/seed_0 -> outputs/bunny_adapted_16/seed_0, so that seeds stay in the folder of one experiment.
    path = source.path.resolve()
    beside = path.parent.with_name(f"{path.parent.name}_adapted_{arguments.frames}") / path.name
    run = RunDirectory(arguments.out or beside)
    claim_first(config["trainer"])
    with run.writing():
        train_run(OmegaConf.create(config), run)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("adapt", epilog=EPILOG)
    add = parser.add_argument
    add("run", metavar="RUN", type=Path, help="run directory of `gausim train`")
    add("--data", metavar="STORE", nargs="+", help="take the objects from these directories (default: the run's)")
    add_names(parser, "sequences", "fit these sequences (default: all)")
    add("--frames", type=int, default=16, help="fit so many frames of each sequence (default: 16)")
    add("--epochs", type=int, help=f"go so often over the sequences, {REPEATS} steps each (default: {WARM_EPOCHS} "
        f"from tracked motion, {EPOCHS} of bodies or models of which none can be tracked)")  # fmt: skip
    add("--out", metavar="DIR", type=Path, help="write this run directory (default: NAME_adapted_FRAMES beside RUN's)")
    add("--overwrite", action="store_true", help="replace the run that is there")
    add("--set", metavar="KEY=VALUE", nargs="+", default=[], help="change settings of the run, e.g. "
        "trainer.threads=1 (default: none)")  # fmt: skip
    add("--supervision", choices=tuple(SUPERVISIONS), help="compare predictions with these (default: as in the run)")
    return parser


def _config(config: dict[str, Any], run: Path, arguments: argparse.Namespace) -> dict[str, Any]:
    """The run's configuration with the settings of adaptation, then the overrides."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    if arguments.frames < 2:
        raise ConfigError(f"--frames: expected at least 2 (frame 0 shows rest only), got {arguments.frames}.")
    steps, count = arguments.frames - 1, len(arguments.sequences or ())
    data = config["data"] | {
        "root": _roots(config, run, arguments.data),
        "scene": None,
        "masks": None,
        "selections": None,
        "test": None,
        "part": None,
        "sequences": arguments.sequences,
    }
    warm = config["plan"]["warm_start"] and arguments.supervision != "points"
    plan = config["plan"] | {
        "repeats": REPEATS,
        "batch_size": min(4, count) if count else config["plan"]["batch_size"],
        "t_start": steps,
        "t_max": steps,
        "epochs": arguments.epochs or (WARM_EPOCHS if warm else EPOCHS),
        "max_minutes": None,
        "teach": None,
    }
    adapted = config | {
        "data": data,
        "name": f"{config['name']}_adapted_{arguments.frames}",
        "init_from": str(run.resolve()),
        "freeze": "model",
        "evaluate": True,
        "plan": plan,
        "overwrite": arguments.overwrite,
    }
    if arguments.supervision is not None:
        adapted["supervision"] = {"_target_": SUPERVISIONS[arguments.supervision], "_partial_": True}
    node = OmegaConf.create(adapted)
    OmegaConf.set_struct(node, True)
    try:
        merged = OmegaConf.merge(node, OmegaConf.from_dotlist(_checked(arguments.set)))
    except OmegaConfBaseException as error:
        raise ConfigError(f"--set {' '.join(arguments.set)}: {error}") from error
    return cast("dict[str, Any]", OmegaConf.to_container(merged))


def _checked(overrides: Sequence[str]) -> list[str]:
    for text in overrides:
        if "=" not in text.lstrip("="):
            raise ConfigError(
                f"--set {text}: expected KEY=VALUE, e.g. trainer.threads=1. `gausim adapt --help` explains."
            )
    return list(overrides)


def _roots(config: dict[str, Any], run: Path, stores: Sequence[str] | None) -> list[dict[str, Any]]:
    """Entries of data.root: the stores' objects that are in the run, each with the rest scene of its training."""
    from gausim.compose.config import instantiate
    from gausim.data.objects import ObjectData, find_objects
    from gausim.runs.data_print import changed_files

    data = located(run, config["data"], {})
    if stores is None and (changed := changed_files(run, instantiate(data).objects)):
        logger.warning("%s", changed)
    known: dict[str, ObjectData] = {item.name: item for item in instantiate({**data, "sequences": None}).objects}
    if stores is None:
        return [_entry(item.root, item) for item in known.values()]
    found = [ObjectData(root) for store in stores for root in find_objects(store)]
    strange = [item.name for item in found if item.name not in known]
    if strange:
        raise DataError(f"{' '.join(stores)}: holds {strange}, which the run does not know; it knows {list(known)}.")
    return [_entry(item.root, known[item.name]) for item in found]


def _entry(root: Path, trained: "ObjectData") -> dict[str, Any]:
    paths = {"root": root, "scene": trained.scene_path, "masks": trained.masks_path}
    placed = {key: None if path is None else str(Path(path).resolve()) for key, path in paths.items()}
    test = trained.test if Path(root).resolve() == trained.root.resolve() else None  # it names sequences of that store
    return {**placed, "selections": trained.selections or None, "law": trained.law, "test": test}
