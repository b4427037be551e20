"""`gausim train`: learn an object's dynamics from multi-view videos."""

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from omegaconf import DictConfig

USAGE = """usage: gausim train [KEY=VALUE ...] [-m] [--cfg job] [--info] [--resolve]

Learn an object's dynamics from multi-view videos. Every setting is a key of conf/train.yaml and its groups:

  gausim train                                  the embedded synthetic set, the default model
  gausim train data=DIRECTORY                   an object of your own
  gausim train model=gausim_paper               the paper: network, loss, optimiser and plan
  gausim train ablation=no_momentum             without the momentum loss
  gausim train -m ablation=none,no_mass seed=0,1,2 evaluate=true     a sweep: all combinations
  gausim train -m seed=0,1,2,3 hydra/launcher=joblib                 several jobs at a time (also submitit_slurm)
  gausim train plan.max_minutes=30 render.threads=4
  gausim train trainer=ddp trainer.devices=4 plan.batch_size=8
  gausim train --cfg job                        print the whole configuration, run nothing

A run goes to OUTPUT_ROOT/NAME/seed_SEED (output_root, name, seed; the name is by default that of the data). Started
again, it resumes from its last checkpoint; once finished it is refused, unless overwrite=true. A sweep (-m) that is
started again leaves out what is finished, resumes what is not, and tries again what failed if retry_failed=true."""


def train(cfg: "DictConfig") -> object:
    """One job of Hydra, which loads torch only when it begins; in a sweep returns what became of it.

    In a sweep errors do not stop the other jobs: they are logged and repeated in the summary at the end.

    Raises:
        GausSimError: the run is finished, has another configuration, is damaged or in use, or training diverged.
    """
    from gausim.cli.sweeps.jobs import do_job
    from gausim.cli.training_run import train_run
    from gausim.compose.command import run_dir
    from gausim.compose.root import in_sweep
    from gausim.runs.directory import RunDirectory
    from gausim.training.ranks.launch import claim_first

    claim_first(cfg.trainer)
    for handler in logging.getLogger().handlers:
        if not isinstance(handler, logging.FileHandler):  # times and modules are in the run's train.log
            handler.setFormatter(logging.Formatter("  %(message)s"))
    run = RunDirectory(run_dir())
    if in_sweep():
        return do_job(cfg, run, train_run)
    with run.writing():
        train_run(cfg, run)
    return None


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit status."""
    if any(a in ("-h", "--help") for a in argv):
        print(USAGE)
        return 0
    from gausim.compose.command import run_hydra
    from gausim.runs.files import unwritable

    try:
        return run_hydra(train, argv)
    except OSError as error:  # Hydra makes the run directory before it calls the task
        explained = unwritable(error)
        if explained is None:
            raise
        raise explained from error
