"""Interface to Hydra: composition and running of configurations, and construction of objects from them."""

from __future__ import annotations

import difflib
import os
import re
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import hydra
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, InstantiationException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gausim.compose.places import more_settings, spelled
from gausim.compose.root import HYDRA_VERSION_BASE, conf_dir
from gausim.compose.targets import check_hydra, check_targets
from gausim.core.errors import ConfigError, GausSimError

_UNKNOWN_KEY = r"Could not override '([^']+)'|Key '([^']+)' (?:is )?not in"


def compose(config_name: str, overrides: Sequence[str] = ()) -> DictConfig:
    """Composes a file of conf/ with overrides as on the command line; unknown keys cannot be set on the result.

    Raises:
        ConfigError: a key, group or option is unknown.
    """
    with _readable_errors(config_name):
        return _compose(config_name, overrides)


def compose_leniently(config_name: str, overrides: Sequence[str]) -> tuple[DictConfig, list[str]]:
    """The configuration of the valid overrides, and a sentence for each of the others.

    Raises:
        ConfigError: the file in conf/ is invalid without overrides.
    """
    try:
        return _compose(config_name, overrides), []
    except (ConfigError, HydraException, OmegaConfBaseException):
        pass  # try them one by one, groups first: they decide which keys exist
    taken: list[str] = []
    faults: list[str] = []
    for override in sorted(overrides, key=_turn):
        try:
            _compose(config_name, [*taken, override])
            taken.append(override)
        except ConfigError as error:
            faults.append(str(error))
        except (HydraException, OmegaConfBaseException) as error:
            faults.append(_fault(config_name, taken, override, error))
    return compose(config_name, taken), faults


def _turn(override: str) -> int:
    """Priority in which overrides are tried: search path, then groups, then keys."""
    key = override.lstrip("+~").split("=")[0]
    return 0 if key == "hydra.searchpath" else 1 if (conf_dir() / key).is_dir() else 2


def _fault(config_name: str, taken: Sequence[str], override: str, error: Exception) -> str:
    """Error message of one override, composed together with the valid ones."""
    unknown = re.search(_UNKNOWN_KEY, str(error))
    if unknown is None:
        why = f"{error.__cause__ or error}".partition("Config search path")[0]
        return f"{override}: {' '.join(why.split())}"
    key = override.lstrip("+~").split("=")[0]
    matches = difflib.get_close_matches(key, [*_keys(_compose(config_name, taken)), *more_settings()], n=1, cutoff=0.6)
    return f"{key}: unknown key." + (f" Did you mean '{matches[0]}'?" if matches else "")


def _compose(config_name: str, overrides: Sequence[str]) -> DictConfig:
    known = spelled(overrides)
    with hydra.initialize_config_dir(str(conf_dir()), version_base=HYDRA_VERSION_BASE):
        config = hydra.compose(config_name, overrides=known)
    _check_more(config, known)
    return config


def _check_more(config: DictConfig, overrides: Sequence[str]) -> None:
    """Refuses settings of absent objects, e.g. of a network if the model has none."""
    for key in (override.partition("=")[0] for override in overrides if override.startswith("++")):
        parent = OmegaConf.select(config, key[2:].rpartition(".")[0])
        built = parent is None or (isinstance(parent, DictConfig) and "_target_" in parent)  # None: switched off
        if key[2:] in more_settings() and not built:
            raise ConfigError(f"{key[2:]}: unknown key. This configuration builds nothing that it would be set of.")


@dataclass
class Job:
    """Callable for every job of Hydra; defined here so that unpickling it in a worker registers our resolvers."""

    task: Callable[[DictConfig], float | None]

    def __call__(self, config: DictConfig) -> float | None:
        """Runs the job."""
        return self.task(config)


def run_hydra(config_name: str, task: Callable[[DictConfig], float | None], argv: Sequence[str]) -> int:
    """Runs a task under Hydra: overrides, `-m`, `--cfg job`, `--help` and the rest of Hydra's own options.

    ``task`` is a function of the composed configuration; its value is a sweeper's objective. Returns the exit
    status.

    Raises:
        ConfigError: a key, group or option is unknown, or a value is missing.
    """
    decorate = hydra.main(version_base=HYDRA_VERSION_BASE, config_path=str(conf_dir()), config_name=config_name)
    runner = decorate(Job(task))
    saved_argv, saved_flag = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    # Hydra reads sys.argv; with full errors enabled it raises exceptions, which are reworded, instead of exiting.
    sys.argv = [saved_argv[0], *spelled(argv)]
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        with _readable_errors(config_name), _guarded():
            runner()
    finally:
        sys.argv = saved_argv
        if saved_flag is None:
            del os.environ["HYDRA_FULL_ERROR"]
        else:
            os.environ["HYDRA_FULL_ERROR"] = saved_flag
    return 0


def run_dir() -> Path:
    """Returns the directory of the running job (only inside `run_hydra`; in a sweep that of the job)."""
    return Path(HydraConfig.get().runtime.output_dir)


@contextmanager
def _guarded() -> Iterator[None]:
    """Checks the node `hydra` of a configuration before Hydra builds its logging, callbacks and launcher from it."""
    load = ConfigLoaderImpl.load_configuration

    def checked(self: ConfigLoaderImpl, *args: Any, **kwargs: Any) -> DictConfig:
        config = load(self, *args, **kwargs)
        check_hydra(config.hydra)
        _check_more(config, list(config.hydra.overrides.task))
        return config

    ConfigLoaderImpl.load_configuration = checked  # type: ignore[method-assign]
    try:
        yield
    finally:
        ConfigLoaderImpl.load_configuration = load  # type: ignore[method-assign]


@contextmanager
def _readable_errors(config_name: str) -> Iterator[None]:
    """Converts errors of Hydra and OmegaConf to ConfigError and suggests similar keys."""
    try:
        yield
    except InstantiationException:
        raise  # `instantiate` has already converted errors of the configuration
    except (HydraException, OmegaConfBaseException) as error:
        message = str(error).strip()
        cause = str(error.__cause__).strip() if error.__cause__ else ""
        if cause and cause not in message:
            message = f"{message}\n{cause}"
        if "hydra/launcher/" in message:
            message += "\njoblib, submitit_local and submitit_slurm come with `pip install 'gausim[sweep]'`."
        raise ConfigError(f"{config_name}.yaml: {message}{_close_keys(config_name, message)}") from error


def _close_keys(config_name: str, message: str) -> str:
    found = re.search(_UNKNOWN_KEY, message)
    if found is None:
        return ""
    key = str(found.group(1) or found.group(2)).split("@")[0]
    try:
        known = [*_keys(_compose(config_name, ())), *more_settings()]
    except (HydraException, OmegaConfBaseException):
        return ""  # the configuration is invalid without the override, too; the present message explains it
    matches = difflib.get_close_matches(key, known, n=3, cutoff=0.6)
    return f"\nDid you mean {' or '.join(matches)}?" if matches else f"\n`--cfg job` shows every key of {config_name}."


def _keys(node: DictConfig, prefix: str = "") -> Iterator[str]:
    for key in map(str, node):
        yield f"{prefix}{key}"
        if not OmegaConf.is_missing(node, key) and not OmegaConf.is_interpolation(node, key):
            child = node[key]
            if isinstance(child, DictConfig):
                yield from _keys(child, f"{prefix}{key}.")


def instantiate(node: DictConfig | ListConfig | Mapping[str, Any], **kwargs: Any) -> Any:
    """Builds the objects that a configuration names in `_target_`; the only place in gausim that does so.

    A dict or list gives a dict or list, `_partial_: true` a `functools.partial`. Further arguments in `kwargs` take
    precedence over the node's, and are passed without the copies that Hydra would make.

    Raises:
        ConfigError: a target is not in the allow-list, does not exist, or does not take its arguments.
        GausSimError: the constructor refuses its arguments.
    """
    config = node if isinstance(node, DictConfig | ListConfig) else OmegaConf.create(dict(node))
    target = config.get("_target_") if isinstance(config, DictConfig) else None
    if kwargs and target is None:
        raise ConfigError(f"expected a node with `_target_` for the arguments {sorted(kwargs)}, got {config!r}.")
    check_targets(config)
    where = str(config._get_full_key(None) or "configuration")
    try:
        if not isinstance(config, DictConfig) or target is None:
            return hydra.utils.instantiate(config, _convert_="all")
        wants_partial = bool(config.get("_partial_", False))
        factory = hydra.utils.instantiate(config, _convert_="all", _partial_=True)
        return partial(factory, **kwargs) if wants_partial else factory(**kwargs)
    except InstantiationException as error:
        raise _blame(error, where) from error
    except TypeError as error:
        if not _is_wrong_call(error):
            raise  # raised inside the constructor: a defect, not a wrong configuration
        raise ConfigError(f"{where}: {error}. Compare the keys with {target}.") from error


def _is_wrong_call(error: TypeError) -> bool:
    """Whether the target does not take its arguments, as opposed to a TypeError raised in its body."""
    frames = traceback.extract_tb(error.__traceback__)
    raised_in = Path(frames[-1].filename).resolve() if frames else Path()
    hydra_home = Path(hydra.__file__).resolve().parent
    return "argument" in str(error) and (raised_in == Path(__file__).resolve() or hydra_home in raised_in.parents)


def _blame(error: InstantiationException, where: str) -> Exception:
    """Unwraps an error of Hydra: a GausSimError, a ConfigError for a wrong argument or name, or a defect."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, GausSimError):
            return cause
        last, cause = cause, cause.__cause__
    if isinstance(last, InstantiationException) or (isinstance(last, TypeError) and _is_wrong_call(last)):
        return ConfigError(f"{where}: {str(error).strip()}")
    return error
