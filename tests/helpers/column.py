"""A small elastic column under a network with random weights, and an interaction with it."""

from dataclasses import replace
from functools import partial

from gausim.core import Frame, GaussianScene, SimState
from gausim.interaction.interaction import Interaction
from gausim.interaction.session import MadeWith
from gausim.models.rollout.dynamics import SceneDynamics
from gausim.models.step.simulator import GausSim
from gausim.models.template.material import MaterialTemplate
from helpers import bodies


def make_column(count: int = 90) -> GaussianScene:
    return replace(bodies.make_scene(count), name="column")


def make_simulator(scene: GaussianScene, *, seed: int = 0, passive: int = 6) -> GausSim:
    settings = {"template": partial(MaterialTemplate, modes=8), "output_scale": 0.01, "anchor": True}
    return bodies.make_model(scene, seed=seed, energy_guard_frames=passive, **settings)


def make_interaction(*, seed: int = 0, ceiling: float | None = None, **options: object) -> Interaction:
    scene = make_column()
    model, initial = make_simulator(scene, seed=seed), SimState(scene.means, scene.means)
    dynamics = SceneDynamics(model)
    dynamics.energy_ceiling = ceiling
    made_with = MadeWith.of(scene, model, initial, run="toy")
    units = model.units_of_kernels(0)
    return Interaction(scene, dynamics, dynamics.masses, initial, made_with=made_with, units=units, **options)


def steps(interaction: Interaction, count: int) -> Frame:
    """Takes some steps, at least one; the last frame."""
    for _ in range(count):
        frame = interaction.step()
    return frame
