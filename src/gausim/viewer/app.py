"""The viewer: a simulation, its page and the concurrent stages between them."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt32

from gausim.viewer.access import Access
from gausim.viewer.camera_panel import CameraPanel
from gausim.viewer.coloring import VIEW, Legend, Painter, highlighted
from gausim.viewer.live import Live
from gausim.viewer.page import Page
from gausim.viewer.pipeline import Rate, Worker
from gausim.viewer.pointer import Pointer
from gausim.viewer.server import GuardedServer
from gausim.viewer.shown import Shown
from gausim.viewer.splats import Placing, add_splats, pack
from gausim.viewer.subject import Subject

# Update rate of view-dependent colours while time is stopped [1 / s].
_VIEWS = 10.0


@dataclass(frozen=True, eq=False)
class _Painted:
    shown: Shown
    legend: Legend
    buffer: UInt32[np.ndarray, "_ 8"]


class Viewer:
    """Server of one :class:`Subject`.

    Raises:
        ConfigError: the access settings are unsafe or invalid, or the address cannot be bound.
    """

    def __init__(self, subject: Subject, access: Access) -> None:
        """Starts to listen; :meth:`start` begins the simulation."""
        scene = subject.interaction.scene
        self.server = GuardedServer(access, label="gausim")  # the viser server
        self.placing = Placing.of(scene)
        self._painter = Painter(scene, subject.interaction.units, subject.interaction.masses, subject.material)
        self.workers = (Worker("paint", self._paint), Worker("send", self._send))  # the stages after the simulation
        # The simulation thread.
        self.live = Live(
            subject.interaction, self.workers[0].put, takes=subject.takes,
            watched=lambda: bool(self.server.get_clients()),
        )  # fmt: skip
        self.server.scene.set_up_direction(f"{'' if subject.up.startswith('-') else '+'}{subject.up}")  # type: ignore[arg-type]
        self.server.scene.world_axes.visible = False
        self.pointer = Pointer(self.server, self.live, self.placing)  # selections and drags
        # The control panel.
        self.page = Page(self.server, self.live, self.pointer, subject, self._painter, self.repaint)
        self.camera_panel = CameraPanel(self.server, self.placing, subject)
        # Position of the camera that moved last [page units].
        self.eye = torch.tensor(self.camera_panel.first_position, dtype=torch.float32)
        self._viewed, self._sent = 0.0, Rate()
        self._splats = add_splats(self.server.scene, "/splats", self._paint_now(self.live.shown()).buffer)
        self.server.on_client_connect(self._connected)

    @property
    def url(self) -> str:
        """Address of the page."""
        return self.server.url

    def start(self) -> None:
        """Starts all threads."""
        for thread in (self.live, *self.workers):
            thread.start()

    def stop(self) -> None:
        """Ends all threads and the server."""
        self.live.stop()
        for worker in self.workers:
            worker.stop()
        for thread in (self.live, *self.workers):
            if thread.is_alive():
                thread.join(5.0)
        self.server.stop()

    def repaint(self) -> None:
        """Requests new colours of the shown frame, also while time is stopped."""
        if self.live.is_alive():
            self.live.do(lambda: None)

    def _connected(self, client: Any) -> None:
        async def moved(camera: Any) -> None:
            position = torch.tensor(np.asarray(camera.position, np.float64))
            if not bool(torch.isfinite(position).all()):
                return
            self.eye = position.float()
            now = time.monotonic()
            if self.page.mode == VIEW and not self.live.playing and now - self._viewed > 1 / _VIEWS:
                self._viewed = now
                self.repaint()

        client.camera.on_update(moved)
        self.repaint()

    @torch.no_grad()
    def _paint_now(self, shown: Shown) -> _Painted:
        painter, frame, eye = self._painter, shown.frame, self.placing.to_scene(self.eye)
        covars, rgb, legend = painter(frame, shown.unit_of_kernel, shown.speed, self.page.mode, eye)
        held = torch.zeros_like(self.pointer.mask) if shown.held is None else shown.held.cpu()
        rgb = highlighted(rgb, self.pointer.mask, held)
        return _Painted(shown, legend, pack(frame.positions.cpu(), covars, rgb, painter.opacities, self.placing))

    def _paint(self, shown: Shown) -> None:
        self.workers[1].put(self._paint_now(shown))

    def _send(self, painted: _Painted) -> None:
        with self.server.atomic():
            self._splats.buffer = painted.buffer
            self.pointer.follow(painted.shown)
        self._sent.count()
        paused = not self.live.playing  # this frame must be displayed, as no other may follow
        displayed = 0.0 if paused else self._sent.per_second
        self.page.refresh(painted.shown, painted.legend, displayed, now=paused)
