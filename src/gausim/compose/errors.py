"""Errors of Hydra and OmegaConf as one sentence each, with the nearest known key or choice."""

import difflib
import re
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager

import hydra
from hydra.errors import HydraException, InstantiationException, MissingConfigException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from gausim.compose.root import HYDRA_VERSION_BASE, ROOT_FILE, conf_dir, options
from gausim.core.errors import ConfigError

# Most choices that a message lists.
_MOST_CHOICES = 12


@contextmanager
def one_sentence(overrides: Sequence[str]) -> Iterator[None]:
    """Context that converts errors of Hydra and OmegaConf, caused by these overrides, to ConfigError."""
    try:
        yield
    except InstantiationException:
        raise  # `instantiate` has already converted errors of the configuration
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(_sentence(error, overrides)) from error


def suggestion(word: str, known: Collection[str]) -> str:
    """A sentence with the nearest known word, else with all of a few; empty where there are many."""
    matches = difflib.get_close_matches(word, sorted(known), n=1, cutoff=0.6)
    if matches:
        return f" Did you mean '{matches[0]}'?"
    return f" Known: {', '.join(sorted(known))}." if 0 < len(known) <= _MOST_CHOICES else ""


def _sentence(error: Exception, overrides: Sequence[str]) -> str:
    missing = error if isinstance(error, MissingConfigException) else error.__cause__
    if isinstance(missing, MissingConfigException) and missing.missing_cfg_file:
        return _unknown_choice(missing)
    text = " ".join(f"{error} {error.__cause__ or ''}".split())
    found = re.search(r"Could not override '([^']+)'|Key '([^']+)' (?:is )?not in", text)
    if found is not None:
        whole = re.search(r"full_key: (\S+)", text)
        key = str(whole[1] if whole else found[1] or found[2]).split("@")[0]
        return f"{key}: unknown key.{suggestion(key, _known_keys(overrides)) or ' `--cfg job` prints every key.'}"
    if isinstance(error.__cause__, OmegaConfBaseException):
        key = getattr(error.__cause__, "full_key", None) or "configuration"
        text = f"{key}: {str(error.__cause__).splitlines()[0]}"
    return re.split(r" To append to your| See https:", text)[0].rstrip(". ") + "."


def _unknown_choice(error: MissingConfigException) -> str:
    missing = str(error.missing_cfg_file)
    plain = [part for part in missing.split("/") if part]
    group, name = (plain[0], "/".join(plain[1:])) if plain[0] != "hydra" else ("/".join(plain[:-1]), plain[-1])
    known = options(group) or list(error.options or ())
    extra = " joblib, submitit_local and submitit_slurm come with `pip install 'gausim[sweep]'`."
    return f"{group}={name}: unknown choice.{suggestion(name, known)}{extra if group == 'hydra/launcher' else ''}"


def _known_keys(overrides: Sequence[str]) -> list[str]:
    """Keys of the configuration with the groups that the overrides choose, and the groups."""
    groups = [path.name for path in conf_dir().iterdir() if path.is_dir()]
    chosen = [text for text in overrides if text.partition("=")[0] in groups]
    try:
        with hydra.initialize_config_dir(str(conf_dir()), version_base=HYDRA_VERSION_BASE):
            return [*groups, *_keys(hydra.compose(ROOT_FILE, overrides=chosen))]
    except (HydraException, OmegaConfBaseException):  # another override is wrong, too
        return groups


def _keys(node: DictConfig, prefix: str = "") -> Iterator[str]:
    for key in map(str, node):
        yield f"{prefix}{key}"
        if isinstance(child := node._get_node(key), DictConfig) and not child._is_none() and not child._is_missing():
            yield from _keys(child, f"{prefix}{key}.")
