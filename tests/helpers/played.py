"""A small run of an elastic toy, as `load_run` gives it back, without training: for commands that push it."""

from functools import partial
from pathlib import Path
from types import SimpleNamespace

import torch

from benchmarks.reference_renderer import ReferenceRenderer
from gausim.compose.build import LoadedRun
from gausim.core import SimState
from gausim.data.objects import ObjectData
from gausim.models.initial_state import ModalInitialStates
from gausim.models.rollout.dynamics import SceneDynamics
from gausim.models.template.material import MaterialTemplate
from helpers import toy_object
from helpers.simulators import gausim


def stand_in(directory: Path, root: Path, *, model: object, **parts: object) -> LoadedRun:
    """What loading a finished run gives, with a model and parts of a module of our own."""
    directory.mkdir(parents=True)
    stored = {"state_dict": {}, "gausim": {}, "epoch": 3, "global_step": 40}
    torch.save(stored, directory / "last.ckpt")
    (directory / "FINISHED").write_text("{}")
    (directory / "config.yaml").write_text("name: toy\n")
    facts = {"method_name": "gausim", "footnotes": None, "method": None}
    run = object.__new__(LoadedRun)  # without its checks of types, which parts of our own would not pass
    vars(run).update(
        config={"name": "toy", "seed": 5, "model": {"modes": 6}}, run_dir=directory, objects=[ObjectData(root)],
        module=SimpleNamespace(model=model, scenes=model.scenes, **facts, **parts), renderer=ReferenceRenderer(),
    )  # fmt: skip
    return run


def played_run(folder: Path) -> LoadedRun:
    """Two sequences of one object; the network has random weights, the template a firm block."""
    toy = toy_object.write_toy_object(folder / "data" / "toy")
    torch.manual_seed(0)
    template = partial(MaterialTemplate, modes=6)
    model = gausim(
        [toy.scene], [toy.fps], radii=(0.3, 0.7), graph_radii=(0.9, 0.5), max_neighbours=6, hidden=8, layers=1,
        template=template, output_scale=0.005, energy_guard_frames=6,
    ).eval()  # fmt: skip
    states = ModalInitialStates(model, [0, 0])
    with torch.no_grad():
        for number, velocity in enumerate(states.velocity):
            velocity[0] = 0.05 * (number + 1)

    def predict(sequence: int, steps: int):
        with torch.no_grad():
            return SceneDynamics(model).rollout(SimState(toy.scene.means, states.state(sequence).previous), steps)

    return stand_in(folder / "demo" / "seed_0", toy.root, model=model, initial_states=states, predict=predict)
