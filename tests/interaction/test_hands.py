"""Hands: pins that a user moves."""

from __future__ import annotations

import pytest
import torch

from gausim.core import ConfigError
from gausim.interaction.interaction import replay
from gausim.interaction.selections import Whole
from gausim.interaction.session import Force, Hand
from gausim.interaction.words import entry_of

pytest_plugins = ["helpers.column"]
TO = (0.2, -0.1, 0.0)


def test_pins_go_where_the_hand_goes_and_the_body_follows(make_interaction) -> None:
    interaction = make_interaction()
    scene = interaction.scene
    interaction.step()
    interaction.act(Hand(to=TO, frames=10))
    for _ in range(10):
        frame = interaction.step()
    torch.testing.assert_close(frame.positions[scene.pinned], scene.means[scene.pinned] + torch.tensor(TO))
    assert torch.equal(frame.positions[~scene.simulated], scene.means[~scene.simulated])
    for _ in range(60):
        frame = interaction.step()
    free = scene.simulated & ~scene.pinned
    away = (frame.positions - scene.means - torch.tensor(TO))[free].norm(dim=1).mean()
    assert away < 0.1 * torch.tensor(TO).norm()
    interaction.act(Hand(to=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.3), frames=20))
    for _ in range(25):
        frame = interaction.step()
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


def test_a_hand_that_is_not_there_is_refused(make_interaction) -> None:
    with pytest.raises(ConfigError, match=r"field 'hand': expected 0 to 0, got 1"):
        make_interaction().act(Hand(to=TO, hand=1))


def test_a_hand_on_the_command_line(make_column) -> None:
    entry = entry_of("hand", ["to=0.1,0,0", "frames=8", "at=3"], make_column())
    assert entry.at == 3 and entry.event == Hand(to=(0.1, 0.0, 0.0), frames=8)
