"""Teaching: pairs of frames per second in single steps of the pure network, and frames per second of its rollouts."""

from __future__ import annotations

import torch

from benchmarks.harness import Options, Row, cloud, medians, simulator_of
from gausim.models.initial_state import FreeInitialStates
from gausim.render.cpu import CpuRenderer
from gausim.training.learner import Learner
from gausim.training.method import SharedSimulator
from gausim.training.plan import Teaching
from gausim.training.teach import TOGETHER, Lesson, Start, descend
from gausim.training.tracking import Track

# Kernels of the scene, frames of a sequence and updates of a timed call.
KERNELS, FRAMES, UPDATES = {False: 2_000, True: 120}, 16, {False: 10, True: 1}


def run(options: Options) -> list[Row]:
    """Updates of the weights on random smooth motion; one of them has eight pairs of frames, or eight rollouts."""
    scene = cloud(KERNELS[options.quick])
    model = simulator_of("gausim_network", scene).to(options.device).train()
    states = FreeInitialStates(model, [0] * TOGETHER).to(options.device)
    learner = Learner(method=SharedSimulator(model, states, [0] * TOGETHER), renderer=CpuRenderer())
    motions, draws = model.smooth_motions(0), torch.Generator().manual_seed(0)
    shown = []
    for number in range(TOGETHER):
        swing = torch.sin(0.4 * torch.arange(FRAMES))[:, None] * torch.randn(motions.count, generator=draws) / 8
        shown.append(Track(0, number, motions.displacements(swing * motions.sizes).to(options.device)))
    lesson = Lesson(learner, model, shown, Teaching(), seed=0)
    count, groups = UPDATES[options.quick], learner.groups()
    pairs: list[Start] = [(number, number) for number in range(TOGETHER)]
    rollouts: list[Start] = [(number, 0) for number in range(TOGETHER)]

    def called(starts: list[Start], steps: int) -> None:
        descend(learner, lesson, groups, [(0.0, starts, steps)] * count, 1.0, "", True)

    found = medians({"pairs": lambda: called(pairs, 1), "frames": lambda: called(rollouts, FRAMES - 1)}, options)
    case = f"teach, {scene.count} kernels, {sum(level.count for level in model.batch((0,)).levels)} units"
    return [
        Row(case, "single steps", count * TOGETHER / found["pairs"], "pairs/s"),
        Row(case, f"rollouts of {FRAMES - 1} frames", count * TOGETHER * (FRAMES - 1) / found["frames"], "frames/s"),
    ]
