"""What all importers of public sets share: their options, the stage, the command line."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from data_prep.common.command import Options, add_options, chosen, headline, names, option, run_command, stage_parser
from data_prep.common.objects import described, train_command
from data_prep.common.progress import Tick, silent
from data_prep.common.stage import Stage, files_in, run_stage
from data_prep.public.scene import PublicObject
from data_prep.public.writer import POINTS, ObjectWriter

PACKAGES = ("numpy", "opencv-python-headless", "scipy")


@dataclass(frozen=True)
class ImportOptions(Options):
    """Options of every importer."""

    name: str | None = option(None, "of the object (the folder's)")
    train_frames: int | None = option(None, "first frames to train on (the set's own split)", least=2, metavar="N")
    heldout: tuple[str, ...] = option((), "cameras never to train on (none)", type=names, metavar="CAM,CAM")
    longest: int | None = option(
        None, "reduce pictures whose longer side is longer (keep them)", least=16, metavar="PIXELS"
    )


def rate_option(usual: str) -> Any:
    """The option that states the frames per second; ``usual`` says what they are otherwise."""
    return option(None, f"frames per second ({usual})", least=1e-3, most=1e4)


T = TypeVar("T", bound=ImportOptions)


@dataclass(frozen=True)
class Importer(Generic[T]):
    """A stage that brings a folder of a public set to our layout; a call makes it, ``main`` is its command line."""

    stage: str  # name
    revision: int  # raised when the same inputs and settings give another result than before
    kind: type[T]  # of its options
    read: Callable[[Path, T], Sequence[PublicObject]]  # the objects in a folder; decodes no picture
    folder: str  # the folder, for the help
    text: str | None  # what the command does, for the help
    # completes an object where that takes long: called only where there is something to make
    finish: Callable[[PublicObject, T, Tick], PublicObject] = lambda found, options, tick: found

    def __call__(
        self, root: Path, out: Path, options: T, *, force: bool = False, tick: Tick = silent
    ) -> dict[str, Any]:
        """Reads ROOT and returns the manifest: one object becomes ``out``, several become folders of it by their names.

        Raises:
            DataError: a file is missing or malformed, parts do not go together, or an object would have faults.
            ConfigError: an option does not suit the folder.
        """
        objects = self.read(root, options)
        inputs = {name: path for found in objects for name, path in found.checked().inputs().items()}

        def make(work: Path) -> Mapping[str, Any]:
            made = {}
            for found in objects:
                place = Path(found.name) if len(objects) > 1 else Path()
                whole = self.finish(found, options, tick)
                writer = ObjectWriter(work / place, whole, longest=options.longest, tick=tick)
                made[found.name] = writer.write(out / place)
            return {"objects": made, "files": files_in(work)}

        # Folders count by the files in them.
        settings = {name: value for name, value in asdict(options).items() if not isinstance(value, Path)}
        return run_stage(Stage(self.stage, self.revision, inputs, settings, PACKAGES), out, make, force=force)

    def main(self, argv: list[str] | None = None) -> int:
        """Command line; returns the exit code."""
        parser = stage_parser(self.stage, self.text or "")
        parser.add_argument("root", type=Path, metavar="ROOT", help=self.folder)
        add_options(parser.add_argument_group("what the set does not say, or may say otherwise"), self.kind)

        def run(given: argparse.Namespace, tick: Tick) -> str:
            manifest = self(given.root, given.out, chosen(self.kind, given), force=given.force, tick=tick)
            made = manifest["results"]["objects"]
            told = [summary(made[name], given.out / name if len(made) > 1 else given.out) for name in made]
            return "\n".join([headline(given.out, manifest), *told])

        return run_command(parser, argv, run)


def summary(results: Mapping[str, Any], out: Path) -> str:
    """A few lines about an object that was imported, for people."""
    facts = results["facts"]
    lines = [f"object      {facts['name']}", *described(facts, results["stills"], results["sequences"])]
    lines += [f"{key:<11} {facts[key]}" for key in ("gravity", "floor", "free", "grip") if key in facts]
    lines += [f"{key:<11} {value}" for key, value in results.get("notes", {}).items()]
    start = f" --points {out / POINTS}" if results["points"] else ""
    lines.append(f"next        gausim reconstruct {out}{start}")
    return "\n".join([*lines, f"then        {train_command(facts['name'], out)}"])
