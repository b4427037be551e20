"""The smallest simulator that can be trained, on the toy object: what tests of training share."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor, nn

from benchmarks.reference_renderer import ReferenceRenderer
from gausim.core import Frame, GaussianScene, Rendered, SimState
from gausim.data.dataset import SequenceSample
from gausim.losses import Objective
from gausim.models.initial_state import FreeInitialStates
from gausim.models.template.material import MaterialTemplate
from gausim.render.cpu import CpuRenderer
from gausim.training.method import SharedSimulator
from gausim.training.module import GausSimModule
from gausim.training.optimizers import OptimizerSettings
from helpers import toy_object
from helpers.simulators import gausim


class Sway(nn.Module):
    """x' = x + c (x - x_prev) + s z^2 e_x with one drift s per scene and one shared c: the smallest simulator."""

    def __init__(self, scenes: list[GaussianScene]) -> None:
        super().__init__()
        self.scenes = scenes
        self.keep = nn.Parameter(torch.tensor(0.5))
        self.drift = nn.ParameterList(torch.zeros(()) for _ in scenes)
        self.poison: float | None = None

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        return {"network": [self.keep], "scene": list(self.drift)}

    def batch(self, scene_ids: list[int]) -> SimpleNamespace:
        members, start = [], 0
        for n, i in enumerate(scene_ids):
            count = self.scenes[i].count
            units = torch.zeros(count, dtype=torch.long, device=self.scenes[i].means.device)
            rows = slice(start, start + count)
            members.append(SimpleNamespace(scene_id=i, kernels=rows, units=slice(n, n + 1), unit_of_kernel=units))
            start += count
        return SimpleNamespace(rest=torch.cat([self.scenes[i].means for i in scene_ids]), members=tuple(members))

    def prepare(self, batch: SimpleNamespace, **options: bool) -> None:
        return None

    def step(
        self, batch: SimpleNamespace, state: SimState, force: Tensor | None = None, prepared: None = None
    ) -> Frame:
        drift = torch.cat([self.drift[m.scene_id].expand(m.kernels.stop - m.kernels.start) for m in batch.members])
        push = torch.zeros_like(batch.rest)
        push[:, 0] = drift * batch.rest[:, 2] ** 2
        positions = state.positions + self.keep * (state.positions - state.previous) + push
        if self.poison is not None:
            positions = positions * self.poison
        identity = torch.eye(3, device=positions.device).expand(len(batch.members), 3, 3)
        momentum = (self.keep * drift.mean()).square()
        return Frame(positions, identity, identity, momentum=momentum)


class Previous(nn.Module):
    def __init__(self, model: Sway, scene_of_sequence: tuple[int, ...]) -> None:
        super().__init__()
        self.values = nn.ParameterList(model.scenes[i].means.clone() for i in scene_of_sequence)
        for sequence_id, scene_id in enumerate(scene_of_sequence):
            self.register_buffer(f"rest_{sequence_id}", model.scenes[scene_id].means, persistent=False)

    def state(self, sequence_id: int) -> SimState:
        return SimState(self.get_buffer(f"rest_{sequence_id}"), self.values[sequence_id])


SCENE_OF_SEQUENCE = (0, 0, 1)


def sample(sequence: int, steps: int = 3, amplitude: float = 0.4) -> SequenceSample:
    toy = toy_object.ToyObject(Path("unused"), toy_object.toy_scene(), amplitudes={"a": amplitude})
    frames = toy_object.rgba(toy.scene, toy.truth("a", steps + 1))
    return SequenceSample(
        scene_id=SCENE_OF_SEQUENCE[sequence], object_name="toy", sequence_id=sequence, sequence_name=f"seq_{sequence}",
        frames=frames, cameras=toy_object.cameras(), fps=24.0)  # fmt: skip


def sway_module(objective: Objective | None = None, **settings: float) -> GausSimModule:
    model = Sway([toy_object.toy_scene(), toy_object.toy_scene()])
    return GausSimModule(
        method=SharedSimulator(model, Previous(model, SCENE_OF_SEQUENCE), SCENE_OF_SEQUENCE),
        renderer=ReferenceRenderer(),
        objective=objective or Objective(),
        optimizer=OptimizerSettings(**settings),  # type: ignore[arg-type]
    )


def blobs(means: Tensor, covars: Tensor, colors: Tensor, opacities: Tensor, viewmats: Tensor, Ks: Tensor,
          size: tuple[int, int], *, background: Tensor | None = None) -> Rendered:  # fmt: skip
    """A renderer of a few operations that never reads a number: the sum of Gaussians of a fixed width."""
    camera = torch.einsum("bvij,bkj->bvki", viewmats[..., :3, :3], means) + viewmats[..., None, :3, 3]
    pixel = torch.einsum("bvij,bvkj->bvki", Ks, camera)
    pixel = pixel[..., :2] / pixel[..., 2:].clamp_min(0.1)
    x, y = (torch.arange(n, device=means.device) + 0.5 for n in size)
    rows, columns = (torch.exp(-0.5 * (axis - pixel[..., i, None]) ** 2) for i, axis in ((1, y), (0, x)))
    size = 1 + 0.1 * covars.diagonal(dim1=-2, dim2=-1).sum(-1)
    weight = opacities[:, None, :, None] * colors * size[:, None, :, None]
    rgb = torch.einsum("bvkh,bvkw,bvkc->bvhwc", rows, columns, weight).tanh()
    return Rendered(rgb, rgb.amax(-1))


def cast(record: Any, dtype: torch.dtype) -> Any:
    """A scene or cameras in another type."""
    floats = {n: v.to(dtype) for n, v in vars(record).items() if torch.is_tensor(v) and v.is_floating_point()}
    return replace(record, **floats)


ELASTIC = partial(MaterialTemplate, modes=6)


def real_module(
    scene_of_sequence: Sequence[int] = (0,),
    *,
    states: Callable[..., nn.Module] = FreeInitialStates,
    parts: Mapping[str, Any] | None = None,
    dtype: torch.dtype = torch.float32,
    **options: Any,
) -> GausSimModule:
    """A small simulator of toy scenes to be trained; ``options`` are the simulator's, ``parts`` the module's."""
    torch.manual_seed(0)
    scenes = [cast(toy_object.toy_scene(), dtype) for _ in range(max(scene_of_sequence) + 1)]
    model = gausim(scenes, [24.0] * len(scenes), **{"radii": (0.3, 0.7), "hidden": 8, "layers": 1, **options})
    method = SharedSimulator(model, states(model, scene_of_sequence), scene_of_sequence)
    return GausSimModule(method=method, **{"renderer": CpuRenderer(threads=1), **(parts or {})}).to(dtype)
