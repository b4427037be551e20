"""Where free bodies are and how fast they move in their first frames, from silhouettes: the start of their training."""

from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.data.datamodule import ReadyDataModule
from gausim.data.dataset import SampleKey
from gausim.ops.triangulation import centroids
from gausim.training.learner import Learner

# Frames before which a body is taken to fall freely.
FREE_FALL = 4


def begin_free_bodies(module: Learner, datamodule: ReadyDataModule) -> None:
    """Sets the initial states of all sequences of free bodies from the silhouettes of frames 0 to 4.

    A run that is resumed does so too, before its states are restored: its baseline metrics are of these beginnings.
    """
    scenes, states = module.simulator.scenes, cast(Any, module.initial_states)
    for sequence_id, (scene_id, record) in enumerate(datamodule.index.entries):
        surroundings = scenes[scene_id].surroundings
        if not surroundings.free:
            continue
        last = min(FREE_FALL, len(datamodule.objects[scene_id].train_frames) - 1)
        sample = datamodule.index[SampleKey(sequence_id, last)]
        gravity = torch.tensor(surroundings.gravity or (0.0, 0.0, 0.0), dtype=torch.float64) / record.fps**2
        observed = centroids(sample.frames[..., 3].double() / 255, sample.cameras)
        place, velocity = ballistic(observed, gravity)
        rest = scenes[scene_id].means.double()
        moved = place - rest[scenes[scene_id].simulated].mean(0)
        # The middle of what is seen is not the centre of the kernels: compare with the body drawn at that place.
        drawn = module.images.undeformed(sample, (rest + moved).to(scenes[scene_id].means))
        seen = centroids(drawn.alpha.double(), sample.cameras)[0]
        states.begin(sequence_id, moved + place - seen, velocity)
        module.images.begun[sequence_id] = states.state(sequence_id).positions.detach()


def ballistic(places: Float[Tensor, "F 3"], gravity: Float[Tensor, " 3"]) -> tuple[Tensor, Tensor]:
    """x_0 and x_0 - x_{-1} of the fall x_f = x_0 + f (x_0 - x_{-1}) + f (f + 1) / 2 g nearest to the places."""
    frame = torch.arange(len(places), dtype=places.dtype)
    straight = places - (frame * (frame + 1) / 2)[:, None] * gravity
    columns = torch.stack((torch.ones_like(frame), frame), 1)
    found = torch.linalg.lstsq(columns, straight).solution
    return found[0], found[1]
