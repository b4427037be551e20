"""The simulation thread: commands from the page, playback, the timeline and replayed sessions."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace

import msgspec

from gausim.core import ConfigError, DivergenceError, GausSimError, Trajectory
from gausim.interaction.interaction import Interaction
from gausim.interaction.selections import Kernels, Unit
from gausim.interaction.session import Event, ForceSession
from gausim.viewer.pipeline import Rate
from gausim.viewer.shown import LIVE, Shown, Take, shown_frame

# Largest memory of the live simulation's timeline [bytes].
_HISTORY_BYTES = 128 << 20
_log = logging.getLogger(__name__)


class Companion:
    """A second method beside the first: an interaction that repeats the events of another one.

    Attributes:
        name: name on the page.
        interaction: the simulation.
        message: error that stopped it or rejected an event; empty without an error.
    """

    def __init__(self, name: str, interaction: Interaction) -> None:
        self.name, self.interaction, self.message = name, interaction, ""

    def act(self, event: Event, leader: Interaction) -> None:
        """Applies an event of the leader; units become lists of kernels, as the hierarchies differ."""
        on = getattr(event, "on", None)
        if isinstance(on, Unit):
            chosen = on.mask(leader.scene, leader.units).nonzero()[:, 0].tolist()
            event = msgspec.structs.replace(event, on=Kernels(tuple(chosen)))
        try:
            self.interaction.act(event)
            self.message = ""
        except ConfigError as error:
            self.message = str(error)

    def step(self) -> None:
        """Simulates one frame, unless the simulation has diverged."""
        try:
            if self.interaction.broken is None:
                self.interaction.step()
        except (DivergenceError, ConfigError) as error:
            self.message = str(error)


class Live(threading.Thread):
    """Thread that runs an interaction or plays takes; no other thread accesses them.

    Attributes:
        interaction: the simulation.
        takes: recordings that can be played.
        message: last message for the page, empty without one.
        playing: whether time advances.
        pace: speed relative to real time.
        source: the shown source: :data:`LIVE` or the name of a take.
        rate: simulated steps per second.
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
        """Simulates after :meth:`start`; ``publish`` receives every frame; time advances only while ``watched()``."""
        super().__init__(name="gausim-simulate", daemon=True)
        self.interaction, self.takes, self.companion = interaction, tuple(takes), companion
        self._publish, self._watched = publish, watched
        self._commands: queue.Queue[Callable[[], None]] = queue.Queue()
        self._stopping = False
        self.message, self.playing, self.pace, self.source = "", True, 1.0, LIVE
        self.rate = Rate()
        size = 4 * 2 * (interaction.frame.positions.numel() + interaction.frame.deformation_gradients.numel())
        self._history: deque[Shown] = deque(maxlen=max(32, min(3000, _HISTORY_BYTES // size)))
        self._place: int | None = None  # index on the timeline; None: its end, where the live simulation continues
        self._script: ForceSession | None = None  # the session being replayed
        self._loaded: dict[str, tuple[Trajectory, Trajectory | None]] = {}
        self._remember()

    def do(self, command: Callable[[], None]) -> None:
        """Queues a command for this thread."""
        self._commands.put(command)

    def stop(self) -> None:
        """Ends the thread."""
        self._stopping = True

    def run(self) -> None:
        """Simulates until :meth:`stop`."""
        self._publish(self.shown())
        due = time.monotonic()
        while not self._stopping:
            going = self.playing and self._watched()
            self._take_commands(0.0 if going else 0.1)
            if not going:
                due = time.monotonic()
                continue
            self._guarded(self.advance)
            self._publish(self.shown())
            fps = self.interaction.fps if self.source == LIVE else self._loaded[self.source][0].fps
            due = max(due + 1 / (fps * self.pace), time.monotonic() - 0.2)
            self._take_commands(due - time.monotonic())

    def _take_commands(self, wait: float) -> None:
        """Runs queued commands, for at least ``wait`` seconds."""
        end = time.monotonic() + wait
        while not self._stopping:
            left = end - time.monotonic()
            try:
                command = self._commands.get(timeout=left) if left > 0 else self._commands.get_nowait()
            except queue.Empty:
                break
            self._guarded(command)
            if not self.playing:
                self._publish(self.shown())

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            work()
        except DivergenceError as error:
            self.playing, self._script = False, None
            self.message = f"The simulation stopped: {error}"
        except GausSimError as error:
            self.message = str(error)
        except Exception as error:  # a defect of gausim must not end the page
            self.playing = False
            self.message = f"An error of gausim itself: {error!r}. The simulation is paused."
            _log.exception("the simulation was paused")

    def advance(self) -> None:
        """Advances the shown source by one frame."""
        if self.source != LIVE:
            self._place = ((self._place or 0) + 1) % self._loaded[self.source][0].frames
            return
        self._place = None
        if self._script is not None:
            while self._pending and self._pending[0].at == self.interaction.tick:
                self._act(self._pending.popleft().event)
            if self.interaction.tick == self._script.steps:
                self.message = f"The session is over: {self._script.steps} frames."
                self._script, self.playing = None, False
                return
        self.interaction.step()
        self.rate.count()
        if self.companion is not None:
            self.companion.step()
        self._remember()

    def _act(self, event: Event) -> None:
        self.interaction.act(event)
        if self.companion is not None:
            self.companion.act(event, self.interaction)

    def act(self, event: Event) -> None:
        """Applies an event before the next step.

        Raises:
            ConfigError: a session is being replayed, a take is shown, or the event cannot be applied.
        """
        if self._script is not None:
            raise ConfigError("A session is being played back. Reset to end it, then act.")
        if self.source != LIVE:
            raise ConfigError(f"'{self.source}' is a recording. Choose '{LIVE}' to act on it.")
        self._act(event)

    def play(self) -> None:
        """Lets time advance.

        Raises:
            DivergenceError: the simulation has diverged and needs a reset.
        """
        if self.source == LIVE:
            if self.interaction.broken is not None:
                raise DivergenceError(self.interaction.broken)
            self._place = None
        self.playing = True

    def pause(self) -> None:
        """Stops time."""
        self.playing = False

    def step_once(self) -> None:
        """Advances by one frame, then stops time."""
        self.playing = False
        self.advance()

    def reset(self) -> None:
        """Returns to the beginning of the shown source and ends a replay."""
        self.message, self._script, self._place = "", None, None
        if self.source == LIVE:
            self._begin(Interaction.reset)

    def begin(self) -> None:
        """Begins a new session and discards the recorded events."""
        self.message, self._script, self.source = "", None, LIVE
        self._begin(Interaction.restart)

    def _begin(self, how: Callable[[Interaction], None]) -> None:
        for one in self._both():
            how(one)
        if self.companion is not None:
            self.companion.message = ""
        self._history.clear()
        self._place = None
        self._remember()

    def _both(self) -> list[Interaction]:
        """The simulation, and that of the companion if there is one."""
        return [self.interaction] if self.companion is None else [self.interaction, self.companion.interaction]

    def replay(self, session: ForceSession) -> None:
        """Replays a session from the initial state.

        Raises:
            ConfigError: the session is of another scene or frame rate.
        """
        wrong = session.differences(self.interaction.made_with, self.interaction.fps)
        if any(not allowed for _, allowed in wrong):
            raise ConfigError("session: " + "; ".join(text for text, _ in wrong) + ".")
        for one in self._both():
            one.gravity, one.seed = session.gravity, session.seed
        self.begin()
        self._script, self._pending = session, deque(session.entries)
        self.playing = True
        self.message = "Playing a session back" + "".join(f"; {text}, so the motion differs" for text, _ in wrong) + "."

    def choose(self, source: str) -> None:
        """Shows the live simulation or a take, which is computed at its first use."""
        if source != LIVE and source not in self._loaded:
            take = next(t for t in self.takes if t.name == source)
            self._loaded[source] = take.load(), take.beside() if take.beside is not None else None
        self.source, self._place, self._script, self.message = source, None, None, ""

    def scrub(self, number: int) -> None:
        """Shows a frame of the timeline and stops time."""
        frames = len(self._history) if self.source == LIVE else self._loaded[self.source][0].frames
        self.playing, self._place = False, max(0, min(number, frames - 1))

    def _remember(self) -> None:
        beside = Shown.of(self.companion.interaction) if self.companion is not None else None
        self._history.append(Shown.of(self.interaction, beside))

    def shown(self) -> Shown:
        """The shown frame."""
        if self.source != LIVE:
            first, second = self._loaded[self.source]
            place = self._place or 0
            beside = shown_frame(second, place, "beside") if second is not None else None
            return shown_frame(first, place, self.source, beside)
        last = len(self._history) - 1
        place = last if self._place is None else min(self._place, last)
        held = self.interaction.held if bool(self.interaction.held.any()) else None
        return replace(self._history[place], held=held, number=place, last=last)
