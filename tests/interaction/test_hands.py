"""Hands: pins that a user moves."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.column import steps

from gausim.core import ConfigError, HandPath
from gausim.interaction.hands import MovedHands
from gausim.interaction.replay import replay
from gausim.interaction.selections import Whole
from gausim.interaction.session import Force, Hand
from gausim.interaction.words import entry_of
from gausim.ops.rotation import rotation_of

TO = (0.2, -0.1, 0.0)


def test_pins_go_where_the_hand_goes_and_the_body_follows(make_interaction) -> None:
    interaction = make_interaction()
    scene = interaction.scene
    interaction.step()
    interaction.act(Hand(to=TO, frames=10))
    frame = steps(interaction, 10)
    torch.testing.assert_close(frame.positions[scene.pinned], scene.means[scene.pinned] + torch.tensor(TO))
    assert torch.equal(frame.positions[~scene.simulated], scene.means[~scene.simulated])
    frame = steps(interaction, 60)
    free = scene.simulated & ~scene.pinned
    away = (frame.positions - scene.means - torch.tensor(TO))[free].norm(dim=1).mean()
    assert away < 0.1 * torch.tensor(TO).norm()
    interaction.act(Hand(to=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.3), frames=20))
    frame = steps(interaction, 25)
    assert (frame.positions - scene.means)[free].norm(dim=1).max() > 0.02


def test_a_session_with_a_hand_is_replayed_bit_for_bit(make_interaction) -> None:
    interaction = make_interaction()
    interaction.act(Force(Whole(), (1.0, 0.0, 0.0), 0.5, name="pull"))
    for number in range(12):
        if number == 4:
            interaction.act(Hand(to=TO, frames=5))
        interaction.step()
    session, last = interaction.session(), interaction.frame.positions
    assert torch.equal(replay(make_interaction(), session).positions[-1], last)


def _nodding(frames: int = 8) -> HandPath:
    """A hand of four points that shifts and turns."""
    points = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    poses = [(points @ rotation_of(torch.tensor([0.0, 0.05 * f, 0.0])).mT) + 0.02 * f for f in range(frames)]
    return HandPath.of(torch.stack(poses), torch.zeros(4, dtype=torch.long))


def test_a_session_follows_recorded_hands_until_the_user_takes_over(make_interaction) -> None:
    path = _nodding()
    interaction = make_interaction(hands=path.pose, keep=None)
    pinned, rest = interaction.scene.pinned, interaction.scene.means
    for number in range(1, 5):
        frame = interaction.step()
        carried = path.pose(number).move(rest[pinned], torch.zeros(int(pinned.sum()), dtype=torch.long))
        torch.testing.assert_close(frame.positions[pinned], carried)
    dynamics = interaction._dynamics
    recorded = dynamics.rollout(interaction._initial, 4, hands=path.pose)
    assert torch.equal(interaction.trajectory().positions, recorded.positions)
    before, (to, turn) = frame.positions, interaction.place_of_hand(0)
    interaction.act(Hand(to=to, turn=turn))  # stop here
    for _ in range(2):
        frame = interaction.step()
        torch.testing.assert_close(frame.positions[pinned], before[pinned], atol=1e-5, rtol=0)
    interaction.act(Hand(to=TO, frames=3))
    frame = steps(interaction, 3)
    torch.testing.assert_close(frame.positions[pinned], rest[pinned] + torch.tensor(TO))
    session, last = interaction.session(), frame.positions
    assert torch.equal(replay(make_interaction(hands=path.pose), session).positions[-1], last)
    interaction.reset()
    assert torch.equal(interaction.step().positions, recorded.positions[1])


def test_a_hand_that_is_moved_leaves_the_others_to_the_recording(make_column) -> None:
    scene = make_column()
    pins = scene.pinned.nonzero()[:, 0]
    hand = torch.full((scene.count,), -1).index_copy(0, pins, torch.arange(len(pins)) % 2)
    points = torch.stack([torch.tensor([[0.0, 0, 0], [1.0, 0, 0]]) + 0.1 * f for f in range(6)])
    path = HandPath.of(points, torch.tensor([0, 1]))
    hands = MovedHands(replace(scene, hand=hand), path.pose)
    assert hands.pose(2) is path.pose(2)
    hands.move(Hand(to=(1.0, 0.0, 0.0), hand=1, frames=2), 2)
    torch.testing.assert_close(hands.places(1)[:, :3], torch.full((2, 3), 0.1).double(), atol=1e-6, rtol=0)
    torch.testing.assert_close(
        hands.places(4)[:, :3], torch.tensor([[0.4] * 3, [1.0, 0, 0]]).double(), atol=1e-6, rtol=0
    )
    assert hands.pose(4) is hands.pose(4)


def test_a_hand_that_is_not_there_is_refused(make_interaction) -> None:
    with pytest.raises(ConfigError, match=r"field 'hand': expected 0 to 0, got 1"):
        make_interaction().act(Hand(to=TO, hand=1))


def test_a_hand_on_the_command_line(make_column) -> None:
    entry = entry_of("hand", ["to=0.1,0,0", "frames=8", "at=3"], make_column())
    assert entry.at == 3 and entry.event == Hand(to=(0.1, 0.0, 0.0), frames=8)
