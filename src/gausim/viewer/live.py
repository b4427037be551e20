"""The thread that simulates: commands from the page, play and pause, the timeline, sessions played back."""

from __future__ import annotations

import logging
import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch

from gausim.core import ConfigError, DivergenceError, GausSimError, SteppedFrame, Trajectory
from gausim.interaction.interaction import Interaction, differences
from gausim.interaction.session import Entry, Event, ForceSession, Release
from gausim.viewer.companion import Companion
from gausim.viewer.pipeline import Rate
from gausim.viewer.shown import LIVE, Shown

# Commands that wait; more at once come from no hand.
_MOST_COMMANDS = 1024
# Frames of the timeline of the live simulation take at most so much memory [bytes].
_HISTORY_BYTES = 128 << 20
_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Take:
    """A trajectory that can be played: what a method foresees of a sequence.

    Attributes:
        name: what it is called on the page.
        load: makes it, when it is first asked for.
        sequence: the recorded sequence that it foresees, or None.
        beside: makes what the other method foresees of the same, or None.
    """

    name: str
    load: Callable[[], Trajectory]
    sequence: str | None = None
    beside: Callable[[], Trajectory] | None = None


@dataclass(eq=False)
class _Script:
    """A session that is being played back."""

    pending: deque[Entry]
    steps: int
    done: int = 0


@dataclass(eq=False)
class _Recorded:
    """A take that has been loaded."""

    take: Take
    trajectory: Trajectory
    beside: Trajectory | None
    number: int = 0
    fps: float = field(init=False)

    def __post_init__(self) -> None:
        self.fps = self.trajectory.fps

    def shown(self) -> Shown:
        beside = _of(self.beside, self.number, "beside") if self.beside is not None else None
        return _of(self.trajectory, self.number, self.take.name, beside)


class Live(threading.Thread):
    """Runs an interaction, or plays takes; the only thread that touches either.

    Attributes:
        interaction: what is simulated.
        takes: what can be played besides.
        message: what went wrong last, for the page; empty if nothing did.
        playing: whether time goes on.
        pace: speed of time; 1 is real time.
        source: what is shown.
        rate: simulated steps per second.
        seconds: time spent stepping.
        steps: steps made.
    """

    def __init__(
        self,
        interaction: Interaction,
        publish: Callable[[Shown], None],
        *,
        takes: Sequence[Take] = (),
        companion: Companion | None = None,
        watched: Callable[[], bool] = lambda: True,
    ) -> None:
        """Begins to simulate with :meth:`start`.

        Args:
            interaction: what is simulated.
            publish: takes every frame, at once.
            takes: what can be played besides.
            companion: what is simulated beside it.
            watched: whether anybody looks on; time stands while nobody does.
        """
        super().__init__(name="gausim-simulate", daemon=True)
        self.interaction, self.takes, self.companion = interaction, tuple(takes), companion
        self._publish, self._watched = publish, watched
        self._commands: queue.Queue[Callable[[], None]] = queue.Queue(_MOST_COMMANDS)
        self._overrun = self._stopping = False
        self.message, self.playing, self.pace, self.source = "", True, 1.0, LIVE
        self.rate, self.seconds, self.steps = Rate(), 0.0, 0
        frame = interaction.frame
        size = 4 * (2 * frame.positions.numel() + 2 * frame.deformation_gradients.numel())
        self._history: deque[Shown] = deque(maxlen=max(32, min(3000, _HISTORY_BYTES // size)))
        self._place: int | None = None  # on the live timeline; None: its end
        self._script: _Script | None = None
        self._recorded: dict[str, _Recorded] = {}
        self._remember()

    # ------------------------------------------------------------------------------------- from any thread

    def do(self, command: Callable[[], None]) -> None:
        """Has the simulating thread run something; when far too much waits, all forces are let go instead."""
        try:
            self._commands.put_nowait(command)
        except queue.Full:
            self._overrun = True

    def stop(self) -> None:
        """Ends the thread."""
        self._stopping = True

    # ------------------------------------------------------------------------------------- in this thread

    def run(self) -> None:
        """Simulates until :meth:`stop`."""
        self._show()
        due = time.monotonic()
        while not self._stopping:
            going = self.playing and self._watched()
            self._take_commands(0.0 if going else 0.1)
            if not going:
                due = time.monotonic()
                continue
            self._guarded(self.advance)
            self._show()
            due = max(due + 1 / (self._fps * self.pace), time.monotonic() - 0.2)
            self._take_commands(due - time.monotonic())

    @property
    def _fps(self) -> float:
        return self.interaction.fps if self.source == LIVE else self._recorded[self.source].fps

    def _take_commands(self, wait: float) -> None:
        """Runs what waits, for at least so many seconds."""
        end = time.monotonic() + wait
        while not self._stopping:
            left = end - time.monotonic()
            try:
                command = self._commands.get(timeout=left) if left > 0 else self._commands.get_nowait()
            except queue.Empty:
                break
            self._guarded(command)
            if not self.playing:
                self._show()
        if self._overrun:
            self._overrun = False
            self.message = "Too much at once: all forces were let go."
            self._guarded(lambda: self.interaction.act(Release()))

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            work()
        except DivergenceError as error:
            self.playing, self._script = False, None
            self.message = f"The simulation stopped: {error}"
        except GausSimError as error:
            self.message = str(error)
        except Exception as error:  # a defect of ours must not end the page
            self.playing = False
            self.message = f"An error of gausim itself: {error!r}. The simulation is paused."
            _log.exception("the simulation was paused")

    def advance(self) -> None:
        """One frame on."""
        if self.source != LIVE:
            recorded = self._recorded[self.source]
            recorded.number = (recorded.number + 1) % recorded.trajectory.frames
            return
        self._place = None
        script = self._script
        if script is not None:
            self._feed(script)
            if script.done == script.steps:
                self._script, self.playing = None, False
                self.message = f"The session is over: {script.steps} frames."
                return
            script.done += 1
        start = time.perf_counter()
        self.interaction.step()
        self.seconds, self.steps = self.seconds + time.perf_counter() - start, self.steps + 1
        self.rate.count()
        if self.companion is not None:
            self.companion.step()
        self._remember()

    def _feed(self, script: _Script) -> None:
        while script.pending and script.pending[0].at == script.done:
            self._act(script.pending.popleft().event)

    def _act(self, event: Event) -> None:
        self.interaction.act(event)
        if self.companion is not None:
            self.companion.act(event, self.interaction)

    def act(self, event: Event) -> None:
        """Does an event now.

        Raises:
            ConfigError: a session is being played back, a take is shown, or the event cannot be done.
        """
        if self._script is not None:
            raise ConfigError("A session is being played back. Reset to end it, then act.")
        if self.source != LIVE:
            raise ConfigError(f"'{self.source}' is a recording. Choose '{LIVE}' to act on it.")
        self._act(event)

    def play(self) -> None:
        """Time goes on."""
        if self.source == LIVE and self.interaction.broken is not None:
            raise DivergenceError(self.interaction.broken)
        self.playing, self._place = True, None

    def pause(self) -> None:
        """Time stands."""
        self.playing = False

    def step_once(self) -> None:
        """One frame, then time stands."""
        self.playing = False
        self.advance()

    def reset(self) -> None:
        """Back to the beginning of what is shown; ends a session that is played back."""
        self.message, self._script = "", None
        if self.source != LIVE:
            self._recorded[self.source].number = 0
            return
        self.interaction.reset()
        if self.companion is not None:
            self.companion.reset()
        self._forget()

    def begin(self) -> None:
        """A new session: what was recorded is forgotten."""
        self.message, self._script, self.source = "", None, LIVE
        self.interaction.restart()
        if self.companion is not None:
            self.companion.restart()
        self._forget()

    def _forget(self) -> None:
        self._history.clear()
        self._place = None
        self._remember()

    def replay(self, session: ForceSession) -> None:
        """Plays a session back from the initial state.

        Raises:
            ConfigError: it is of another scene or frame rate, or takes longer than is recorded.
        """
        wrong = differences(self.interaction, session)
        if any(not allowed for _, allowed in wrong):
            raise ConfigError("session: " + "; ".join(text for text, _ in wrong) + ".")
        self.begin()
        self.interaction.gravity, self.interaction.seed = session.gravity, session.seed
        self._script = _Script(deque(session.entries), session.steps)
        self.playing = True
        self.message = "Playing a session back" + "".join(f"; {text}, so the motion differs" for text, _ in wrong) + "."

    def choose(self, source: str) -> None:
        """Shows the live simulation or a take, which is made when it is first asked for."""
        if source != LIVE and source not in self._recorded:
            take = next((t for t in self.takes if t.name == source), None)
            if take is None:
                raise ConfigError(f"{source!r}: expected {LIVE!r} or one of {[t.name for t in self.takes]}.")
            beside = take.beside() if take.beside is not None else None
            self._recorded[source] = _Recorded(take, take.load(), beside)
        self.source, self._place, self._script = source, None, None
        self.message = ""

    def scrub(self, number: int) -> None:
        """Shows a frame of the timeline; time stands."""
        self.playing = False
        if self.source == LIVE:
            self._place = max(0, min(number, len(self._history) - 1))
        else:
            recorded = self._recorded[self.source]
            recorded.number = max(0, min(number, recorded.trajectory.frames - 1))

    def set_pace(self, pace: float) -> None:
        """Sets the speed of time; 1 is real time."""
        if not (math.isfinite(pace) and 0.01 <= pace <= 8):
            raise ConfigError(f"speed: expected 0.01 to 8, got {pace}.")
        self.pace = pace

    # ------------------------------------------------------------------------------------- frames

    def _remember(self) -> None:
        now = self.interaction
        held = now.held if bool(now.held.any()) else None
        speed = (now.state.positions - now.state.previous).norm(dim=-1) * now.fps
        beside = self.companion.shown() if self.companion is not None else None
        self._history.append(Shown(now.frame, now.unit_of_kernel, speed, held, beside=beside))

    def _show(self) -> None:
        self._publish(self.shown())

    def shown(self) -> Shown:
        """The frame that is shown."""
        if self.source != LIVE:
            return self._recorded[self.source].shown()
        last = len(self._history) - 1
        place = last if self._place is None else min(self._place, last)
        kept = self._history[place]
        held = self.interaction.held if bool(self.interaction.held.any()) else None
        return Shown(kept.frame, kept.unit_of_kernel, kept.speed, held, place, last, LIVE, kept.beside)


def _of(trajectory: Trajectory, number: int, name: str, beside: Shown | None = None) -> Shown:
    frame = SteppedFrame(
        trajectory.positions[number], trajectory.deformation_gradients[number], trajectory.rotations[number]
    )  # fmt: skip
    before = trajectory.positions[max(0, number - 1)]
    speed = (frame.positions - before).norm(dim=-1) * trajectory.fps
    if not bool(torch.isfinite(frame.positions).all()):
        raise DivergenceError(f"{name}: frame {number} is not finite.")
    return Shown(
        frame, trajectory.unit_of_kernel, speed, None, number, trajectory.frames - 1, name, beside
    )  # fmt: skip
