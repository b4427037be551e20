"""Every file of conf/ablation switches off what it says, in both models, and what is left can be trained."""

import math
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from helpers.simulators import LEVELS, change_head, silence

from gausim.compose.build import build
from gausim.compose.config import compose
from gausim.compose.root import conf_dir
from gausim.core import SimState
from gausim.data.dataset import SampleKey, SequenceSample
from gausim.training.module import GausSimModule

ABLATIONS = sorted(path.stem for path in (conf_dir() / "ablation").glob("*.yaml"))
# The others take a second each; test_configs.py composes and builds all of them.
QUICK = {"none", "no_mass", "no_momentum", "no_hierarchy", "no_network"}
TINY = (
    "model.simulator.network.layers=1", "model.simulator.network.hidden=8", LEVELS, "render=cpu",
    "plan.t_max=3", "plan.batch_size=2", "seed=1", "+loss.explosion=1000",
    "optimizer.decay.network=0",  # what only fades has not learned
)  # fmt: skip


def fresh(toy: Path, ablation: str, model: str, *more: str) -> tuple[GausSimModule, list[SequenceSample]]:
    """An untrained module and a batch for it."""
    torch.manual_seed(0)
    tiny = [x for x in TINY if x != LEVELS or "no_hierarchy" not in ablation]  # what is given by hand wins
    asked = [f"data.root={toy}", *tiny, f"model={model}", f"ablation={ablation}", *more]
    module, datamodule = build(compose(asked))
    return module, [datamodule.index[SampleKey(i, 3)] for i in range(2)]


def train(module: GausSimModule, samples: list[SequenceSample], steps: int) -> list[dict[str, float]]:
    """Makes a few steps of the optimiser; returns what they logged."""
    optimizer, draws = module.configure_optimizers(), torch.Generator().manual_seed(0)
    return [module.optimise(samples, optimizer, draws) for _ in range(steps)]


def random_step(module: GausSimModule):
    """One step from a random state with weights far from their start."""
    simulator = module.model
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name, p in simulator.predictor.network.named_parameters():
            if "decoder" in name:  # it may start at zero, and layers of random weights hand little on
                p.add_(torch.randn(p.shape, generator=generator))
    change_head(simulator, output_scale=1.0, lever=0.3 * (simulator.predictor.head.lever > 0))
    return step_of(module)


def step_of(module: GausSimModule):
    """One step from a random state."""
    batch = module.model.batch([0])
    shift = 0.05 * torch.randn(2, *batch.rest.shape, generator=torch.Generator().manual_seed(0))
    return module.model.step(batch, SimState(batch.rest + shift[0], batch.rest + shift[1]))


@pytest.mark.parametrize(
    ("ablation", "model"),
    [*(pytest.param(a, "gausim", marks=[pytest.mark.slow] * (a not in QUICK)) for a in ABLATIONS),
     ("none", "gausim_paper"), ("no_network", "gausim_paper")],
)  # fmt: skip
def test_every_ablation_can_be_trained(toy: Path, ablation: str, model: str) -> None:
    module, samples = fresh(toy, ablation, model)
    start = {n: p.detach().clone() for n, p in module.named_parameters()}
    (stats,) = train(module, samples, 1)
    assert all(math.isfinite(value) for value in stats.values())
    moved = {n for n, p in module.named_parameters() if not torch.equal(p, start[n])}
    assert any(n.startswith("initial_states.") for n in moved) or (ablation, model) == ("no_network", "gausim_paper")
    assert any(n.startswith("model.predictor.network.") for n in moved) == (ablation != "no_network")


def test_no_mass_leaves_det_F_free_in_the_head_and_in_the_template(toy: Path) -> None:
    def determinants(gradients: Sequence[torch.Tensor]) -> float:
        return max(float((torch.linalg.det(f.detach()) - 1).abs().max()) for f in gradients)

    def of(ablation: str) -> list[float]:
        module, _ = fresh(toy, ablation, "gausim")
        step = random_step(module)
        found = [determinants(step.predicted), determinants([step.deformation_gradients])]
        silence(module.model)  # what is left is the template's
        return [*found, determinants([step_of(module).deformation_gradients])]

    # Free is a hundred times what conservation leaves.
    conserved, found = max(of("none")), of("no_mass")
    assert conserved < 1e-4 and min(found) > max(1e-3, 100 * conserved), (conserved, found)
    # Single kernels are corrected little, and conservation leaves less of it, so here it is a thousand times.
    conserved, free = of("no_hierarchy"), of("[no_mass,no_hierarchy]")
    assert max(conserved) < 1e-4, conserved
    assert all(b > 1000 * max(a, 1e-6) for a, b in zip(conserved, free, strict=True)), (conserved, free)


@pytest.mark.parametrize("model", ["gausim", "gausim_paper"])
def test_no_momentum_computes_no_such_loss(toy: Path, model: str) -> None:
    for ablation, present in (("none", True), ("no_momentum", False)):
        module, samples = fresh(toy, ablation, model)
        stats = train(module, samples, 2)
        step = random_step(module)
        assert step.momentum.requires_grad == present and (float(step.momentum.detach()) > 1e-6) == present
        assert (stats[-1]["loss_momentum"] > 0) == present


def test_no_hierarchy_predicts_every_kernel_from_its_root(toy: Path) -> None:
    module, _ = fresh(toy, "no_hierarchy", "gausim_paper")
    simulator = module.model
    batch, hierarchy = simulator.batch([0]), simulator.hierarchies[0]
    (level,) = batch.levels
    assert level.count == hierarchy.levels[0].count == 36
    assert torch.equal(level.parent, hierarchy.levels[0].root) and bool(hierarchy.levels[0].pinned[level.parent].all())
    assert hierarchy.predictions(simulator.predicted_levels) == 36 - int(batch.pinned.sum())
    assert [g.shape for g in random_step(module).predicted] == [(36, 3, 3)]


def test_a_list_of_ablations_sets_what_its_parts_set() -> None:
    config = compose(["data=pudding_soft", "ablation=[joint,no_mass,no_momentum]"])
    simulator = config.model.simulator
    assert config.data.names is None and not simulator.conserve_mass and not simulator.conserve_momentum
