"""Searches by Optuna: trials are trained by Hydra's launcher; a killed search can be continued."""

from __future__ import annotations

import inspect
import json
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf

from gausim.cli.sweeps.jobs import BUSY, FAILED_BEFORE, OBJECTIVE, PRUNED, JobResult, conclude, launching, result_of
from gausim.compose.config import check_targets, instantiate
from gausim.compose.places import spelled
from gausim.core.errors import ConfigError
from gausim.io.files import write_durably
from gausim.runs.comparison import is_free
from gausim.runs.directory import RunDirectory
from gausim.runs.files import sole_writer
from gausim.training.callbacks.time_budget import EpochJudge

try:
    import optuna
    from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
    from optuna.trial import FrozenTrial, Trial, TrialState
except ImportError as error:
    raise ConfigError("hydra/sweeper=optuna: needs Optuna, which comes with `pip install 'gausim[sweep]'`.") from error

RESULTS, LOCK = "optimization_results.yaml", ".search.lock"
RETRY_OF = "retry_of"


@dataclass(frozen=True)
class SearchSettings:
    """The node `hydra.sweeper` of a search; its keys are documented in conf/hydra/sweeper/optuna.yaml."""

    n_trials: int
    n_jobs: int
    direction: Literal["minimize", "maximize"]
    params: Mapping[str, str] | None
    study_name: str
    storage: str
    seed: int
    sampler: DictConfig
    pruner: DictConfig | None
    trial: int | None

    def __post_init__(self) -> None:
        if self.n_trials < 1 or self.n_jobs < 1 or self.direction not in ("minimize", "maximize"):
            raise ConfigError(
                "hydra.sweeper: expected n_trials >= 1, n_jobs >= 1 and direction minimize or maximize, got "
                f"{self.n_trials}, {self.n_jobs} and {self.direction!r}."
            )


class Search:
    """One study: selection and training of its trials."""

    def __init__(self, config: DictConfig, context: HydraContext, launcher: Launcher, settings: SearchSettings) -> None:
        """Stores the arguments that Hydra passes to a sweeper."""
        self._config, self._context, self._launcher, self._settings = config, context, launcher, settings
        self._folder = Path(str(config.hydra.sweep.dir))
        self._results: list[JobResult] = []

    def run(self, arguments: Sequence[str]) -> None:
        """Trains trials, by the command line's overrides, until ``n_trials`` are complete; writes the best.

        Raises:
            ConfigError: no parameter is searched, or the stored study has other parameters.
            BusyError: another process is running the study.
            RunError: a trial failed.
        """
        overrides = self._overrides(arguments)
        space = {key: distribution(o) for key, o in overrides.items() if o.is_sweep_override()}
        fixed = [f"{key}={o.get_value_element_as_str()}" for key, o in overrides.items() if key not in space]
        if not space:
            raise ConfigError(
                "hydra/sweeper=optuna: nothing to search. Name keys as in 'optimizer.network_lr=interval(1e-4,1e-2)', "
                "in hydra.sweeper.params, or choose a file of sweep/."
            )
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self._folder.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(self._config, self._folder / "multirun.yaml")
        with sole_writer(self._folder / LOCK):
            study = self._open(space, fixed)
            failed = _failed(study)
            if self._config.sweep.retry_failed:
                for one in failed:
                    study.enqueue_trial(one.params, user_attrs={RETRY_OF: one.number})
            else:
                self._results += [_failed_before(one) for one in failed]
            while batch := self._next(study, space):
                if not self._do(study, batch, fixed):
                    break
            self._report(study)
        conclude(self._folder, self._results)

    def _overrides(self, arguments: Sequence[str]) -> dict[str, Override]:
        """The parsed overrides by their keys: the command line takes precedence over the configuration."""
        parser = OverridesParser.create(config_loader=self._context.config_loader)
        own = spelled([f"{key}={value}" for key, value in (self._settings.params or {}).items()])
        return {override.get_key_element(): override for override in parser.parse_overrides([*own, *arguments])}

    def _open(self, space: Mapping[str, BaseDistribution], fixed: Sequence[str]) -> optuna.Study:
        """The study, new or continued; a study with other parameters under the same name is refused."""
        wanted = self._settings
        study = optuna.create_study(
            storage=wanted.storage, study_name=wanted.study_name, direction=wanted.direction, load_if_exists=True
        )
        asked = {name: json.loads(optuna.distributions.distribution_to_json(one)) for name, one in space.items()}
        asked |= {
            "direction": wanted.direction,
            "fixed": sorted(o for o in fixed if not is_free(o.lstrip("+~").split("=")[0])),
        }
        known = study.user_attrs.get("asked")
        if known is None:
            study.set_user_attr("asked", asked)
        elif known != asked:
            changed = sorted(k for k in {*known, *asked} if known.get(k) != asked.get(k))
            raise ConfigError(
                f"{wanted.storage}: the study {wanted.study_name!r} there is another search; changed: "
                f"{', '.join(changed)}. Restore these, or give hydra.sweeper.study_name or name another value."
            )
        return study

    def _next(self, study: optuna.Study, space: Mapping[str, BaseDistribution]) -> list[Trial]:
        """The next trials: those that were under way when the search was killed, then new ones.

        New trials come in full batches of n_jobs, also after a kill, so that they are chosen from the same results.
        """
        known = study.get_trials(deepcopy=False)
        batch = [self._ready(study, space, t) for t in known if t.state == TrialState.RUNNING]
        waiting = sum(t.state == TrialState.WAITING for t in known)
        count = sum(RETRY_OF not in t.user_attrs for t in known)
        total, size = self._settings.n_trials, self._settings.n_jobs
        while len(batch) < size and (waiting or (count < total and (not batch or count % size))):
            count, waiting = (count, waiting - 1) if waiting else (count + 1, 0)
            batch.append(self._ready(study, space))
        return batch

    def _ready(
        self, study: optuna.Study, space: Mapping[str, BaseDistribution], known: FrozenTrial | None = None
    ) -> Trial:
        """A trial with a value for every parameter: a new one, or a known unfinished one.

        The sampler is seeded anew for every trial by the seed and the number of the trial, so that a continued search
        tries the same values as an uninterrupted one.
        """
        number = len(study.get_trials(deepcopy=False)) if known is None else known.number
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            study.sampler = self._sampler(self._settings.seed + number)
            trial = study.ask() if known is None else Trial(study, known._trial_id)
            for name, one in space.items():
                trial._suggest(name, one)  # which returns an existing value unchanged
        return trial

    def _sampler(self, seed: int) -> optuna.samplers.BaseSampler:
        node = self._settings.sampler
        check_targets(node)
        takes_seed = "seed" in inspect.signature(get_object(node._target_)).parameters
        return instantiate(node, **({"seed": seed} if takes_seed and "seed" not in node else {}))

    def _do(self, study: optuna.Study, batch: Sequence[Trial], fixed: Sequence[str]) -> bool:
        """Trains trials and reports their results to the study; False if none could be run."""
        jobs: dict[tuple[str, ...], list[Trial]] = {}
        for trial in batch:  # trials with equal values are one job
            jobs.setdefault(tuple(f"{k}={_text(v)}" for k, v in trial.params.items()), []).append(trial)
        orders = [[*fixed, *values, f"hydra.sweeper.trial={same[0].number}"] for values, same in jobs.items()]
        for order in orders:  # check all first: a misspelt value must not fail after hours
            self._context.config_loader.load_sweep_config(self._config, order)
        with launching(self._folder):
            results = [result_of(one) for one in self._launcher.launch(orders, initial_job_idx=len(self._results))]
        self._results += results
        for (values, same), result in zip(jobs.items(), results, strict=True):
            for trial in same:
                _tell(study, trial, result)
                print(f"trial {trial.number}: {result.state}, {float(result):.4g}  {' '.join(values)}", flush=True)
        self._write(study)
        return any(result.state != BUSY for result in results)

    def _write(self, study: optuna.Study) -> FrozenTrial | None:
        """Writes the results so far; returns the best trial."""
        trials = study.get_trials(deepcopy=False)
        done = [t for t in trials if t.state == TrialState.COMPLETE]
        choose = min if self._settings.direction == "minimize" else max
        best = choose(done, key=lambda trial: trial.values[0], default=None)
        known, study_name = _row(best) if best else {}, self._settings.study_name
        facts: dict[str, Any] = {"name": "optuna", "study": study_name, "objective": OBJECTIVE}
        facts |= {"direction": self._settings.direction, "best_trial": known.get("number")}
        facts |= {f"best_{key}": known.get(key) for key in ("value", "params", "directory")}
        facts |= {"trials": [_row(t) for t in trials]}
        write_durably(self._folder / RESULTS, yaml.safe_dump(facts, sort_keys=False).encode())
        return best

    def _report(self, study: optuna.Study) -> None:
        best = self._write(study)
        states = [t.state for t in study.get_trials(deepcopy=False)]
        counts = [f"{states.count(s)} {s.name.lower()}" for s in TrialState if s in states]
        print(f"\nstudy {self._settings.study_name}: {', '.join(counts)}")
        if best:
            print(f"best: trial {best.number}, {OBJECTIVE} {best.value:.6g}, {best.user_attrs.get('directory')}")
            print("  " + " ".join(f"{k}={_text(v)}" for k, v in best.params.items()))
        print(f"wrote {self._folder / RESULTS}", flush=True)


def distribution(override: Override) -> BaseDistribution:
    """Optuna's distribution of an override: a choice, `range` or `interval` of Hydra, `tag(log, …)` for logarithmic.

    A range excludes its stop, as always in Hydra; `int(interval(…))` is an interval of integers.
    """
    value: Any = override.value()
    log_scale = "log" in getattr(value, "tags", ())
    if override.is_interval_sweep():
        kind = IntDistribution if isinstance(value.start, int) and isinstance(value.end, int) else FloatDistribution
        return kind(value.start, value.end, log=log_scale)
    texts = list(override.sweep_string_iterator())
    if not texts:
        raise ConfigError(f"{override.input_line}: expected at least one value, got none.")
    if override.is_range_sweep() and not log_scale:
        numbers = list(value.range())
        kind = IntDistribution if all(isinstance(n, int) for n in numbers) else FloatDistribution
        return kind(min(numbers), max(numbers), step=abs(value.step))
    return CategoricalDistribution(texts)


def _text(value: Any) -> str:
    """A parameter as the value of an override; floats with all digits."""
    return repr(value) if isinstance(value, float) else str(value)


def _tell(study: optuna.Study, trial: Trial, result: JobResult) -> None:
    if result.state == BUSY:
        return  # the trial stays unfinished; a later start reads its result
    trial.set_user_attr("directory", result.directory)
    if result.state == PRUNED:
        study.tell(trial.number, state=TrialState.PRUNED)
    elif math.isfinite(result):
        study.tell(trial.number, float(result))
    else:
        study.tell(trial.number, state=TrialState.FAIL)


def _failed(study: optuna.Study) -> list[FrozenTrial]:
    """Trials that failed and were not repeated."""
    trials = study.get_trials(deepcopy=False)
    again = {t.user_attrs.get(RETRY_OF) for t in trials}
    return [t for t in trials if t.state == TrialState.FAIL and t.number not in again]


def _failed_before(trial: FrozenTrial) -> JobResult:
    run = RunDirectory(trial.user_attrs.get("directory", "?"))
    return JobResult.of(None, FAILED_BEFORE, run, run.failure() if run.has_failed else f"trial {trial.number}")


def _row(trial: FrozenTrial) -> dict[str, Any]:
    facts = {"number": trial.number, "state": trial.state.name.lower(), "value": trial.value}
    return {**facts, "params": dict(trial.params), "directory": trial.user_attrs.get("directory")}


def pruning_judge() -> EpochJudge:
    """Callback that ends the running job, a trial of a search, when its pruner decides so."""
    sweeper = HydraConfig.get().sweeper
    unused, pruner = optuna.samplers.RandomSampler(seed=0), instantiate(sweeper.pruner)
    study = optuna.load_study(storage=sweeper.storage, study_name=sweeper.study_name, sampler=unused, pruner=pruner)
    (known,) = (t for t in study.get_trials(deepcopy=False) if t.number == sweeper.trial)
    trial = Trial(study, known._trial_id)

    def judge(epoch: int, value: float) -> bool:
        trial.report(value, epoch)  # for a repeated epoch, Optuna keeps the earlier value
        return trial.should_prune()

    return EpochJudge(judge=judge, metric=OBJECTIVE)
