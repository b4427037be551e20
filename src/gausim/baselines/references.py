"""Predictions without dynamics, from which every table counts: at rest, in rigid flight, and following hands."""

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from gausim.core import GaussianScene, HandPath, SimState, Trajectory
from gausim.core.surroundings import best_rotation
from gausim.ops.rotation import rotation_of, rotation_vector


def static_motion(scene: GaussianScene, *, fps: float, steps: int) -> Trajectory:
    """The rest state in ``steps`` + 1 frames (memory of one frame)."""
    rest, frames = scene.means, steps + 1
    identity = torch.eye(3).to(rest).expand(frames, 1, 3, 3)
    one_unit = torch.zeros(len(rest), dtype=torch.long, device=rest.device)
    return Trajectory(rest.expand(frames, -1, -1), identity, identity, one_unit, fps)


def ballistic_motion(scene: GaussianScene, initial: SimState, *, fps: float, steps: int) -> Trajectory:
    """The rest shape in rigid flight: constant spin, constant velocity under gravity, no bounce.

    Position and orientation in the two given frames are the best rigid fit of the rest shape (Kabsch); the later one is
    the first of ``steps`` + 1 frames. Where its lowest kernel meets the floor from above, the body stops for good.
    Gravity that is trained counts as its initial value.
    """
    rest, own, around = scene.means, scene.simulated, scene.surroundings
    rotation, centre = rigid_fit(rest[own], initial.positions[own])
    before, centre_before = rigid_fit(rest[own], initial.previous[own])
    offset, spin = rest.double() - rest[own].double().mean(0), rotation @ before.mT
    pull = torch.tensor(around.gravity or (0.0, 0.0, 0.0)).to(centre) / fps**2
    move = centre - centre_before
    rotations, positions = [rotation], [centre + offset @ rotation.mT]
    for _ in range(steps):
        # Verlet's step, exact in uniform gravity.
        move = move + pull
        rotation, centre = spin @ rotation, centre + move
        if around.floor is not None:
            up = centre.new_tensor(around.floor.normal)
            depth = -float(around.floor.height(centre + offset[own] @ rotation.mT).min())
            if depth > 0 and float(move @ up) < 0:  # what rises may leave it
                centre, move = centre + depth * up, torch.zeros_like(move)
                spin, pull = torch.eye(3).to(spin), torch.zeros_like(pull)
        rotations.append(rotation)
        positions.append(centre + offset @ rotation.mT)
    turned = torch.stack(rotations)[:, None].to(rest)
    # The last unit is for kernels that never move.
    turned = torch.cat((turned, torch.eye(3).to(turned).expand_as(turned)), 1)
    moved = torch.where(own[:, None], torch.stack(positions).to(rest), rest)
    return Trajectory(moved, turned, turned, (~own).long(), fps)


def rigid_fit(rest: Float[Tensor, "P 3"], moved: Float[Tensor, "P 3"]) -> tuple[Tensor, Tensor]:
    """Rotation R (3, 3) and centre c (3,) that minimise sum |R (X - mean X) + c - x|^2, in float64 (Kabsch)."""
    offset, centre = rest.double() - rest.double().mean(0), moved.double().mean(0)
    return best_rotation(moved.double() - centre, offset), centre


def hands_motion(scene: GaussianScene, hands: HandPath, *, fps: float, steps: int) -> Trajectory:
    """Kernels move by the mean of the hands' motions, weighted by the inverse distance w_g to what each hand holds.

    With hand g at c_g, turned by exp(theta_g) about o_g, kernel X goes to
    X + sum_g w_g (c_g - o_g + (exp(w_g theta_g) - I) (X - o_g)): exactly with its hand where it is held, and between
    two hands as far apart as a beam is long, along the beam's static deflection by turned ends. Pins that no hand moves
    count as a hand that stands still. The result has ``steps`` + 1 frames, from frame 0 of the hands on.
    """
    rest, positions, rotations = scene.means, [], []
    weights = hand_weights(scene)
    for frame in range(steps + 1):
        pose = hands.pose(frame).to(rest)
        moved, turn = rest, torch.zeros_like(rest)
        for number, weight in enumerate(weights.unbind(1)):
            theta = weight[:, None] * rotation_vector(pose.rotations[number])
            offset = rest - pose.origins[number]
            turned = (rotation_of(theta) @ offset[..., None])[..., 0] - offset
            moved = moved + weight[:, None] * (pose.centres[number] - pose.origins[number] + turned)
            turn = turn + theta
        positions.append(moved)
        rotations.append(rotation_of(turn))
    turns, units = torch.stack(rotations), torch.arange(len(rest), device=rest.device)
    return Trajectory(torch.stack(positions), turns, turns, units, fps)


def hand_weights(scene: GaussianScene) -> Float[Tensor, "K G"]:
    """Weight of every hand for each kernel: inverse distances to the nearest kernel that it holds, sum at most 1.

    What is missing to 1 is the weight of the pins that no hand moves, and all of it for kernels that are not simulated.
    """
    hand = torch.full_like(scene.pinned, -1, dtype=torch.long) if scene.hand is None else scene.hand
    holders = sorted(set(hand[scene.pinned].tolist()))
    means = scene.means.cpu().numpy()
    trees = [cKDTree(means[(scene.pinned & (hand == g)).cpu().numpy()]) for g in holders]
    distance = torch.from_numpy(np.stack([tree.query(means)[0] for tree in trees], 1)).to(scene.means)
    nearness = 1 / distance.clamp_min(1e-6 * scene.diagonal)
    weights = nearness / nearness.sum(1, keepdim=True)
    for column, holder in enumerate(holders):
        held = scene.pinned & (hand == holder)
        weights[held] = torch.eye(len(holders)).to(weights)[column]
    weights = weights * scene.simulated[:, None]
    return weights[:, 1:] if holders[0] < 0 else weights
