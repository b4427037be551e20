"""Interactive simulation: forces, wind, gravity and pins on an object, step by step, recorded as a session."""

import math
import random
from collections import deque
from collections.abc import Sequence
from typing import cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gausim import core
from gausim.core import ConfigError, DivergenceError, Frame, SimState, Trajectory
from gausim.interaction import session as events
from gausim.interaction.hands import MovedHands, hand_of
from gausim.interaction.pushes import Push, exposure, scaled
from gausim.interaction.selections import Selected, selection_to_json
from gausim.interaction.session import MOST_EVENTS, MOST_STEPS, Entry, Event, ForceSession, MadeWith
from gausim.ops.deformation import determinant

# In scene units / s^2 for a scene unit of one metre, the default.
STANDARD_GRAVITY = 9.81
# The largest force, and the largest sum of forces on a kernel [weights].
MOST_FORCE = 10.0
# Distance of a kernel from rest at which a simulation has diverged [diagonals].
FARTHEST = 10.0
# |det G| / |G|^3 (Frobenius norm) below which a unit is flattened: G S G^T is singular in float32. Of G = I it is 0.19.
FLATTEST = 1e-6
# Gusts are a sum of waves of these frequencies [Hz].
_GUSTS = (0.35, 0.8, 1.7)


class Interaction:
    """Simulation of one object under forces and pins, with a record of all events; not thread-safe.

    Attributes:
        tick: steps since the session began, the time stamp of recorded events.
        frame_number: steps since the last reset.
        frame: the latest frame.
        held: mask of the kernels pinned by events.
        broken: error message of a diverged simulation; None otherwise.
    """

    def __init__(
        self,
        scene: core.GaussianScene,
        dynamics: core.Steppable,
        masses: Float[Tensor, " K"],
        initial: SimState,
        *,
        made_with: MadeWith,
        units: Sequence[Int[Tensor, " K"]] = (),
        gravity: float = STANDARD_GRAVITY,
        most_force: float = MOST_FORCE,
        seed: int = 0,
        keep: int | None = 0,
        hands: core.Hands | None = None,
    ) -> None:
        """Begins at ``initial`` without forces.

        Args:
            scene: the rest scene.
            dynamics: the simulator of the scene.
            masses: masses of the kernels in the dynamics, up to a common factor.
            initial: the initial state, also after a reset.
            made_with: names and hashes of scene, method and initial state, the header of sessions.
            units: the unit of every kernel at levels 1, 2, ... of the hierarchy; -1 for kernels of no unit.
            gravity: ratio of weight to mass [scene units / s^2].
            most_force: the largest force, and the largest sum of forces on a kernel [weights].
            seed: seed of the gusts of wind.
            keep: number of latest frames kept for :meth:`trajectory`; None keeps all.
            hands: recorded poses of the hands by frame since ``initial``, which each hand follows until it is moved.

        Raises:
            ConfigError: a number is not positive and finite.
        """
        for name, value in (("gravity", gravity), ("most_force", most_force)):
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"interaction: {name}: expected a number > 0, got {value}.")
        self.scene, self.made_with, self.units = scene, made_with, tuple(units)
        self.gravity, self.most_force, self.seed = gravity, most_force, seed
        self._dynamics, self._initial, self._recorded = dynamics, initial, hands
        self.masses = masses.to(initial.positions)
        self._rest = scene.means.to(initial.positions)
        self._free = (scene.simulated & ~scene.pinned).to(self._rest.device)
        self._diagonal = scene.diagonal
        self._exposure = exposure(scene, self.masses, self._free)
        self._frames: deque[Frame] = deque(maxlen=keep)
        self.restart()

    def restart(self) -> None:
        """Begins a new session from the initial state and discards the recorded events."""
        self.tick, self._entries = 0, list[Entry]()
        phases = random.Random(self.seed)
        if isinstance(self._dynamics, core.Adjustable):
            self._dynamics.adjust(1.0, 1.0)
        self._phases = [phases.uniform(0, 2 * math.pi) for _ in _GUSTS]
        self._rest_all()
        self._frames.clear()
        self._frames.append(self.frame)

    def reset(self) -> None:
        """Returns to the initial state without forces, wind, gravity or pins, as an event of the session."""
        self.act(events.Reset())

    def _rest_all(self) -> None:
        self.frame_number, self._limited_before, self._limited_at = 0, 0, cast("int | None", None)
        moves = self._recorded is not None and isinstance(self._dynamics, core.Handled)
        self._hands = MovedHands(self.scene, self._recorded) if moves else None
        self._begin(self._initial)
        self.frame: Frame = self._stepper.frame
        self.broken: str | None = None
        self.held: Bool[Tensor, " K"] = torch.zeros_like(self._free)
        self._forces: dict[str, Push] = {}
        self._impulses: list[Push] = []
        self._steady: events.Gravity | None = None
        self._wind: events.Wind | None = None

    def step(self) -> Frame:
        """The next frame.

        Raises:
            DivergenceError: a position is not finite, a covariance not positive definite, or a kernel too far from
                rest; the message names the kernel and the frame. Only :meth:`reset` continues the simulation.
            ConfigError: the session has the largest number of steps.
        """
        if self.broken is not None:
            raise DivergenceError(self.broken)
        if self.tick >= MOST_STEPS:
            raise ConfigError(f"session: expected at most {MOST_STEPS} steps. Save it and begin another.")
        held = self.held if bool(self.held.any()) else None
        try:
            before = self._stepper.limited
            frame = self._stepper.step(self._force(), held=held)
            self._check(frame)
        except DivergenceError as error:
            self.broken = str(error)
            raise
        self.tick, self.frame_number, self.frame = self.tick + 1, self.frame_number + 1, frame
        if self._stepper.limited > before:
            self._limited_at = self.frame_number
        self._frames.append(frame)
        self._impulses.clear()
        for name, push in list(self._forces.items()):
            if push.left is not None:
                push.left -= 1
                if push.left == 0:
                    del self._forces[name]
        return frame

    @property
    def state(self) -> SimState:
        """The two latest positions of all kernels [scene units]."""
        return self._stepper.state

    @property
    def unit_of_kernel(self) -> Int[Tensor, " K"]:
        """The unit of each kernel, a row of the frames' deformation gradients and rotations."""
        return self._stepper.unit_of_kernel

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self._stepper.fps

    @property
    def limited(self) -> int:
        """Frames since the last reset in which forces were reduced (:attr:`gausim.core.Stepper.limited`)."""
        return self._limited_before + self._stepper.limited

    @property
    def resisting(self) -> bool:
        """Whether forces were reduced within the last second."""
        return self._limited_at is not None and self.frame_number - self._limited_at < self.fps

    @property
    def hand(self) -> Int[Tensor, " K"] | None:
        """The hand that holds each kernel, -1 for none; None where the method moves no hands, or nothing is held."""
        hand, moves = hand_of(self.scene), isinstance(self._dynamics, core.Handled)
        return hand if moves and bool((hand >= 0).any()) else None

    def place_of_hand(self, number: int) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Displacement of a hand from rest [scene units] and its rotation vector [radian]."""
        found = [0.0] * 6 if self._hands is None else self._hands.places(self.frame_number)[number].tolist()
        return tuple(found[:3]), tuple(found[3:])

    def trajectory(self, frames: Sequence[Frame] | None = None) -> Trajectory:
        """The given frames of this session; by default the kept ones, from the initial or from the oldest kept."""
        return core.trajectory_of(frames or self._frames or [self.frame], self._stepper)

    def session(self) -> ForceSession:
        """The session so far, with all recorded events."""
        return ForceSession(self.made_with, self.fps, self.tick, tuple(self._entries), self.gravity, self.seed)

    @property
    def acting(self) -> tuple[str, ...]:
        """Names of the active forces."""
        return tuple(self._forces)

    def pushes(self) -> list[tuple[Float[Tensor, " K"], tuple[float, float, float], str]]:
        """The forces on the next step: weight per kernel, acceleration [scene units / s^2] and kind."""
        found = [(push.mask.to(self._rest), push.acceleration, "force") for push in self._forces.values()]
        found += [(push.mask.to(self._rest), push.acceleration, "impulse") for push in self._impulses]
        if self._steady is not None:
            steady = scaled(self._steady.direction, self._steady.weights * self.gravity)
            found.append((self._free.to(self._rest), steady, "gravity"))
        if self._wind is not None:
            found.append((self._exposure, scaled(self._wind.direction, self._wind_strength() * self.gravity), "wind"))
        return found

    def act(self, event: Event) -> None:
        """Applies an event before the next step, and records it.

        Raises:
            ConfigError: no selected kernel is free, the force is too large, the method takes no forces, or the session
                has the largest number of events.
        """
        if len(self._entries) >= MOST_EVENTS:
            raise ConfigError(f"session: expected at most {MOST_EVENTS} events. Save it and begin another.")
        if not isinstance(event, events.Reset | events.Release) and not self._stepper.takes_forces:
            raise ConfigError(f"{self._method}: takes no forces, only a reset. Play a run of gausim instead.")
        self._do(event)
        self._entries.append(Entry(self.tick, event))

    @property
    def _method(self) -> str:
        return self.made_with.run or "this method"

    def _do(self, event: Event) -> None:
        match event:
            case events.Force():
                push = self._push(event.on, event.direction, self._allowed("weights", event.weights), event.frames)
                self._forces[event.name] = push
            case events.Impulse():
                weights = self._allowed("weight_seconds", event.weight_seconds, per=self.fps)
                self._impulses.append(self._push(event.on, event.direction, weights, 1))
            case events.Release():
                for name in [event.name] if event.name is not None else list(self._forces):
                    self._forces.pop(name, None)
            case events.Gravity():
                self._allowed("weights", event.weights)
                self._steady = event if event.weights > 0 else None
            case events.Wind():
                self._allowed("weights", event.weights)
                self._wind = event if event.weights > 0 else None
            case events.Pin():
                self.held = self.held | self._movable(event.on)
            case events.Unpin():
                self.held = self.held & ~event.on.mask(self.scene, self.units).to(self.held.device)
            case events.Hand():
                self._move_hand(event)
            case events.Material():
                self._adjust(event)
            case events.Reset():
                self._rest_all()

    def _move_hand(self, event: events.Hand) -> None:
        """Moves a hand; the first one to move makes a stepper whose pins can, from the current state on."""
        if self.hand is None:
            raise ConfigError(f"{self._method}: nothing of '{self.scene.name}' is held by a hand that it can move.")
        if self._hands is None:
            self._hands = MovedHands(self.scene)
            self._go_on()
        self._hands.move(event, self.frame_number)

    def _go_on(self) -> None:
        """Goes on from the current state with a new stepper."""
        self._limited_before += self._stepper.limited
        self._begin(self.state)

    def _begin(self, state: SimState) -> None:
        """Makes a stepper at a state, with the hands if anything has moved them."""
        hands, begin = self._hands, self.frame_number
        if hands is not None and isinstance(self._dynamics, core.Handled):
            self._stepper = self._dynamics.stepper(state, lambda frame: hands.pose(frame + begin))
        else:
            self._stepper = self._dynamics.stepper(state)

    @property
    def adjustable(self) -> bool:
        """Whether the material can be changed."""
        return isinstance(self._dynamics, core.Adjustable)

    def _adjust(self, event: events.Material) -> None:
        if not isinstance(self._dynamics, core.Adjustable):
            raise ConfigError(f"{self._method}: its material cannot be set. Take a run of model=gausim, or a scene.")
        self._dynamics.adjust(event.stiffness, event.damping)
        self._go_on()

    def _allowed(self, name: str, amount: float, *, per: float = 1.0) -> float:
        """``amount * per``, a force in weights, or an error if it exceeds the largest force."""
        if not amount * per <= self.most_force:
            raise ConfigError(
                f"field '{name}': expected at most {self.most_force / per:g} (a force of {self.most_force:g} weights), "
                f"got {amount:g}."
            )
        return amount * per

    def _movable(self, on: Selected) -> Bool[Tensor, " K"]:
        mask = on.mask(self.scene, self.units).to(self._free.device) & self._free
        if not bool(mask.any()):
            raise ConfigError(
                f"selection {selection_to_json(on)}: expected kernels that can move, got only pinned ones."
            )
        return mask

    def _push(self, on: Selected, direction: tuple[float, float, float], weights: float, frames: int | None) -> Push:
        return Push(self._movable(on), scaled(direction, weights * self.gravity), frames)

    def _force(self) -> Float[Tensor, "K 3"] | None:
        """Total force on every kernel [mass scene units / s^2]; None without forces."""
        pushes = self.pushes()
        if not pushes:
            return None
        acceleration = torch.zeros_like(self._rest)
        for amount, vector, _ in pushes:
            acceleration += amount[:, None] * acceleration.new_tensor(vector)
        most = self.most_force * self.gravity
        acceleration *= (most / acceleration.norm(dim=-1, keepdim=True).clamp_min(most)).clamp_max(1.0)
        return acceleration * (self.masses * (self._free & ~self.held))[:, None]

    def _wind_strength(self) -> float:
        """Current strength of the wind, gusts included [weights]."""
        assert self._wind is not None
        seconds = self.tick / self.fps
        waves = (math.sin(2 * math.pi * f * seconds + p) for f, p in zip(_GUSTS, self._phases, strict=True))
        return self._wind.weights * (1 + self._wind.gusts * sum(waves) / len(_GUSTS))

    def _check(self, frame: Frame) -> None:
        away = (frame.positions - self._rest).norm(dim=-1) / self._diagonal
        gone = ~(away <= FARTHEST)  # also NaN
        if bool(gone.any()):
            kernel = int(gone.nonzero()[0])
            far = f"{float(away[kernel]):.3g} diagonals from rest, expected at most {FARTHEST:g}"
            raise self._diverged(f"kernel {kernel} is {far}")
        g = frame.deformation_gradients.double()
        flat = ~(determinant(g).abs() / g.square().sum((-2, -1)).pow(1.5) >= FLATTEST)
        carried = flat[self.unit_of_kernel]
        if bool(carried.any()):
            kernel = int(carried.nonzero()[0])
            unit = int(self.unit_of_kernel[kernel])
            raise self._diverged(
                f"the covariance of kernel {kernel} is not positive definite (its unit {unit} is flattened)"
            )

    def _diverged(self, what: str) -> DivergenceError:
        return DivergenceError(
            f"{self.scene.name}: at frame {self.frame_number + 1} {what}. Reset, and use smaller forces."
        )
