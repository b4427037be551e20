"""Checks that the chosen ablations act on the configuration, by composing it with and without them."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from gausim.compose.config import compose
from gausim.core.errors import ConfigError
from gausim.runs.comparison import flatten

# Overrides that no ablation depends on.
_IRRELEVANT = ("seed", "name", "evaluate", "overwrite", "hydra.mode", "output_root")


def check_ablations(overrides: Sequence[str]) -> None:
    """Raises ConfigError where an ablation changes nothing of the configuration, or sets a key that it lacks."""
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    keys = [override.key_or_group for override in parsed]
    chosen = [override.value() for override in parsed if override.key_or_group == "ablation"]
    names = chosen[-1] if chosen and isinstance(chosen[-1], list) else chosen[-1:]
    others = tuple(w for w, key in zip(overrides, keys, strict=True) if key != "ablation" and key not in _IRRELEVANT)
    for name in (str(name) for name in names if name not in (None, "none")):
        _check(name, others)


@lru_cache(maxsize=64)
def _check(name: str, others: tuple[str, ...]) -> None:
    without, ablated = _plain(others), _plain((*others, f"ablation={name}"))
    unknown = [key for key, _ in flatten(ablated) if not _has(without, key)]
    if unknown:
        raise ConfigError(f"ablation={name}: does not fit this model, which has no key {unknown[0]}.")
    if ablated == without:
        raise ConfigError(f"ablation={name}: changes nothing of this configuration, so it would repeat ablation=none.")


@lru_cache(maxsize=64)
def _plain(overrides: tuple[str, ...]) -> Any:
    return OmegaConf.to_container(compose(overrides), resolve=False)


def _has(config: Any, key: str) -> bool:
    for part in key.split("."):
        if not isinstance(config, Mapping) or part not in config:
            return False
        config = config[part]
    return True
