"""The simulation thread: commands from the page, playback, the timeline and replayed sessions."""

import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace

from gausim.core import ConfigError, DivergenceError, GausSimError, Trajectory
from gausim.interaction.interaction import Interaction
from gausim.interaction.session import Event, ForceSession
from gausim.viewer.pipeline import Rate
from gausim.viewer.shown import LIVE, Shown, Take, shown_frame

# Largest memory of the live simulation's timeline [bytes].
_HISTORY_BYTES = 128 << 20
_log = logging.getLogger(__name__)


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
        watched: Callable[[], bool] = lambda: True,
    ) -> None:
        """Simulates after :meth:`start`; ``publish`` receives every frame; time advances only while ``watched()``."""
        super().__init__(name="gausim-simulate", daemon=True)
        self.interaction, self.takes = interaction, tuple(takes)
        self._publish, self._watched = publish, watched
        self._commands: queue.Queue[Callable[[], None]] = queue.Queue()
        self._stopping = False
        self.message, self.playing, self.pace, self.source = "", True, 1.0, LIVE
        self.rate = Rate()
        size = 4 * 2 * (interaction.frame.positions.numel() + interaction.frame.deformation_gradients.numel())
        self._history: deque[Shown] = deque(maxlen=max(32, min(3000, _HISTORY_BYTES // size)))
        self._place: int | None = None  # index on the timeline; None: its end, where the live simulation continues
        self._script: ForceSession | None = None  # the session being replayed
        self._loaded: dict[str, Trajectory] = {}
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
            fps = self.interaction.fps if self.source == LIVE else self._loaded[self.source].fps
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
            self._place = ((self._place or 0) + 1) % self._loaded[self.source].frames
            return
        self._place = None
        if self._script is not None:
            while self._pending and self._pending[0].at == self.interaction.tick:
                self.interaction.act(self._pending.popleft().event)
            if self.interaction.tick == self._script.steps:
                self.message = f"The session is over: {self._script.steps} frames."
                self._script, self.playing = None, False
                return
        self.interaction.step()
        self.rate.count()
        self._remember()

    def act(self, event: Event) -> None:
        """Applies an event before the next step.

        Raises:
            ConfigError: a session is being replayed, a take is shown, or the event cannot be applied.
        """
        if self._script is not None:
            raise ConfigError("A session is being played back. Reset to end it, then act.")
        if self.source != LIVE:
            raise ConfigError(f"'{self.source}' is a recording. Choose '{LIVE}' to act on it.")
        self.interaction.act(event)

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
            self.interaction.reset()
            self._start_over()

    def begin(self) -> None:
        """Begins a new session and discards the recorded events."""
        self.message, self._script, self.source = "", None, LIVE
        self.interaction.restart()
        self._start_over()

    def _start_over(self) -> None:
        self._history.clear()
        self._place = None
        self._remember()

    def replay(self, session: ForceSession) -> None:
        """Replays a session from the initial state.

        Raises:
            ConfigError: the session is of another scene or frame rate.
        """
        wrong = session.differences(self.interaction.made_with, self.interaction.fps)
        if any(not allowed for _, allowed in wrong):
            raise ConfigError("session: " + "; ".join(text for text, _ in wrong) + ".")
        self.interaction.gravity, self.interaction.seed = session.gravity, session.seed
        self.begin()
        self._script, self._pending = session, deque(session.entries)
        self.playing = True
        self.message = "Playing a session back" + "".join(f"; {text}, so the motion differs" for text, _ in wrong) + "."

    def choose(self, source: str) -> None:
        """Shows the live simulation or a take, which is computed at its first use."""
        if source != LIVE and source not in self._loaded:
            take = next(t for t in self.takes if t.name == source)
            self._loaded[source] = take.load()
        self.source, self._place, self._script, self.message = source, None, None, ""

    def scrub(self, number: int) -> None:
        """Shows a frame of the timeline and stops time."""
        frames = len(self._history) if self.source == LIVE else self._loaded[self.source].frames
        self.playing, self._place = False, max(0, min(number, frames - 1))

    def _remember(self) -> None:
        self._history.append(Shown.of(self.interaction))

    def shown(self) -> Shown:
        """The shown frame."""
        if self.source != LIVE:
            return shown_frame(self._loaded[self.source], self._place or 0, self.source)
        last = len(self._history) - 1
        place = last if self._place is None else min(self._place, last)
        held = self.interaction.held if bool(self.interaction.held.any()) else None
        return replace(self._history[place], held=held, number=place, last=last)
