"""The thread that simulates: commands from the page, play and pause, the timeline, sessions played back."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace

from gausim.core import ConfigError, DivergenceError, GausSimError, Trajectory
from gausim.interaction.interaction import Interaction, differences
from gausim.interaction.session import Event, ForceSession, Release
from gausim.viewer.companion import Companion
from gausim.viewer.pipeline import Rate
from gausim.viewer.shown import LIVE, Shown, Take, shown_frame

# Commands that wait; more at once come from no hand.
_MOST_COMMANDS = 1024
# Frames of the timeline of the live simulation take at most so much memory [bytes].
_HISTORY_BYTES = 128 << 20
_log = logging.getLogger(__name__)


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
        """Begins to simulate with :meth:`start`; ``publish`` takes every frame; time stands unless ``watched()``."""
        super().__init__(name="gausim-simulate", daemon=True)
        self.interaction, self.takes, self.companion = interaction, tuple(takes), companion
        self._publish, self._watched = publish, watched
        self._commands: queue.Queue[Callable[[], None]] = queue.Queue(_MOST_COMMANDS)
        self._overrun = self._stopping = False
        self.message, self.playing, self.pace, self.source = "", True, 1.0, LIVE
        self.rate = Rate()
        size = 4 * 2 * (interaction.frame.positions.numel() + interaction.frame.deformation_gradients.numel())
        self._history: deque[Shown] = deque(maxlen=max(32, min(3000, _HISTORY_BYTES // size)))
        self._place: int | None = None  # on the timeline; None: its end, where the live simulation goes on
        self._script: ForceSession | None = None  # a session that is played back
        self._loaded: dict[str, tuple[Trajectory, Trajectory | None]] = {}
        self._remember()

    def do(self, command: Callable[[], None]) -> None:
        """Has the simulating thread run something; when far too much waits, all forces are let go instead."""
        try:
            self._commands.put_nowait(command)
        except queue.Full:
            self._overrun = True

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
                self._publish(self.shown())
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
        """Time goes on.

        Raises:
            DivergenceError: the simulation broke; only a reset helps.
        """
        if self.source == LIVE:
            if self.interaction.broken is not None:
                raise DivergenceError(self.interaction.broken)
            self._place = None
        self.playing = True

    def pause(self) -> None:
        """Time stands."""
        self.playing = False

    def step_once(self) -> None:
        """One frame, then time stands."""
        self.playing = False
        self.advance()

    def reset(self) -> None:
        """Back to the beginning of what is shown; ends a session that is played back."""
        self.message, self._script, self._place = "", None, None
        if self.source == LIVE:
            self._begin(Interaction.reset)

    def begin(self) -> None:
        """A new session: what was recorded is forgotten."""
        self.message, self._script, self.source = "", None, LIVE
        self._begin(Interaction.restart)

    def _begin(self, how: Callable[[Interaction], None]) -> None:
        how(self.interaction)
        if self.companion is not None:
            how(self.companion.interaction)
            self.companion.message = ""
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
        self.interaction.gravity, self.interaction.seed = session.gravity, session.seed
        self.begin()
        self._script, self._pending = session, deque(session.entries)
        self.playing = True
        self.message = "Playing a session back" + "".join(f"; {text}, so the motion differs" for text, _ in wrong) + "."

    def choose(self, source: str) -> None:
        """Shows the live simulation or a take, which is made when it is first asked for."""
        if source != LIVE and source not in self._loaded:
            take = next(t for t in self.takes if t.name == source)
            self._loaded[source] = take.load(), take.beside() if take.beside is not None else None
        self.source, self._place, self._script, self.message = source, None, None, ""

    def scrub(self, number: int) -> None:
        """Shows a frame of the timeline; time stands."""
        frames = len(self._history) if self.source == LIVE else self._loaded[self.source][0].frames
        self.playing, self._place = False, max(0, min(number, frames - 1))

    def _remember(self) -> None:
        beside = Shown.of(self.companion.interaction) if self.companion is not None else None
        self._history.append(Shown.of(self.interaction, beside))

    def shown(self) -> Shown:
        """The frame that is shown."""
        if self.source != LIVE:
            first, second = self._loaded[self.source]
            place = self._place or 0
            beside = shown_frame(second, place, "beside") if second is not None else None
            return shown_frame(first, place, self.source, beside)
        last = len(self._history) - 1
        place = last if self._place is None else min(self._place, last)
        held = self.interaction.held if bool(self.interaction.held.any()) else None
        return replace(self._history[place], held=held, number=place, last=last)
