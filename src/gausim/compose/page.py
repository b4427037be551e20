"""What a page that simulates an object needs, from a trained run."""

from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from gausim.compose.build import LoadedRun
from gausim.compose.live import energy_ceiling
from gausim.compose.predict import RunObject
from gausim.core import ConfigError, GaussianScene, SimState
from gausim.interaction.interaction import STANDARD_GRAVITY
from gausim.interaction.pushes import exposure
from gausim.io.page import ElasticPage, Start
from gausim.models.rollout.dynamics import SceneDynamics
from gausim.models.step.simulator import GausSim
from gausim.models.template.material import MaterialTemplate, PreparedMaterial
from gausim.models.template.reduced import reduced_step
from gausim.runs.provenance import code_provenance, data_provenance

# Sequences over which the network's share is measured.
MOST_COMPARED = 3


@torch.no_grad()
def elastic_page(run: LoadedRun, item: RunObject) -> tuple[ElasticPage, str]:
    """An object of a run for :func:`gausim.io.page.save_page`, and a sentence on the network, which is left out.

    Raises:
        ConfigError: the run's method has no material template, or the body moves as a whole or in hands.
    """
    scene, model, data = item.scene, _model(run), item.data
    _refuse(scene, item)
    states = [cast(Any, run.module.initial_states).state(item.first_sequence + i) for i in range(len(data.sequences))]
    projection = model.modal_projection(item.scene_id)
    starts = [
        Start(record.name, _coordinates(projection, state.previous - scene.means), record.count, data.train_frames.stop)
        for record, state in zip(data.sequences, states, strict=True)
    ]
    share = network_share(model, item.scene_id, states[:MOST_COMPARED], max(r.count for r in data.sequences) - 1)
    ceiling = energy_ceiling(model, item.scene_id, [state.previous for state in states])
    about = [*_provenance(run, item), ("Network", share)]
    return body_page(model, item.scene_id, starts=starts, ceiling=cast(float, ceiling), about=about), share


@torch.no_grad()
def body_page(
    model: GausSim, scene_id: int, *, starts: list[Start], ceiling: float, about: list[tuple[str, str]]
) -> ElasticPage:
    """The page of a scene of a simulator with a material template, in the scene's axes."""
    scene, batch, part = model.scenes[scene_id], model.batch((scene_id,)), model.modal_scene(scene_id)
    assert isinstance(part, PreparedMaterial)
    axes, member, units = model.axes[scene_id], batch.members[0], model.units(batch)[2][-1]
    modes = torch.einsum("ba,nbm->nam", axes, part.body.modes)
    step, numbers = reduced_step(part)
    if "offset" in step:
        step["offset"] = step["offset"] @ axes.numpy()
    projection, free = model.modal_projection(scene_id), scene.simulated & ~scene.pinned
    exposed = exposure(scene, SceneDynamics(model, scene_id).masses, free)
    weights = (part.body.projection * part.body.modes).sum((1, 2)) / part.body.modes.square().sum((1, 2)).clamp_min(
        1e-30
    )
    return ElasticPage(
        scene=scene,
        centres=units.rest,
        unit_of_kernel=member.unit_of_kernel,
        modes=modes,
        gradients=torch.einsum("ca,ncdm,db->nabm", axes, part.body.gradients, axes),
        weights=weights,
        wind=torch.einsum("k,kam->am", exposed, projection),
        step=step,
        numbers=numbers,
        starts=starts,
        fps=model.fps[scene_id],
        gravity=STANDARD_GRAVITY,
        ceiling=ceiling,
        conserve_volume=cast(MaterialTemplate, model.template).conserve_volume,
        about=about,
    )


def network_share(model: GausSim, scene_id: int, states: list[SimState], steps: int) -> str:
    """How far the network moves the kernels from where the template alone has them, as a sentence."""
    scene = model.scenes[scene_id]
    free = scene.simulated & ~scene.pinned
    differences, motions = [], []
    for state in states:
        both, alone = (
            SceneDynamics(model, scene_id, correction_scale=scale).rollout(state, steps).positions[1:, free]
            for scale in (1.0, 0.0)
        )
        differences.append((both - alone).norm(dim=-1).mean() / scene.diagonal)
        motions.append((both - scene.means[free]).norm(dim=-1).mean() / scene.diagonal)
    moved, motion = (float(torch.stack(values).mean()) for values in (differences, motions))
    return (
        f"The page simulates the learned template without the network, which would move a kernel by {moved:.2g} "
        f"diagonals in the mean over {len(states)} sequences ({100 * moved / max(motion, 1e-12):.2g} % of its motion)."
    )


def _model(run: LoadedRun) -> GausSim:
    model = getattr(run.module, "model", None)
    if isinstance(model, GausSim) and isinstance(model.template, MaterialTemplate):
        return model
    raise ConfigError(
        f"{run.run_dir}: --format page needs a run of model=gausim, whose template is a few matrices. Export this "
        "one with --format html, which plays its predictions."
    )


def _refuse(scene: GaussianScene, item: RunObject) -> None:
    """Refuses bodies whose reference is not at rest."""
    if not scene.surroundings.still or any(record.hands is not None for record in item.data.sequences):
        raise ConfigError(
            f"{item.data.name}: the body falls, lies on a floor or is held by moving hands, and --format page "
            "simulates bodies in fixed pins. Export it with --format html, or play it with `gausim view`."
        )


def _coordinates(projection: Tensor, displacement: Tensor) -> list[float]:
    values: list[float] = torch.einsum("kam,ka->m", projection, displacement.to(projection)).tolist()
    return values


def _provenance(run: LoadedRun, item: RunObject) -> list[tuple[str, str]]:
    """What the page was made from: run, commits, hashes, licence."""
    code, data = code_provenance(), data_provenance(item.data)
    commit = f"{code['commit'] or 'not known'}{' (modified)' if code['modified'] else ''}"
    hashes = [
        f"{data[key]['file']} {data[key]['sha256']}" for key in ("scene", "masks", "manifest") if data[key]["sha256"]
    ]
    return [
        ("Object", item.data.name),
        ("Run", "/".join(Path(run.run_dir).resolve().parts[-2:])),
        ("Made by", f"gausim {code['gausim']}, commit {commit}"),
        ("Data (SHA-256)", "; ".join(hashes)),
        ("Licence", "of the program: Apache 2.0; of the object: that of its data"),
    ]
