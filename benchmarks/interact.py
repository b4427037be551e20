"""Interaction: cost of a frame from the force to the bytes for the browser."""

from __future__ import annotations

import torch

from benchmarks.harness import Options, Row, cloud, medians, simulator_of
from gausim.core import SimState
from gausim.interaction.interaction import Interaction
from gausim.interaction.selections import Ball
from gausim.interaction.session import Force, MadeWith
from gausim.models.rollout.dynamics import SceneDynamics
from gausim.viewer.coloring import VIEW, Painter
from gausim.viewer.splats import Placing, pack

SIZES = {False: (2_000, 20_000), True: (300,)}


def run(options: Options) -> list[Row]:
    """Simulated frames per second, and the times of a frame's stages, with untrained weights."""
    return [row for count in SIZES[options.quick] for row in _frame(count, options)]


def _frame(count: int, options: Options) -> list[Row]:
    scene = cloud(count, degree=3)
    model = simulator_of("gausim", scene).eval().to(options.device)
    scene = scene.to(options.device)
    initial, dynamics = SimState(scene.means, scene.means), SceneDynamics(model)
    units = [u.to(options.device) for u in model.units_of_kernels(0)]
    made_with = MadeWith.of(scene, model, initial)
    live = Interaction(scene, dynamics, dynamics.masses, initial, made_with=made_with, units=units)
    x, y, z = scene.means[scene.means[:, 2].argmax()].tolist()
    live.act(Force(Ball((x, y, z), 0.2), (1.0, 0.0, 0.0), 1.0))
    live.step()
    painter, placing = Painter(scene, units, live.masses), Placing.of(scene)
    look = live.unit_of_kernel, torch.zeros(count), VIEW, torch.tensor([0.0, -3.0, 0.5])
    covars, rgb, _ = painter(live.frame, *look)
    stages = {
        "step": live.step,
        "colours": lambda: painter(live.frame, *look),
        "packing": lambda: pack(live.frame.positions.cpu(), covars, rgb, painter.opacities, placing),
    }
    times = medians(stages, options, warmup=3)
    case = f"{count} kernels, {sum(level.count for level in model.hierarchies[0].levels[1:])} units"
    rows = [Row(case, "simulated", 1 / times["step"], "frames/s")]
    rows.append(Row(case, "made one after the other", 1 / sum(times.values()), "frames/s"))
    return rows + [Row(case, name, seconds, "s") for name, seconds in times.items()]
