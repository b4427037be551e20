"""`gausim pack RUN|DIR`: packs a finished run or a data set for others."""

from __future__ import annotations

import argparse
import zipfile
from pathlib import Path

import gausim
from gausim.cli.arguments import command_parser
from gausim.compose.data_paths import SCENES, outside_files
from gausim.core.errors import DataError, RunError
from gausim.data.objects import find_objects
from gausim.io.files import replacing, sha256
from gausim.runs.directory import RunDirectory
from gausim.runs.names import CONFIG, EPOCHS, FINISHED, LAST_CHECKPOINT, MOTION

CARD = "README.md"
# Files of a run to publish; logs, panels and videos are excluded, as they identify the machine and its user.
_OF_A_RUN = (CONFIG, LAST_CHECKPOINT, FINISHED, EPOCHS, MOTION, CARD)


def main(argv: list[str]) -> int:
    """Runs the command; returns the exit status."""
    arguments = _parser().parse_args(argv)
    source = arguments.source.resolve()
    is_run = (source / CONFIG).is_file()
    files = _of_run(source) if is_run else _of_data(source)
    name = source.parent.name if is_run and source.name.startswith("seed_") else source.name
    out = arguments.out or Path(f"{name}.zip")
    with replacing(out) as temporary, zipfile.ZipFile(temporary, "w", strict_timestamps=False) as pack:
        for path in sorted(files):
            pack.write(files[path], f"{name}/{path}")
        if is_run and CARD not in files:
            pack.writestr(f"{name}/{CARD}", _card(source, name, arguments.licence))
    print(f"wrote {out} ({len(files)} files, {out.stat().st_size / 1e6:,.1f} MB)")
    print(f"others fetch it with: gausim fetch ADDRESS/{out.name} --sha256 {sha256(out)}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("pack")
    add = parser.add_argument
    add("source", metavar="RUN|DIR", type=Path, help="directory of a finished run, or of a data set")
    add("--out", metavar="FILE.zip", type=Path, help="write this archive (default: NAME.zip)")
    add("--licence", metavar="ID", default="not stated", help="state this licence on the run's card, e.g. CC-BY-4.0")
    return parser


def _of_run(source: Path) -> dict[str, Path]:
    """Files of a run by their names in the archive, with scenes and masks from outside the data set."""
    run = RunDirectory(source)
    if not run.is_finished:
        raise RunError(f"{source}: expected a finished run, found none ({FINISHED} is missing). Train it to its end.")
    own = {name: source / name for name in _OF_A_RUN if (source / name).is_file()}
    evaluation = {f"evaluation/{name}": path for name, path in _files_below(source / "evaluation").items()}
    outside = set(outside_files(source, run.config()["data"]))
    scenes = {f"{SCENES}/{path.name}": path for path in outside}
    if len(scenes) < len(outside):
        raise RunError(f"{source}/{CONFIG}: names two scenes of one file name. Rename one and train again.")
    return own | evaluation | scenes


def _of_data(source: Path) -> dict[str, Path]:
    find_objects(source)  # raises where there is no data set
    return _files_below(source)


def _files_below(root: Path) -> dict[str, Path]:
    """Files of a folder by their relative names, without names that begin with a dot."""
    relative = {path.relative_to(root): path for path in root.rglob("*")}
    shown = {name: path for name, path in relative.items() if not any(part.startswith(".") for part in name.parts)}
    for path in shown.values():
        if path.is_symlink() or not (path.is_file() or path.is_dir()):
            raise DataError(f"{path}: expected a file or a folder, found a link or a device. Put a copy there.")
    return {name.as_posix(): path for name, path in shown.items() if path.is_file()}


def _card(source: Path, name: str, licence: str) -> str:
    """Description of a run in Markdown: its model, licence, usage and results."""
    table = source / "evaluation" / "table.md"
    results = table.read_text() if table.is_file() else "Not evaluated.\n"
    return (
        f"# {name}\n\nA run of gausim {gausim.__version__}. Licence of the weights: {licence}.\n`{CONFIG}` holds all "
        f"settings.\n\n    gausim evaluate RUN --data DIR\n    gausim simulate RUN --data DIR\n\n"
        f"## Results\n\n{results}"
    )
