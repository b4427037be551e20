"""Stepping is the rollout, forces and hands do what they say, sessions replay bit for bit, divergence stops."""

import math
from dataclasses import replace

import pytest
import torch
from helpers.column import make_column, make_interaction, make_simulator, steps
from msgspec.structs import replace as changed

from gausim.core import ConfigError, DataError, DivergenceError, Frame, HandPath, SimState, Steppable, Stepper
from gausim.interaction import session as do
from gausim.interaction.hands import MovedHands
from gausim.interaction.interaction import Interaction
from gausim.interaction.replay import replay
from gausim.interaction.selections import Ball, Kernels, Unit, Whole
from gausim.interaction.session import Force, Gravity, Hand, Impulse, Pin, Release, Reset, Unpin, Wind
from gausim.models.rollout.dynamics import SceneDynamics
from gausim.ops.rotation import rotation_of

X, Y, UP = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def same(a, b) -> bool:
    names = ("positions", "deformation_gradients", "rotations", "unit_of_kernel")
    return all(torch.equal(getattr(a, n), getattr(b, n)) for n in names) and a.fps == b.fps


@pytest.mark.parametrize("passive", [0, 6])
def test_stepping_is_the_rollout_bit_for_bit(passive) -> None:
    scene = make_column()
    dynamics = SceneDynamics(make_simulator(scene, passive=passive))
    assert isinstance(dynamics, Steppable)
    initial = SimState(scene.means, scene.means - torch.tensor([0.004, 0, 0]) * scene.means[:, 2:])
    force = torch.randn(scene.count, 3, generator=torch.Generator().manual_seed(0))
    whole = dynamics.rollout(initial, 12, forces=lambda n: force if 3 <= n < 5 else None)
    stepper = dynamics.stepper(initial)
    assert isinstance(stepper, Stepper) and torch.equal(stepper.frame.positions, initial.positions)
    for n in range(12):
        frame = stepper.step(force if 3 <= n < 5 else None)
        assert torch.equal(frame.positions, whole.positions[n + 1])
        assert torch.equal(frame.deformation_gradients, whole.deformation_gradients[n + 1])
        assert torch.equal(frame.rotations, whole.rotations[n + 1])
    assert torch.equal(stepper.state.previous, whole.positions[11])
    assert float((whole.positions[-1] - scene.means).abs().max()) > 1e-3


def play(live: Interaction) -> None:
    """Every kind of event, a divergence excepted."""
    todo = {
        0: [Force(Ball((0.3, 0.3, 1.2), 0.3), X, 2.0, name="drag"), Gravity((0.0, -1.0, 0.0), 0.3)],
        2: [Force(Unit(1, 0), (0.3, 1.0, 0.0), 1.5, frames=3, name="tap"), Wind(Y, 0.7, gusts=0.8)],
        4: [Release("drag"), Impulse(Whole(), (-1.0, 0.2, 0.0), 0.05)],
        6: [Pin(Kernels(tuple(range(60, 70)))), Force(Kernels((61, 80, 81, 85)), UP, 3.0)],
        9: [Unpin(), Release()],
        12: [Reset(), Impulse(Unit(2, 0), X, 0.1)],
    }
    for tick in range(16):
        for event in todo.get(tick, ()):
            live.act(event)
        live.step()
    live.act(Gravity(X, 0.0))


def test_a_session_is_replayed_bit_for_bit() -> None:
    live = make_interaction(keep=None, seed=3)
    play(live)
    recorded, session = live.trajectory(), live.session()
    assert recorded.frames == 17 and len(session.entries) == 13 and session.steps == 16
    assert len({e.event.__class__ for e in session.entries}) == 8
    fresh = make_interaction(seed=3)
    assert same(replay(fresh, session), recorded)
    assert fresh.session() == session
    assert same(replay(live, session), recorded)  # the same one again
    moved = (recorded.positions - recorded.positions[0]).norm(dim=-1).amax(1)
    assert float(moved[3]) > 1e-3 and float(moved[13]) < float(moved[12])


def test_replay_wants_what_the_session_was_made_with() -> None:
    live = make_interaction()
    live.act(Force(Whole(), X, 1.0))
    live.step()
    session = live.session()
    other = changed(session, made_with=changed(session.made_with, model_hash="0", run="elsewhere"))
    with pytest.raises(DataError, match="another method or training .run 'elsewhere'"):
        replay(live, other)
    assert same(replay(live, other, other_model=True), replay(live, session))
    for wrong in (
        changed(session, made_with=changed(session.made_with, scene_hash="0", scene="cup")),
        changed(session, fps=30.0),
    ):
        with pytest.raises(DataError, match="another scene, 'cup' and not 'column'|30 frames per second and not 24"):
            replay(live, wrong, other_model=True)
    assert make_interaction(seed=1).made_with.model_hash != session.made_with.model_hash
    live.frame = replace(live.frame, positions=torch.zeros(1, 1).expand(1 << 30, 3))
    with pytest.raises(DataError, match="frames take 12 GiB, expected at most 8"):
        replay(live, session)


def test_a_force_is_a_multiple_of_the_weight() -> None:
    """On free matter, f = w m g for n steps moves it as w g does in n frames: Verlet's x, exactly."""
    scene = make_column()

    class Free:
        fps, unit_of_kernel, takes_forces, limited = 24.0, torch.zeros(scene.count, dtype=torch.long), True, 0

        def __init__(self, initial: SimState) -> None:
            self.state, self._eye = initial, torch.eye(3)[None]
            self.frame = Frame(initial.positions, self._eye, self._eye)

        def step(self, force=None, *, held=None):
            x, before = self.state.positions, self.state.previous
            shift = torch.zeros_like(x) if force is None else force / (2 * masses[:, None] * self.fps**2)
            new = 2 * (x + shift) - before
            new = torch.where(held[:, None], x, new) if held is not None else new
            self.state = SimState(new, x)
            self.frame = Frame(new, self._eye, self._eye)
            return self.frame

        def settle(self) -> None: ...

        def stepper(self, initial: SimState):
            return Free(initial)

        def rollout(self, initial, steps, *, forces=None):
            raise NotImplementedError

    masses = torch.linspace(0.5, 2, scene.count)
    initial = SimState(scene.means, scene.means)
    made = do.MadeWith.of(scene, None, initial)
    live = Interaction(scene, Free(initial), masses, initial, made_with=made, gravity=2.0)
    free = scene.simulated & ~scene.pinned
    dt = 1 / 24

    def shift() -> torch.Tensor:
        return live.frame.positions - scene.means

    live.act(Force(Whole(), (0.0, 3.0, 4.0), 1.5, frames=2))
    steps(live, 3)
    a = 1.5 * 2.0 * torch.tensor([0.0, 0.6, 0.8])
    # after steps 1, 2 (pushed) and 3 (free): a dt^2 (1 + 2 + 2)
    assert torch.allclose(shift()[free], (5 * a * dt**2).expand(int(free.sum()), 3), rtol=1e-3, atol=1e-6)
    assert torch.equal(shift()[~free], torch.zeros(int((~free).sum()), 3)) and live.acting == ()

    live.reset()
    live.act(Impulse(Whole(), X, 0.1))
    steps(live, 4)
    assert torch.allclose(shift()[free][:, 0], torch.tensor(4 * 0.1 * 2.0 * dt), rtol=1e-3)

    live.reset()
    live.act(Wind(X, 0.5))
    live.act(Gravity((0.0, 0.0, -1.0), 2.0))
    live.step()
    mass = masses * free
    mean = (mass[:, None] * shift()).sum(0) / mass.sum()
    assert torch.allclose(mean, torch.tensor([0.5, 0.0, -2.0]) * 2.0 * dt**2, rtol=1e-3, atol=1e-7)
    assert float(shift()[free][:, 0].std()) > 1e-5  # small kernels are blown further

    live.reset()
    on = Kernels((50, 51))
    for name in "abcde":
        live.act(Force(on, X, 9.0, name=name))
    live.step()  # the sum is cut at ten weights
    assert torch.allclose(shift()[50], torch.tensor([10 * 2.0 * dt**2, 0, 0]), rtol=1e-3, atol=1e-6)
    live.act(Force(on, X, 0.0, name="a"))
    live.act(Release("e"))
    assert live.acting == ("a", "b", "c", "d")

    live.reset()
    live.act(Pin(on))
    live.act(Force(Whole(), X, 1.0))
    live.step()
    assert torch.equal(shift()[50:52], torch.zeros(2, 3)) and float(shift()[52].norm()) > 0
    live.act(Unpin(Kernels((50,))))
    live.step()
    assert float(shift()[50].norm()) > 0 and torch.equal(shift()[51], torch.zeros(3))


def test_pinned_kernels_never_move() -> None:
    live = make_interaction(keep=4)
    pinned, held = live.scene.pinned | ~live.scene.simulated, Kernels(tuple(range(70, 80)))
    live.act(Gravity(X, 1.0))
    steps(live, 4)
    kept = live.trajectory()  # the latest frames only
    assert kept.frames == 4 and torch.equal(kept.positions[-1], live.frame.positions)
    live.act(Pin(held))
    where = live.frame.positions[70:80].clone()
    live.act(Force(Whole(), Y, 3.0))
    for _ in range(4):
        live.step()
        assert torch.equal(live.frame.positions[70:80], where)
        assert torch.equal(live.frame.positions[pinned], live.scene.means[pinned])
    assert float((where - live.scene.means[70:80]).norm(dim=-1).median()) > 1e-3
    live.restart()
    assert live.trajectory().frames == 1 and live.tick == 0 and live.session().entries == ()


def test_what_cannot_be_done_is_refused_and_not_recorded() -> None:
    live = make_interaction()
    foot = Kernels(tuple(live.scene.pinned.nonzero()[:, 0].tolist()))
    for event, message in (
        (Force(foot, X, 1.0), "expected kernels that can move, got only pinned"),
        (Force(Whole(), X, 10.5), "'weights': expected at most 10 "),
        (Impulse(Whole(), X, 0.42), r"'weight_seconds': expected at most 0.416667"),
        (Gravity(X, 11.0), "at most 10"),
        (Wind(X, 11.0), "at most 10"),
        (Pin(Kernels((90,))), "kernel 90: 'column' has kernels 0 to 89"),
        (Force(Unit(3, 0), X, 1.0), "level 3: 'column' has levels 0 to 2"),
        (Force(Unit(1, 999), X, 1.0), "unit 999: level 1 of 'column' has units 0 to"),
        (Force(Ball((9.0, 9.0, 9.0), 0.1), X, 1.0), "no kernel of 'column' lies within 0.1 diagonals"),
        (do.Material(2.0), "its material cannot be set. Take a run of model=gausim"),
    ):
        with pytest.raises(ConfigError, match=message):
            live.act(event)
    assert live.session().entries == () and live.acting == ()


def test_it_says_that_forces_act_in_part() -> None:
    live = make_interaction(ceiling=1e-5)
    live.act(Force(Whole(), (1.0, 0.0, 0.0), 0.01, frames=2))
    live.step()
    assert live.limited == 0 and not live.resisting
    live.act(Force(Whole(), (1.0, 0.0, 0.0), 10.0, frames=8))
    steps(live, 8)
    assert 0 < live.limited <= 8 and live.resisting
    steps(live, 24)
    live.reset()
    assert live.limited == 0 and not live.resisting


class Broken:
    """Breaks in the second step, in one of several ways."""

    def __init__(self, live: Interaction, how: str) -> None:
        self._inner, self._how, self._steps = live._stepper, how, 0
        self.unit_of_kernel = live.unit_of_kernel

    def __getattr__(self, name: str) -> object:
        return getattr(self._inner, name)

    def step(self, force=None, *, held=None):
        frame, self._steps = self._inner.step(force, held=held), self._steps + 1
        if self._steps < 2:
            return frame
        positions, deformation_gradients = frame.positions.clone(), frame.deformation_gradients.clone()
        if self._how == "nan":
            positions[33, 1] = math.nan
        elif self._how == "far":
            positions[33, 1] += 20
        else:
            third = 0.0 if self._how == "flat" else math.inf
            deformation_gradients[self.unit_of_kernel[33]] *= torch.tensor([1.0, 1.0, third])
        return replace(frame, positions=positions, deformation_gradients=deformation_gradients)


@pytest.mark.parametrize(("how", "message"), [
    ("nan", "column: at frame 2 kernel 33 is nan diagonals from rest"),
    ("far", "column: at frame 2 kernel 33 is .* diagonals from rest, expected at most 10"),
    ("flat", "at frame 2 the covariance of kernel .* is not positive definite"),
    ("inf", "at frame 2 the covariance of kernel .* is not positive definite"),
])  # fmt: skip
def test_divergence_stops_until_a_reset(how, message) -> None:
    live = make_interaction(keep=None)
    live._stepper = Broken(live, how)
    live.step()
    good = live.frame
    for _ in range(2):
        with pytest.raises(DivergenceError, match=message):
            live.step()
    assert live.broken is not None and live.tick == 1 and live.frame is good
    live.reset()
    assert live.broken is None and live.frame_number == 0
    live.step()
    assert live.trajectory().frames == 3 and torch.isfinite(live.trajectory().positions).all()
    assert same(replay(make_interaction(), live.session()), live.trajectory())


TO = (0.2, -0.1, 0.0)


def test_pins_go_where_the_hand_goes_and_the_body_follows() -> None:
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


def _nodding(frames: int = 8) -> HandPath:
    """A hand of four points that shifts and turns."""
    points = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    poses = [(points @ rotation_of(torch.tensor([0.0, 0.05 * f, 0.0])).mT) + 0.02 * f for f in range(frames)]
    return HandPath.of(torch.stack(poses), torch.zeros(4, dtype=torch.long))


def test_a_session_follows_recorded_hands_until_the_user_takes_over() -> None:
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


def test_a_hand_that_is_moved_leaves_the_others_to_the_recording() -> None:
    scene = make_column()
    pins = scene.pinned.nonzero()[:, 0]
    hand = torch.full((scene.count,), -1).index_copy(0, pins, torch.arange(len(pins)) % 2)
    points = torch.stack([torch.tensor([[0.0, 0, 0], [1.0, 0, 0]]) + 0.1 * f for f in range(6)])
    path = HandPath.of(points, torch.tensor([0, 1]))
    hands = MovedHands(replace(scene, hand=hand), path.pose)
    assert hands.pose(2) is path.pose(2)
    hands.move(Hand(to=(1.0, 0.0, 0.0), hand=1, frames=2), 2)
    torch.testing.assert_close(hands.places(1)[:, :3], torch.full((2, 3), 0.1).double(), atol=1e-6, rtol=0)
    expected = torch.tensor([[0.4] * 3, [1.0, 0, 0]]).double()
    torch.testing.assert_close(hands.places(4)[:, :3], expected, atol=1e-6, rtol=0)
    assert hands.pose(4) is hands.pose(4)
