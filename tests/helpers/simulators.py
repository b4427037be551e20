"""Simulators by flat arguments: what tests vary, whichever part it belongs to."""

import inspect
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from gausim.core import GaussianScene
from gausim.models.hierarchy.batch import LevelBatch
from gausim.models.settings import HierarchySettings, RolloutSettings
from gausim.models.step.features import FeatureOptions
from gausim.models.step.head import Head
from gausim.models.step.recursion import Solved, Units
from gausim.models.step.simulator import GausSim
from gausim.models.template.template import RestTemplate
from gausim.nn.meshgraphnet import MeshGraphNet

PARTS = {"hierarchy": HierarchySettings, "features": FeatureOptions, "network": MeshGraphNet, "head": Head,
         "rollout": RolloutSettings}  # fmt: skip

# The paper's settings, which tests vary.
PAPER = {
    "hierarchy": {"max_neighbours": 16, "edges": "union", "body_frame": False},
    "features": {"rest_inputs": False, "velocities": True, "centred": False, "attributes": 4, "floor": False},
    "head": {"output_scale": 1.0, "zero_output": False, "lever": 0.0, "anchor": False},
    "rollout": {"energy_guard_frames": 0}, "network": {},
}  # fmt: skip

# As an override of `gausim train`: two levels for an object of a few kernels.
LEVELS = "model.simulator.hierarchy.levels=[{diameter: 0.7, edge_length: 2.0},{diameter: 0.3, edge_length: 0.4}]"
# The smallest run of `gausim train`, in silence.
SMALLEST = (
    "model.simulator.network.layers=1", "model.simulator.network.hidden=8", LEVELS, "trainer.progress=false",
    "trainer.threads=1", "trainer.panel_epochs=0", "plan.warm_start=null", "doctor=false",
)  # fmt: skip


def levels(
    radii: Sequence[float] = (0.1, 0.35), predicted: Sequence[int] = (2, 1), lengths: Sequence[float] = (2.0, 0.4)
) -> list[dict[str, float]]:
    """Levels as the simulator takes them.

    Args:
        radii: cluster diameters of levels 1, 2, ..., fine to coarse.
        predicted: which of them, coarse to fine; 0 is that of the kernels.
        lengths: edge length of each of these.
    """
    diameters = (0.0, *radii)
    return [{"diameter": diameters[n], "edge_length": e} for n, e in zip(predicted, lengths, strict=True)]


def gausim(
    scenes: Sequence[GaussianScene],
    fps: Sequence[float],
    *,
    radii: Sequence[float] = (0.1, 0.35),
    predicted_levels: Sequence[int] = (2, 1),
    graph_radii: Sequence[float] = (2.0, 0.4),
    **options: Any,
) -> GausSim:
    """The paper's simulator but for the options; one that no part has goes to the constructor."""
    options = {"template": RestTemplate} | options
    given = {
        part: PAPER[part] | {n: options.pop(n) for n in inspect.signature(kind).parameters if n in options}
        for part, kind in PARTS.items()
    }
    found = levels(radii, predicted_levels, graph_radii)
    return GausSim(
        scenes, fps, hierarchy=HierarchySettings(levels=found, **given["hierarchy"]),
        features=FeatureOptions(**given["features"]), network=partial(MeshGraphNet, **given["network"]),
        head=Head(**given["head"]), rollout=RolloutSettings(**given["rollout"]), **options,
    )  # fmt: skip


def feed(model: GausSim, deformation_gradients: Callable[..., tuple[Tensor, Tensor]]) -> None:
    """Has the network's place taken by a function of (level, unit, above, target, position), which gives F and Q."""
    seen: list[tuple[Units, int]] = []

    def forward(level: LevelBatch, unit: Units, above: Solved, target: Tensor, position: int) -> Tensor:
        seen.append((unit, position))
        return torch.zeros(level.count, 11)

    def gradient(output: Tensor, level: LevelBatch, above: Solved, target: Tensor) -> tuple[Tensor, Tensor]:
        unit, position = seen.pop()
        return deformation_gradients(level, unit, above, target, position)

    model.predictor.forward, model.predictor.deformation_gradient = forward, gradient  # type: ignore[method-assign]


def change_head(model: GausSim, **settings: float) -> None:
    """Reads the network's output otherwise from now on."""
    model.predictor.head = replace(model.predictor.head, **settings)


def silence(model: GausSim) -> None:
    """Leaves the template alone from now on."""
    change_head(model, output_scale=0.0, lever=0.0)
