import math
import re
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from helpers import sway
from lightning.pytorch.callbacks import LambdaCallback
from torch import Tensor, nn

from benchmarks.reference_renderer import ReferenceRenderer
from gausim.core import ConfigError, DivergenceError, SimState
from gausim.data.dataset import SequenceSample
from gausim.data.images import composite
from gausim.losses import ImageLoss, Objective
from gausim.models.initial_state import ModalInitialStates
from gausim.render.draw import draw
from gausim.training.module import GausSimModule
from gausim.training.optimizers import OptimizerSettings
from gausim.training.trainer import TrainerSettings, make_trainer

SCENE_OF_SEQUENCE = sway.SCENE_OF_SEQUENCE
sample, sway_module, real_module, ELASTIC = sway.sample, sway.sway_module, sway.real_module, sway.ELASTIC


def fit(
    module: GausSimModule,
    batches: list[list[SequenceSample]],
    tmp_path: Path,
    epochs: int = 1,
    after: Callable[[], None] = lambda: None,
) -> None:
    """Trains; ``after`` is called after every step."""
    settings = TrainerSettings(accelerator="cpu", progress=False, log_every_n_steps=1)
    seen = LambdaCallback(on_train_batch_end=lambda *_: after())
    loader = torch.utils.data.DataLoader(batches, batch_size=None, collate_fn=lambda x: x)  # type: ignore[arg-type]
    make_trainer(settings, epochs=epochs, run_dir=tmp_path, callbacks=[seen]).fit(module, loader)


def snapshot(module: GausSimModule) -> dict[str, Tensor]:
    return {name: p.detach().clone() for name, p in module.named_parameters()}


def loss_gradients(module: GausSimModule, samples: list[SequenceSample], tmp_path: Path) -> dict[str, Tensor]:
    """Gradients of the first optimiser step."""
    kept: dict[str, Tensor] = {}

    def keep(*_: object) -> dict[str, Tensor]:
        kept.update({n: p.grad.clone() for n, p in module.named_parameters() if p.grad is not None})
        return {"network": torch.zeros(())}

    object.__setattr__(module.settings, "clip", keep)
    fit(module, [samples], tmp_path)
    return kept


@pytest.mark.parametrize("backprop_steps", [1, 2, 0])
def test_windows_stop_gradients_and_nothing_else(backprop_steps: int, tmp_path: Path) -> None:
    objective = Objective(backprop_steps=backprop_steps, static_weight=0.0, momentum_weight=0.0)
    ours = loss_gradients(sway_module(objective), [sample(0), sample(2)], tmp_path)
    module = sway_module(objective)
    samples = [sample(0), sample(2)]
    batch = module.model.batch([0, 1])
    state, total = module.method.initial(samples, batch), torch.zeros(())
    for t in range(3):
        if t and backprop_steps and t % backprop_steps == 0:
            state = state.detach()
        step = module.model.step(batch, state)
        state = SimState(step.positions, state.positions)
        for i, s in enumerate(samples):
            member = batch.members[i]
            scene, moved = module.simulator.scenes[s.scene_id], step.positions[member.kernels][None]
            same = torch.eye(3)[None, None]
            images = draw(ReferenceRenderer(), scene, moved, same, same, member.unit_of_kernel, s.cameras)
            total = total + ImageLoss()(images.rgb, composite(s.frames[t + 1 : t + 2])[0]).sum() / 6
    total.backward()
    assert set(ours) == {n for n, p in module.named_parameters() if p.grad is not None}
    for name, parameter in module.named_parameters():
        if parameter.grad is not None:
            torch.testing.assert_close(ours[name], parameter.grad, rtol=1e-3, atol=1e-3 * float(ours[name].abs().max()))


@pytest.mark.parametrize("broken", ["positions", "gradient"])
def test_what_breaks_is_named_and_nothing_moves(broken: str, tmp_path: Path) -> None:
    module, said = sway_module(), r"predicted step 1 of 3, sequence toy/seq_0: positions"
    if broken == "gradient":
        module.model.keep.register_hook(lambda grad: grad * math.nan)
        said = r"gradient of group 'network'"
    else:
        module.model.poison = math.inf
    before = snapshot(module)
    with pytest.raises(DivergenceError, match=said):
        fit(module, [[sample(0)]], tmp_path)
    assert all(torch.equal(before[n], p) for n, p in module.named_parameters())


def test_an_explosion_is_counted_and_twenty_are_a_divergence(tmp_path: Path) -> None:
    module = sway_module(Objective(explosion=0.01, static_weight=0.0))
    with torch.no_grad():
        module.model.drift[0] += 0.02
    fit(module, [[sample(0, steps=6)]], tmp_path)
    assert module.summary["exploded"] == 1.0
    module = sway_module(Objective(explosion=1e-3, static_weight=0.0))
    with torch.no_grad():
        module.model.drift[0] += 1.0
    with pytest.raises(DivergenceError, match="20 batches in a row"):
        fit(module, [[sample(0)]] * 25, tmp_path)


def test_clipping_by_group_and_altogether() -> None:
    for per_group, expected in ((True, (1.0, 1.0)), (False, (0.6, 0.8))):
        a, b = nn.Parameter(torch.zeros(2)), nn.Parameter(torch.zeros(2))
        settings = OptimizerSettings(clip_per_group=per_group)
        optimizer = settings.build({"network": [a], "scene": [b]})
        a.grad, b.grad = torch.tensor([30.0, 0.0]), torch.tensor([0.0, 40.0])
        norms = settings.clip(optimizer)
        assert {k: float(v) for k, v in norms.items()} == {"network": 30.0, "scene": 40.0}
        assert (float(a.grad.norm()), float(b.grad.norm())) == pytest.approx(expected, rel=1e-4)


def test_absent_sequences_and_scenes_do_not_move(tmp_path: Path) -> None:
    module = real_module(SCENE_OF_SEQUENCE, states=ModalInitialStates, template=ELASTIC)
    seen: list[dict[str, Tensor]] = []
    batches = [[sample(0), sample(1), sample(2)]] * 2 + [[sample(0)]] * 3
    fit(module, batches, tmp_path, after=lambda: seen.append(snapshot(module)))
    own = re.compile(r"initial_states\.velocity\.[12]|.*(log_density|attributes)\.1")
    absent = [name for name in seen[0] if own.fullmatch(name)]
    assert len(absent) == 4
    for name in absent:
        torch.testing.assert_close(seen[-1][name], seen[1][name], rtol=0, atol=0)
    assert not torch.equal(seen[-1]["initial_states.velocity.0"], seen[1]["initial_states.velocity.0"])


def test_decay_takes_matrices_and_initial_states_of_its_groups_and_nothing_else() -> None:
    matrix, vector, other, state = (nn.Parameter(torch.ones(*shape)) for shape in ((2, 2), (2,), (2, 2), (2,)))
    settings = OptimizerSettings(template_lr=0.1, network_lr=0.1, initial_lr=0.1, decay={"template": 0.5, "initial": 1},
                                 optimizer=torch.optim.AdamW)  # fmt: skip
    optimizer = settings.build({"template": [matrix, vector], "network": [other], "initial": [state]})
    for parameter in (matrix, vector, other, state):
        parameter.grad = torch.zeros_like(parameter)
    optimizer.step()
    assert matrix[0, 0].item() == pytest.approx(0.95) and vector[0].item() == other[0, 0].item() == 1
    assert state[0].item() == pytest.approx(0.9)
    assert {group["name"] for group in optimizer.param_groups} == {"template", "network", "initial"}
    assert len(settings.clip(optimizer)) == 3  # groups are clipped by name
    with pytest.raises(ConfigError, match=r"decay.*\['nothing'\]"):
        OptimizerSettings(decay={"nothing": 1.0})
