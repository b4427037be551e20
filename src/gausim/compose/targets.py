"""Allow-list of the targets of configurations, which may come from others and must not call arbitrary code."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import hydra
import yaml
from omegaconf import DictConfig, ListConfig, OmegaConf

from gausim.core.errors import ConfigError

# Not whole packages: torch alone can run programs (torch.distributed.run), source text (torch.fx) and pickles.
ALLOWED_PACKAGES = (
    "gausim",
    "torch.nn",
    "torch.optim",
    "lightning.pytorch.callbacks",
    "lightning.pytorch.loggers",
    "lightning.pytorch.plugins",
    "lightning.pytorch.profilers",
    "lightning.pytorch.strategies",
    "lightning.fabric.plugins",
    "torchmetrics.aggregation",
    "torchmetrics.image",
    "torchmetrics.regression",
)
ALLOWED_TARGETS = ("builtins.dict", "builtins.list")
# Exceptions inside the allowed packages, which start programs or write files.
REFUSED_MODULES = (
    "gausim.cli",
    "gausim.data.images",
    "gausim.runs.checkpoint",
    "gausim.runs.files",
    "gausim.runs.provenance",
    "gausim.io",
    "gausim.report",
    "lightning.pytorch.strategies.launchers",
)
# Allowed in the node `hydra`: launchers, sweepers and callbacks.
HYDRA_PACKAGES = ("hydra._internal.core_plugins", "hydra_plugins", "gausim")
MOST_SEED = 2**32 - 1


def check_targets(node: DictConfig | ListConfig) -> None:
    """Refuses every `_target_` outside the allow-list, at any depth, before any object is built.

    A name is judged by the module that defines its object: `torch.nn.modules.module.torch.load` does not belong to
    torch.nn. Methods are refused: targets are classes and functions.

    Raises:
        ConfigError: a target is not allowed; names its key.
    """
    for fault in target_faults(OmegaConf.to_container(node, resolve=True), str(node._get_full_key(None) or "")):
        raise ConfigError(fault)


def target_faults(config: Any, root: str = "") -> Iterator[str]:
    """Messages for every `_target_` of plain containers, below key ``root``, that is not allowed or does not exist."""
    for key, target in _targets(config, root):
        try:
            allowed = target in ALLOWED_TARGETS or _is_allowed(target, ALLOWED_PACKAGES, REFUSED_MODULES)
        except ConfigError as error:  # the target does not exist
            yield f"{key}: {error}"
            continue
        if not allowed:
            yield (
                f"{key}._target_: expected a class or function of {', '.join(ALLOWED_PACKAGES)} or one of "
                f"{', '.join(ALLOWED_TARGETS)}, got {target!r}. Only these may be built from a configuration."
            )


def check_hydra(node: DictConfig) -> None:
    """Refuses a node `hydra` that would make Hydra call other code before the configuration is checked.

    Launcher, sweeper and callbacks must belong to Hydra, its plugins or gausim. Logging must be Hydra's own, and
    environment variables may not be set, because they can change which programs are started.

    Raises:
        ConfigError: a value is not allowed; names its key.
    """
    content: Any = OmegaConf.to_container(node, resolve=False)
    for key, target in _targets(content, "hydra"):
        if not _is_allowed(target, HYDRA_PACKAGES, REFUSED_MODULES):
            raise ConfigError(f"{key}._target_: expected something from {', '.join(HYDRA_PACKAGES)}, got {target!r}.")
    if content["job"]["env_set"]:
        raise ConfigError(
            f"hydra.job.env_set: expected nothing, got {content['job']['env_set']}. Set environment variables in the "
            "shell instead."
        )
    if set("/\\$") & set(str(content["job"]["name"])):  # its log would leave the run
        raise ConfigError(f"hydra.job.name: expected a name, got {content['job']['name']!r}.")
    for name in ("hydra_logging", "job_logging"):
        folder = Path(hydra.__file__).parent / "conf" / "hydra" / name
        if content[name] not in [yaml.safe_load(path.read_text()) for path in sorted(folder.glob("*.yaml"))]:
            raise ConfigError(
                f"hydra.{name}: states logging of its own, which could write to any file. Leave it out; hydra/{name} "
                f"may be one of {', '.join(sorted(path.stem for path in folder.glob('*.yaml')))}."
            )


def check_seed(seed: Any) -> None:
    """Refuses a seed that the generators do not take.

    Raises:
        ConfigError: it is no whole number from 0 to 4294967295.
    """
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed <= MOST_SEED:
        raise ConfigError(f"seed: expected a whole number from 0 to {MOST_SEED}, got {seed}.")


def _nodes(value: Any, key: str) -> Iterator[tuple[str, Any]]:
    """A value and all values below it, with their keys."""
    yield key, value
    if isinstance(value, dict):
        for name, child in value.items():
            yield from _nodes(child, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list):
        for index, child in enumerate(value):
            yield from _nodes(child, f"{key}[{index}]")


def _targets(value: Any, key: str) -> Iterator[tuple[str, Any]]:
    nodes = _nodes(value, key)
    return ((where or "configuration", n["_target_"]) for where, n in nodes if isinstance(n, dict) and "_target_" in n)


def _within(name: str, packages: Sequence[str]) -> bool:
    return any(name == package or name.startswith(f"{package}.") for package in packages)


def _is_allowed(target: Any, packages: Sequence[str], refused: Sequence[str]) -> bool:
    if not isinstance(target, str) or not _within(target, packages) or _within(target, refused):
        return False
    try:
        found = hydra.utils.get_object(target)
    except Exception as error:  # importing the target may fail in any way; the user can correct the name
        raise ConfigError(f"_target_ {target!r} cannot be found: {error}. Check its spelling.") from error
    home, name = getattr(found, "__module__", None), getattr(found, "__qualname__", ".")
    return isinstance(home, str) and "." not in name and _within(home, packages) and not _within(home, refused)
