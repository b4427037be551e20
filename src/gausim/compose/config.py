"""Composition of configurations of conf/, and construction of objects from them."""

import traceback
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import hydra
from hydra.errors import InstantiationException
from omegaconf import DictConfig, ListConfig, OmegaConf

from gausim.compose.errors import one_sentence
from gausim.compose.root import HYDRA_VERSION_BASE, ROOT_FILE, conf_dir
from gausim.compose.targets import check_targets
from gausim.core.errors import ConfigError, GausSimError


def compose(overrides: Sequence[str] = (), *, with_hydra: bool = False) -> DictConfig:
    """Composes conf/train.yaml with overrides as on the command line; unknown keys cannot be set on the result.

    ``with_hydra`` keeps the node `hydra`.

    Raises:
        ConfigError: a key, group or option is unknown.
    """
    with one_sentence(overrides), hydra.initialize_config_dir(str(conf_dir()), version_base=HYDRA_VERSION_BASE):
        return hydra.compose(ROOT_FILE, overrides=list(overrides), return_hydra_config=with_hydra)


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
