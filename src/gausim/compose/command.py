"""The command line of `gausim train`: a job or a sweep under Hydra, after checks that need no data."""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from hydra import version
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path, get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from gausim.compose.ablations import check_ablations
from gausim.compose.config import compose
from gausim.compose.errors import one_sentence, suggestion
from gausim.compose.root import HYDRA_VERSION_BASE, ROOT_FILE, conf_dir, options
from gausim.compose.targets import check_hydra
from gausim.core.errors import ConfigError, GausSimError
from gausim.io.files import bounded_yaml

# Values with quotes, lists, mappings and interpolations were meant as Hydra's grammar: its own message helps there.
_QUOTES = re.compile(r"^[\[{'\"]|[$]\{|['\"]$")


@dataclass
class Job:
    """Callable for every job of Hydra; defined here so that unpickling it in a worker registers our resolvers."""

    task: Callable[[DictConfig], object]
    error: GausSimError | None = None  # kept from Hydra, which would print all overrides before it

    def __call__(self, config: DictConfig) -> object:
        """Runs the job."""
        try:
            return self.task(config)
        except GausSimError as error:
            self.error = error
            return None


def run_hydra(task: Callable[[DictConfig], object], argv: Sequence[str]) -> int:
    """Runs a task under Hydra: overrides, `-m`, `--cfg job` (with `-m` of every job), and Hydra's other options.

    ``task`` is a function of the composed configuration. Returns the exit status.

    Raises:
        ConfigError: a key, group or option is unknown, a value is missing, or an ablation does not act.
    """
    given = get_args_parser().parse_args(list(argv))
    sweep, folders = given.multirun, [Path(given.config_dir).resolve()] if given.config_dir else []
    for folder in folders:
        _check_files(folder)
    with one_sentence(given.overrides):
        words = quoted(with_data_directories(given.overrides, sweep=sweep, folders=folders))
        words += [f"hydra.searchpath=['file://{folder}']" for folder in folders]
        if given.cfg and sweep:
            for number, own in enumerate(jobs_of(words)):
                print(f"---\n# job {number}: {' '.join(own)}\n{OmegaConf.to_yaml(compose(own))}", end="")
            return 0
        runs, saved = not (given.shell_completion or given.info or given.cfg), given.config_name
        if runs and not saved:
            _check(words, sweep=sweep)
        version.setbase(HYDRA_VERSION_BASE)
        path = create_config_search_path(str(folders[0] if saved and folders else conf_dir()))
        hydra, name = Hydra.create_main_hydra2(task_name=ROOT_FILE, config_search_path=path), saved or ROOT_FILE
        try:
            if given.shell_completion:
                hydra.shell_completion(name, words)
            elif given.info:
                hydra.show_info(given.info, name, words)
            elif given.cfg:
                hydra.show_cfg(name, words, given.cfg, given.package, given.resolve)
            else:
                _run(hydra, name, Job(task), words, sweep=sweep)
        finally:
            GlobalHydra.instance().clear()
    return 0


def _check_files(folder: Path) -> None:
    """Refuses a folder of configurations with a file that would take all memory when its aliases are written out."""
    for path in (path for depth in ("", "*/", "*/*/") for path in folder.glob(f"{depth}*.yaml")):
        try:
            bounded_yaml(path)
        except ValueError as error:
            raise ConfigError(str(error)) from error


def _run(hydra: Hydra, name: str, job: Job, words: list[str], *, sweep: bool) -> None:
    if name != ROOT_FILE:  # the configuration that a run has saved
        check_hydra(hydra.compose_config(name, words, run_mode=RunMode.RUN, with_log_configuration=False).hydra)
    try:
        if sweep:
            hydra.multirun(name, job, [*words, "hydra.mode=MULTIRUN"])
        else:
            hydra.run(name, job, [*words, "hydra.mode=RUN"])
    except OSError as error:
        if error.filename is None:  # a full disk does not say of which file
            given = (word.partition("=")[2] for word in words if word.startswith("output_root="))
            error.filename = next(given, "outputs")
        if not sweep:
            composed = hydra.compose_config(name, words, run_mode=RunMode.RUN, with_log_configuration=False)
            _remove_traces(Path(composed.hydra.run.dir))
        raise
    if job.error is not None:
        raise job.error


def _remove_traces(folder: Path) -> None:
    """Removes the empty files that Hydra made in a run directory before a full disk stopped it."""
    for path in (folder / "train.log", *folder.glob(".hydra/*")):
        if path.is_file() and not path.stat().st_size:
            path.unlink()
    for path in (folder / ".hydra", folder, folder.parent):
        with suppress(OSError):  # it holds more, or is not there
            path.rmdir()


def run_dir() -> Path:
    """Returns the directory of the running job (only inside `run_hydra`; in a sweep that of the job)."""
    return Path(HydraConfig.get().runtime.output_dir)


def _check(words: Sequence[str], *, sweep: bool) -> None:
    """Checks every job before Hydra builds its logging, callbacks and launcher, and makes a directory."""
    first = _without_lists(words)
    config = compose(first, with_hydra=True)
    check_hydra(config.hydra)
    if not sweep and config.hydra.sweeper.get("params"):
        raise ConfigError(f"experiment={config.hydra.runtime.choices.experiment}: is several trainings, so add -m.")
    jobs = list(jobs_of(words)) if sweep else [list(words)]
    if not jobs:
        raise ConfigError(f"{' '.join(words)}: expected at least one value of every key, so there is nothing to run.")
    for job in jobs:
        if job != first:
            check_hydra(compose(job, with_hydra=True).hydra)
        check_ablations(job)


def with_data_directories(words: Sequence[str], *, sweep: bool = False, folders: Sequence[Path] = ()) -> list[str]:
    """The overrides with directories in `data=` as `data=object` and absolute `data.root=`.

    A ``sweep`` over several data sets without a name is called "sweep".

    Raises:
        ConfigError: a value is neither a name of conf/data nor a directory.
    """
    known, found = options("data", *folders), []
    named = any(word.startswith(("name=", "experiment=")) for word in words)
    for word in words:
        key, _, value = word.partition("=")
        whole = key == "data" and value not in known and Path(value).expanduser().is_dir()
        values = [value] if whole else value.split(",")
        if key != "data" or (not whole and (value in ("null", "???") or any(mark in value for mark in "[('$"))):
            found.append(word)
            continue
        paths = [Path(text).expanduser() for text in values if text not in known]
        absent = [str(path) for path in paths if not path.is_dir()]
        if absent:
            raise ConfigError(
                f"data={absent[0]}: neither a directory nor a name of conf/data.{suggestion(absent[0], known)}"
            )
        if any("${" in str(path.resolve()) for path in paths):
            raise ConfigError(f"{word}: '${{' in a path begins an interpolation of Hydra. Rename the folder.")
        if paths and len(paths) < len(values):
            raise ConfigError(f"{word}: expected names of conf/data or directories, not both.")
        roots = ",".join("'" + str(path.resolve()).replace("'", "\\'") + "'" for path in paths)
        found += ["data=object", f"data.root={roots}"] if paths else [word]
        found += ["name=sweep"] if sweep and len(values) > 1 and not named else []
    return found


def quoted(words: Sequence[str]) -> list[str]:
    """The overrides KEY=VALUE with values in quotes that Hydra's grammar lacks, or that are paths it would take apart.

    So paths may have letters outside ASCII, spaces, brackets, commas, `#` and `=`, and begin with `~/`.
    """
    found, parser = [], OverridesParser.create()
    for word in words:
        key, sign, value = word.partition("=")
        path = Path(value).expanduser() if value.startswith("~/") else Path(value)
        try:
            parsed = parser.parse_override(word)
            other = parsed.is_sweep_override() or parsed.value() != value or value.startswith("~/")
            replaced = bool(sign) and value[:1] not in ("'", '"', "") and other and _exists(path)
        except HydraException:
            replaced = bool(sign) and bool(re.fullmatch(r"[+~]{0,2}[\w./@-]+", key)) and not _QUOTES.search(value)
        found.append(key + "='" + _escaped(str(path) if value.startswith("~/") else value) + "'" if replaced else word)
    return found


def _escaped(text: str) -> str:
    """A text for single quotes of Hydra's grammar, in which only backslashes before a quote count."""
    text = re.sub(r"(\\*)'", lambda found: found[1] * 2 + "\\'", text)
    return re.sub(r"(\\+)$", lambda found: found[1] * 2, text)


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # too long, or with a null character
        return False


def jobs_of(words: Sequence[str]) -> Iterator[list[str]]:
    """The overrides of every job of a sweep, as the grid sweeper makes them."""
    params = compose(_without_lists(words), with_hydra=True).hydra.sweeper.get("params") or {}
    search = ConfigLoaderImpl(create_config_search_path(str(conf_dir())))  # glob(...) asks it for the choices
    parser = OverridesParser.create(config_loader=search)
    parsed = parser.parse_overrides([*(f"{key}={value}" for key, value in params.items()), *words])
    for batch in BasicSweeper.split_arguments(parsed, None):
        yield from batch


def _without_lists(words: Sequence[str]) -> list[str]:
    """The overrides without those that are swept over."""
    parsed = OverridesParser.create().parse_overrides(list(words))
    return [word for word, override in zip(words, parsed, strict=True) if not override.is_sweep_override()]
