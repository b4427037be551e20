"""The viewer's simulating thread: what is done to it, played back, undone and stopped."""

import asyncio
import threading
import time
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from helpers.column import make_interaction

pytest.importorskip("viser", reason="the extra 'view' is not installed")


from gausim.core import ConfigError
from gausim.interaction import interaction as interaction_module
from gausim.interaction.replay import replay
from gausim.interaction.selections import Unit, Whole
from gausim.interaction.session import Force, Gravity, Impulse, Pin, Release, Reset, Wind
from gausim.viewer.live import Live
from gausim.viewer.pointer import Pointer
from gausim.viewer.shown import LIVE, Take
from gausim.viewer.splats import SIZE, Placing


@pytest.fixture
def one() -> Live:
    return Live(make_interaction(keep=None), lambda _: None)


def test_a_dragged_pin_takes_its_hand_along(one: Live) -> None:
    interaction = one.interaction
    scene, placing = interaction.scene, Placing.of(interaction.scene)
    pointer = Pointer(MagicMock(), one, placing)
    pointer.follow(one.shown())
    followed: list[tuple[float, float, float]] = []
    pointer.hand_moved = lambda hand, to: followed.append(to)

    def drag(kernel: int, *way: tuple[str, tuple[float, float, float]], handle: int = 0) -> None:
        begun = placing.to_page(interaction.frame.positions[kernel]).double().numpy()
        for phase, moved in way:
            start = placing.to_page(interaction.frame.positions[kernel]).double().numpy()
            camera = SimpleNamespace(position=start - np.array([0.0, 0.0, SIZE]))  # looks up from below
            end = begun + placing.scale * np.array(moved)
            asyncio.run(
                pointer._dragged(
                    SimpleNamespace(
                        client=SimpleNamespace(camera=camera), client_id=0, phase=phase, instance_index=handle,
                        start_position=start, end_position=end,
                    )
                )
            )  # fmt: skip
            one._take_commands(0.0)
            one.advance()

    low = int(scene.means[:, 2].masked_fill(~scene.pinned, torch.inf).argmin())
    drag(low, ("start", (0.0, 0.0, 0.0)), ("update", (0.1, 0.0, 0.0)), ("end", (0.1, 0.0, 0.0)))
    for _ in range(6):
        one.advance()
    assert not one.message and not interaction.acting
    moved = interaction.frame.positions - scene.means
    torch.testing.assert_close(moved[scene.pinned], torch.tensor([0.1, 0.0, 0.0]).expand(int(scene.pinned.sum()), 3))
    assert followed and followed[-1] == pytest.approx((0.1, 0.0, 0.0), abs=1e-5)
    free = int(scene.means[:, 2].argmax())  # a pin's own handle moves its hand, whatever is in front
    pins = len(pointer._centres(scene.means)) - 1
    drag(free, ("start", (0.0, 0.0, 0.0)), ("update", (0.0, 0.1, 0.0)), ("end", (0.0, 0.1, 0.0)), handle=pins)
    assert interaction.session().entries[-1].event.to == pytest.approx((0.1, 0.1, 0.0), abs=1e-5)  # goes on from there


def test_what_was_done_is_played_back_bit_for_bit(one: Live) -> None:
    for number in range(12):
        if number == 2:
            one.act(Force(Unit(1, 3), (1.0, 0, 0), 2.0, name="drag-0"))
        if number == 5:
            one.act(Release("drag-0"))
            one.act(Wind((0.0, 1.0, 0.0), 0.5, gusts=0.5))
        if number == 8:
            one.act(Pin(Unit(1, 0)))
            one.act(Impulse(Whole(), (0.0, 0.0, 1.0), 0.05))
        one.advance()
    recorded, session = one.interaction.trajectory(), one.interaction.session()
    one.replay(session)
    with pytest.raises(ConfigError, match="played back"):
        one.act(Reset())
    while one.playing:
        one.advance()
    assert "over" in one.message
    again = one.interaction.trajectory()
    for name in ("positions", "deformation_gradients"):
        assert torch.equal(getattr(again, name), getattr(recorded, name))
    assert one.interaction.session() == session
    assert torch.equal(replay(one.interaction, session).positions, recorded.positions)


def test_the_timeline_goes_back_and_play_goes_on_from_the_end(one: Live) -> None:
    one.act(Gravity((1.0, 0.0, 0.0), 1.0))
    for _ in range(6):
        one.advance()
    last = one.interaction.frame.positions
    one.scrub(2)
    assert not one.playing and one.shown().number == 2 and one.shown().last == 6
    assert not torch.equal(one.shown().frame.positions, last)
    one.play()
    assert torch.equal(one.shown().frame.positions, last)
    one.reset()
    assert one.shown().last == 0 and torch.equal(one.shown().frame.positions, one.interaction.scene.means)
    for wrong in (-5, 10**6):
        one.scrub(wrong)
        assert one.shown().number == 0


def test_divergence_stops_the_simulation_with_a_message_and_a_reset_helps(one: Live, monkeypatch) -> None:
    monkeypatch.setattr(interaction_module, "FARTHEST", 1e-4)
    one.act(Gravity((1.0, 0.0, 0.0), 2.0))
    one.start()
    while one.playing:
        time.sleep(0.01)
    assert "stopped" in one.message and "kernel" in one.message
    one.do(one.play)
    time.sleep(0.2)
    assert one.is_alive() and not one.playing
    one.do(one.reset)
    while one.message:
        time.sleep(0.01)
    one.do(one.play)
    while one.interaction.frame_number < 3:
        time.sleep(0.01)
    assert one.interaction.broken is None
    one.stop()
    one.join(5)


def test_time_stands_while_nobody_looks() -> None:
    watched = threading.Event()
    one = Live(make_interaction(), lambda _: None, watched=watched.is_set)
    one.start()
    time.sleep(0.4)
    assert one.interaction.tick == 0
    watched.set()
    while one.interaction.tick < 2:
        time.sleep(0.01)
    one.stop()
    one.join(5)


def test_takes_are_played_in_their_own_time_and_cannot_be_pushed() -> None:
    interaction = make_interaction()
    trajectory = make_interaction()._dynamics.rollout(interaction.state, 5)
    one = Live(interaction, lambda _: None, takes=[Take("Predicted: a", lambda: trajectory)])
    one.choose("Predicted: a")
    with pytest.raises(ConfigError, match=LIVE):
        one.act(Reset())
    for number in range(1, 8):
        one.advance()
        assert one.shown().number == number % 6 and one.shown().last == 5
    assert interaction.tick == 0


def test_a_replay_has_the_gravity_and_the_gusts_of_the_session() -> None:
    recorded = Live(make_interaction(gravity=2.0), lambda _: None)
    recorded.interaction.seed = 3
    recorded.begin()
    recorded.act(Force(Whole(), (1.0, 0, 0), 1.0))
    recorded.act(Wind((0.0, 1.0, 0.0), 1.0, gusts=1.0))
    for _ in range(4):
        recorded.advance()
    one = Live(make_interaction(), lambda _: None)
    one.replay(recorded.interaction.session())
    for _ in range(4):
        one.advance()
    assert torch.equal(one.shown().frame.positions, recorded.interaction.frame.positions)
