"""The control panel of the page."""

import html
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

from gausim.interaction.selections import Selected
from gausim.interaction.session import (
    Event,
    Gravity,
    Hand,
    Impulse,
    Material,
    Pin,
    Release,
    Unpin,
    Wind,
    parse_session,
    save_session,
)
from gausim.interaction.words import parse_direction
from gausim.viewer.coloring import VIEW, Legend, Painter, gradient_css
from gausim.viewer.live import Live
from gausim.viewer.pointer import HAND_SECONDS, Pointer
from gausim.viewer.shown import LIVE, Shown
from gausim.viewer.subject import Subject

AXES = ("+x", "-x", "+y", "-y", "+z", "-z")
# Message while forces are reduced.
_AT_LIMIT = "At the limit of what was learned: the forces act only in part. Pull less for what would really happen."
# Largest refresh rate of the panel [1 / s].
_REFRESHES = 4.0
# Largest displacement of a hand by its sliders [diagonals].
_HAND_REACH = 0.5


class Page:
    """The controls of one viewer.

    Attributes:
        mode: colour mode of the kernels.
        saved: paths of the saved sessions, in order.
    """

    def __init__(
        self, server: Any, live: Live, pointer: Pointer, subject: Subject, painter: Painter, repaint: Callable[[], None]
    ) -> None:
        """Builds the panel; ``repaint`` requests new colours of the shown frame."""
        self._live, self._pointer, self._subject = live, pointer, subject
        self._repaint, self._painter = repaint, painter
        self.mode, self.saved, self._refreshed = VIEW, list[Path](), 0.0
        gui = server.gui
        self._status = gui.add_html("")
        tabs = gui.add_tab_group()
        works = {"Play": self._play_tab, "Push": self._push_tab, "Look": self._look_tab, "Session": self._session_tab}
        for name, build in works.items():
            with tabs.add_tab(name):
                build(gui)
        pointer.notice = self._selected

    def _play_tab(self, gui: Any) -> None:
        live = self._live
        gui.add_html(f"<div style='padding:0 .6em;font-size:.85em'><b>{html.escape(self._subject.title)}</b></div>")
        sources = (LIVE, *(take.name for take in live.takes))
        self._source = gui.add_dropdown("Shows", sources, initial_value=LIVE, hint="Recordings cannot be pushed.")
        self._on_change(self._source, lambda name: live.do(lambda: live.choose(name)))
        works = {"Play": live.play, "Pause": live.pause, "Step": live.step_once, "Reset": self._reset}
        self._add_buttons(gui, "Time", works)
        pace = gui.add_slider("Speed", 0.1, 4.0, 0.1, 1.0, hint="1 is real time")
        self._on_change(pace, lambda value: setattr(live, "pace", value))
        self._timeline = gui.add_slider("Frame", 0, 1, 1, 0, hint="The timeline; moving it stops time.")
        self._on_change(self._timeline, lambda value: live.do(lambda: live.scrub(int(value))))

    def _push_tab(self, gui: Any) -> None:
        pointer = self._pointer
        gui.add_html(
            _small(
                "Drag a part to pull at it, a pin to move it; with Ctrl to flick it. Shift and drag brushes a region."
            )
        )
        level = gui.add_dropdown("Picks", pointer.level_names, initial_value=pointer.level)
        self._on_change(level, pointer.choose_level)
        self._chosen = gui.add_html("")
        self._selected()
        gain = gui.add_slider("Pull", 0.5, 20.0, 0.5, pointer.gain, hint="Weights of the part per diagonal of drag")
        self._on_change(gain, lambda value: setattr(pointer, "gain", value))
        works = {"Pin": lambda: self._on_selection(Pin), "Unpin": lambda: self._on_selection(Unpin)}
        self._add_buttons(gui, "Selection", works)
        self._on_press(gui.add_button("Let go of everything"), self._let_go)
        with gui.add_folder("Impulse", expand_by_default=False):
            self._amount = gui.add_slider("Weight s", 0.0, 0.3, 0.01, 0.1, hint="1 gives the speed of 1 s of weight")
            self._toward = gui.add_dropdown("Towards", AXES, initial_value="+x")
            self._on_press(gui.add_button("Push once"), lambda: self._on_selection(self._impulse))
        up = self._subject.up
        down = f"+{up[1:]}" if up.startswith("-") else f"-{up}"
        self._strengths = [self._steady(gui, "Wind", "+x", Wind), self._steady(gui, "Gravity", down, Gravity)]
        if self._live.interaction.hand is not None:
            self._strengths += self._hand(gui)
        self._factors = self._material(gui) if self._live.interaction.adjustable else []

    def _material(self, gui: Any) -> list[Any]:
        """Sliders of factors on the stiffness and damping that the scene began with."""
        with gui.add_folder("Material", expand_by_default=False):
            factors = [
                gui.add_slider(f"{name} times", 0.1, 10.0, 0.1, 1.0, hint="1: as given on the command line")
                for name in ("Stiffness", "Damping")
            ]
        self._on_changes(factors, lambda: Material(*(float(factor.value) for factor in factors)))
        return factors

    def _hand(self, gui: Any) -> list[Any]:
        """Sliders of where the pins are held, relative to rest."""
        diagonal, frames = self._live.interaction.scene.diagonal, round(HAND_SECONDS * self._live.interaction.fps)
        with gui.add_folder("Hand", expand_by_default=False):
            hint = "Moves what is pinned, in diagonals of the object"
            places = [gui.add_slider(f"Hand {axis}", -_HAND_REACH, _HAND_REACH, 0.01, 0.0, hint=hint) for axis in "xyz"]

        def move() -> Hand:
            x, y, z = (diagonal * float(place.value) for place in places)
            return Hand((x, y, z), max(1, frames))

        def follow(hand: int, to: tuple[float, float, float]) -> None:
            for place, value in zip(places, to, strict=True) if hand == 0 else ():
                place.value = min(max(value / diagonal, -_HAND_REACH), _HAND_REACH)

        self._on_changes(places, move)
        self._pointer.hand_moved = follow
        return places

    def _steady(self, gui: Any, name: str, axis: str, kind: type[Wind] | type[Gravity]) -> Any:
        with gui.add_folder(name, expand_by_default=False):
            strength = gui.add_slider(f"{name} [weights]", 0.0, 3.0, 0.05, 0.0)
            toward = gui.add_dropdown(f"{name} towards", AXES, initial_value=axis)

        def blow() -> Wind | Gravity:
            return kind(parse_direction(toward.value), float(strength.value))

        self._on_changes([strength, toward], blow)
        return strength

    def _look_tab(self, gui: Any) -> None:
        modes = self._painter.modes
        choice = gui.add_dropdown("Colours", modes, initial_value=self.mode)
        self._on_change(choice, self._recolour)
        self._legend = gui.add_html("")

    def _session_tab(self, gui: Any) -> None:
        gui.add_html(_small("Everything done to the object is recorded and can be replayed bit for bit."))
        gui.add_button("Save the session").on_click(self._queued(self._save))
        upload = gui.add_upload_button("Load and play a session", mime_type="application/json")
        upload.on_upload(self._queued(self._play_file))
        self._on_press(gui.add_button("Begin a new session"), self._begin)
        self._saved_text = gui.add_html("")

    def _queued(self, work: Callable[[Any], None]) -> Callable[[Any], Any]:
        """A handler of events that leaves the work to the simulation's thread."""

        async def handle(event: Any) -> None:
            self._live.do(lambda: work(event))

        return handle

    def _on_press(self, button: Any, work: Callable[[], None]) -> None:
        button.on_click(self._queued(lambda _: work()))

    def _add_buttons(self, gui: Any, name: str, works: dict[str, Callable[[], None]]) -> None:
        group = gui.add_button_group(name, tuple(works))

        async def pressed(_: Any) -> None:
            if group.value in works:
                self._live.do(works[group.value])

        group.on_click(pressed)

    def _on_changes(self, handles: list[Any], made: Callable[[], Event]) -> None:
        """Applies the event that all values together make when one of them is changed."""

        def changed(_: object) -> None:
            event = made()
            self._live.do(lambda: self._live.act(event))

        for handle in handles:
            self._on_change(handle, changed)

    @staticmethod
    def _on_change(handle: Any, work: Callable[[Any], None]) -> None:
        """Calls ``work`` with a value that comes from the browser, not from this program."""

        async def changed(event: Any) -> None:
            if event.client is not None:
                work(handle.value)

        handle.on_update(changed)

    def _reset(self) -> None:
        self._live.reset()
        self._calm()

    def _begin(self) -> None:
        self._live.begin()
        self._start_over()

    def _start_over(self) -> None:
        """Shows the beginning of a session on the controls."""
        self._source.value = LIVE
        for factor in self._factors:
            factor.value = 1.0
        self._calm()

    def _let_go(self) -> None:
        self._live.act(Release())
        for kind in (Wind, Gravity):
            self._live.act(kind((0.0, 0.0, -1.0), 0.0))
        self._live.act(Unpin())
        self._calm()

    def _calm(self) -> None:
        """Sets the sliders of wind and gravity to zero and restarts the colour scales."""
        self._painter.forget()
        for strength in self._strengths:
            strength.value = 0.0

    def _on_selection(self, kind: Callable[[Selected], Event]) -> None:
        if self._pointer.selection is None:
            self._live.message = "Nothing is selected: click a part first."
        else:
            self._live.act(kind(self._pointer.selection))

    def _impulse(self, on: Selected) -> Impulse:
        most = self._live.interaction.most_force / self._live.interaction.fps
        return Impulse(on, parse_direction(self._toward.value), min(float(self._amount.value), most))

    def _recolour(self, mode: str) -> None:
        self.mode = mode
        self._painter.forget()
        self._repaint()

    def _selected(self) -> None:
        self._chosen.content = _small(f"Selected: {self._pointer.described()}.")
        self._repaint()

    def _save(self, event: Any) -> None:
        session = self._live.interaction.session()
        name = f"session_{datetime.now():%Y%m%d_%H%M%S}_{len(self.saved):03d}.json"
        path = self._subject.sessions / name
        try:
            save_session(session, path)
        except OSError as error:
            self._live.message = f"{path}: {error.strerror}. Start with another --sessions folder."
            return
        self.saved.append(path)
        self._saved_text.content = _small(f"Saved {path} ({session.steps} frames, {len(session.entries)} events).")
        if event.client is not None:
            event.client.send_file_download(name, path.read_bytes(), save_immediately=True)

    def _play_file(self, event: Any) -> None:
        self._live.replay(parse_session(event.target.value.content, "the file"))
        self._start_over()

    def refresh(self, shown: Shown, legend: Legend, displayed: float, *, now: bool = False) -> None:
        """Updates rates, frame, messages and legend, at most :data:`_REFRESHES` times a second unless ``now``."""
        moment = time.monotonic()
        if not now and moment - self._refreshed < 1 / _REFRESHES:
            return
        self._refreshed = moment
        if shown.last > 0:
            self._timeline.max = max(shown.last, 1)
            self._timeline.value = shown.number
        self._write(shown, displayed)
        if (text := _legend(legend)) != self._legend.content:
            self._legend.content = text

    def _write(self, shown: Shown, displayed: float) -> None:
        live = self._live
        simulated = live.rate.per_second if shown.source == LIVE and live.playing else 0.0
        state = "playing" if live.playing else "paused"
        limit = _AT_LIMIT if shown.source == LIVE and live.interaction.resisting else ""
        problems = [text for text in (live.message, limit) if text]
        acting = ", ".join(live.interaction.acting) if shown.source == LIVE else ""
        warnings = "".join(
            f"<div style='margin-top:.3em;padding:.3em;background:#fff3cd;color:#664d03;border-radius:3px'>"
            f"{html.escape(problem[:600])}</div>" for problem in problems
        )  # fmt: skip
        text = (
            f"<div style='padding:.3em .6em;font-size:.85em'>{state} | frame {shown.number} of {shown.last}<br>"
            f"simulated {simulated:.1f} / s | displayed {displayed:.1f} / s<br>"
            f"acting: {html.escape(acting[:60] or 'nothing')}{warnings}</div>"
        )
        if text != self._status.content:
            self._status.content = text


def _small(text: str) -> str:
    return f"<div style='padding:0 .6em;font-size:.8em;opacity:.8'>{html.escape(text)}</div>"


def _legend(legend: Legend) -> str:
    text = _small(f"Colours: {legend.text}.")
    if legend.low is None or legend.high is None:
        return text
    ends = f"<span>{legend.low:.3g}</span><span>{legend.high:.3g} {html.escape(legend.unit)}</span>"
    return text + (
        f"<div style='margin:.2em .6em;height:.8em;background:{gradient_css()}'></div>"
        f"<div style='margin:0 .6em;font-size:.75em;display:flex;justify-content:space-between'>{ends}</div>"
    )
