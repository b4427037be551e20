"""Cameras of the data set: the initial view and the list of views."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from gausim.core import Cameras
from gausim.interaction.words import parse_direction
from gausim.viewer.splats import SIZE, Placing

if TYPE_CHECKING:
    from gausim.viewer.subject import Subject

_FREE = "Free"
# Vertical field of view without cameras [rad].
_HEIGHT_OF_VIEW = 0.8


class CameraPanel:
    """The cameras of one viewer.

    Attributes:
        up: vertical direction.
        first_position: camera position of the initial view [page units].
    """

    def __init__(self, server: Any, placing: Placing, subject: "Subject") -> None:
        self._server, self._placing, self._cameras = server, placing, subject.cameras
        self.up = np.array(parse_direction(subject.up))
        self.first_position, target, fov = self._first()
        camera = server.initial_camera
        camera.position, camera.look_at, camera.up = self.first_position, target, self.up
        camera.fov = fov
        if self._cameras is not None:
            self._add_cameras(self._cameras)

    def _first(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Position, target and vertical field of view of the initial view."""
        if self._cameras is not None:
            position, target, _, fov = self._pose(self._cameras, 0)
            return position, target, fov
        side = np.array([1.0, 0.0, 0.0]) if abs(self.up[0]) < 0.5 else np.array([0.0, 1.0, 0.0])
        away = np.cross(side, self.up)
        return 1.5 * SIZE * (0.35 * side - away + 0.35 * self.up) / 1.12, np.zeros(3), _HEIGHT_OF_VIEW

    def _pose(self, cameras: Cameras, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """Position and target on the page, up and vertical field of view of a camera."""
        view = cameras.viewmats[index].double().cpu()
        rotation = view[:3, :3].T.numpy()
        position = self._placing.to_page(cameras.centers[index].float().cpu()).double().numpy()
        fov = 2 * math.atan(cameras.height / 2 / float(cameras.Ks[index, 1, 1]))
        forward = rotation[:, 2]
        return position, position + forward * max(float(-position @ forward), 0.1), -rotation[:, 1], fov

    def _add_cameras(self, cameras: Cameras) -> None:
        gui = self._server.gui
        with gui.add_folder("Cameras of the data set", expand_by_default=False):
            choice = gui.add_dropdown("Look from", (_FREE, *cameras.names), initial_value=_FREE)

        async def look_from(event: Any) -> None:
            if event.client is None or choice.value not in cameras.names:
                return
            position, target, up, fov = self._pose(cameras, cameras.names.index(choice.value))
            with event.client.atomic():
                camera = event.client.camera
                camera.up_direction, camera.position, camera.look_at, camera.fov = up, position, target, fov

        choice.on_update(look_from)
