"""What may end a job of a search early."""

from __future__ import annotations

from hydra.core.hydra_config import HydraConfig
from lightning.pytorch import Callback
from omegaconf import DictConfig

from gausim.compose.config import in_sweep
from gausim.core.errors import ConfigError


def judges(cfg: DictConfig) -> list[Callback]:
    """What may end the running job early: the pruner of its search, where there is one.

    Raises:
        ConfigError: it trains on several devices.
    """
    if not HydraConfig.initialized() or not in_sweep():
        return []
    sweeper = HydraConfig.get().sweeper
    if sweeper.get("pruner") is None or sweeper.get("trial") is None:
        return []
    if (devices := cfg.trainer.get("devices", 1)) != 1:
        raise ConfigError(
            f"hydra.sweeper.pruner: expected trainer.devices=1, got {devices}. Train without a pruner "
            "(hydra.sweeper.pruner=null)."
        )
    from gausim.cli.sweeps.optuna import pruning_judge

    return [pruning_judge()]
