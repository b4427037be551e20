"""Pointer input from the browser: selecting parts by click or rectangle, and forces by dragging."""

import math
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from trimesh.creation import icosahedron
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial
from viser.transforms import SO3

from gausim.interaction.selections import Kernels, Selected, Unit, Whole
from gausim.interaction.session import Force, Hand, Impulse, Release
from gausim.viewer.live import Live
from gausim.viewer.shown import Shown
from gausim.viewer.splats import SIZE, Placing, unit_centres

WHOLE = "The whole object"
# Update rate of the handles' positions [1 / s].
_FOLLOWS = 8.0
# Duration of the force of which a drag with the control key gives the impulse [s].
_FLICK = 0.1
# Time in which a hand follows the pointer or its slider [s].
HAND_SECONDS = 0.15


@dataclass
class _Grab:
    """A hand that a pointer drags, from the beginning of the drag."""

    hand: int  # its number
    point: Tensor  # where the drag began (3,) [page units]
    # its displacement and turn then; asked for by the simulation's thread at the first motion
    place: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None


class Pointer:
    """Pointer input; its callbacks run in the server's loop and only queue commands for the simulation.

    Attributes:
        selection: the selected part, or None.
        mask: mask of its free kernels.
        level: level of the units that a click selects, one of :attr:`level_names`; initially the coarsest.
        gain: force per diagonal of drag [weights].
        notice: called when the selection changes.
        hand_moved: called with the number of a hand that is dragged and its displacement from rest [scene units].
    """

    def __init__(self, server: Any, live: Live, placing: Placing) -> None:
        """Creates a handle on every unit of the initial level."""
        self._server, self._live, self._placing = server, live, placing
        scene, units, masses = live.interaction.scene, live.interaction.units, live.interaction.masses
        self._free = (scene.simulated & ~scene.pinned).cpu()
        hand = live.interaction.hand
        self._hand = torch.full((scene.count,), -1) if hand is None else hand.cpu()
        self._pins = pin_groups(self._hand, units[0].cpu() if units else torch.zeros_like(self._hand))
        self._grabs: dict[int, _Grab] = {}  # by client
        self._units, self._masses = [u.cpu() for u in units], masses.float().cpu()
        self._moved = 0.0
        self._pick: Any = None
        self._lock = threading.Lock()
        self._page: Tensor | None = None
        self.selection: Selected | None = None
        self.mask: Bool[Tensor, " K"] = torch.zeros_like(self._free)
        self.gain = 8.0
        self.notice: Callable[[], None] = lambda: None
        self.hand_moved: Callable[[int, tuple[float, float, float]], None] = lambda hand, to: None
        self._label = server.scene.add_label("/weight", "", visible=False)
        self.choose_level(self.level_names[-2 if units else -1])
        # Largest distance of a ray from a kernel's centre: the kernel's size plus a tolerance [page units].
        self._reach = scene.log_scales.float().cpu().exp().amax(-1) * placing.scale + 0.004 * SIZE
        server.scene.on_rect_select(modifier="shift")(self._brushed)
        server.scene.on_click()(self._clicked)

    @property
    def level_names(self) -> tuple[str, ...]:
        """Names of the levels whose units a click can select."""
        return (*(f"Level {i + 1}: {int(u.max()) + 1} units" for i, u in enumerate(self._units)), WHOLE)

    def choose_level(self, name: str) -> None:
        """Replaces the handles by those of another level, one of :attr:`level_names`."""
        self.level, level = name, self.level_names.index(name)
        rest = self._live.interaction.scene.means
        with self._lock:
            self._level = level if level < len(self._units) else None
            # The handle of each kernel, and the handles of units with free kernels.
            self._index = self._units[level] if level < len(self._units) else torch.where(self._free, 0, -1)
            self._count = int(self._index.max()) + 1
            self._movable = self._index[self._free & (self._index >= 0)].unique()
            if self._pick is not None:
                self._pick.remove()
            self._make_handles(self._centres(rest).numpy(), self._handle_radii(rest.float().cpu()).numpy())
        self._moved = 0.0

    def _centres(self, positions: Tensor) -> Tensor:
        at = positions.float().cpu()
        centres = unit_centres(at, self._index, self._masses, self._count)[self._movable]
        return self._placing.to_page(torch.cat((centres, self._pin_centres(at))))

    def _pin_centres(self, positions: Tensor) -> Tensor:
        return unit_centres(positions, self._pins, torch.ones(len(positions)), int(self._pins.max()) + 1)

    def _handle_radii(self, rest: Tensor) -> Tensor:
        """Radii of the handles, similar to those of their units [page units]."""
        centres = unit_centres(rest, self._index, self._masses, self._count)
        inside = self._index >= 0
        away = (rest[inside] - centres[self._index[inside]]).norm(dim=-1)
        widest = torch.zeros(self._count).scatter_reduce(0, self._index[inside], away, "amax")
        held = self._pins >= 0
        spread = (rest[held] - self._pin_centres(rest)[self._pins[held]]).norm(dim=-1)
        pins = torch.zeros(int(self._pins.max()) + 1).scatter_reduce(0, self._pins[held], spread, "amax")
        radii = torch.cat((0.8 * widest[self._movable], 1.25 * pins))  # an icosahedron has flat sides
        return (radii * self._placing.scale).clamp(0.008 * SIZE, 0.2 * SIZE)

    def _make_handles(self, centres: np.ndarray, radii: np.ndarray) -> None:
        # `_movable` is already that of the new handles: their events carry indices into it.
        self._pick = self._server.scene.add_batched_glb(
            "/handles", invisible_handle(), np.tile(np.array([1, 0, 0, 0], np.float32), (len(centres), 1)), centres,
            batched_scales=radii, lod="off", cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        # Clicks are resolved by their ray, not by handles, as viser would outline clickable handles.
        self._pick.on_drag("left")(self._dragged)
        self._pick.on_drag("left", modifier="cmd/ctrl")(self._flicked)

    def follow(self, shown: Shown) -> None:
        """Moves the handles to the current centres of their units."""
        self._page = self._placing.to_page(shown.frame.positions.float().cpu())
        now = time.monotonic()
        if now - self._moved < 1 / _FOLLOWS:
            return
        self._moved = now
        with self._lock:
            self._pick.batched_positions = self._centres(shown.frame.positions).numpy()

    def select(self, on: Selected | None) -> None:
        """Selects a part, or none."""
        self.mask = torch.zeros_like(self._free) if on is None else self._mask(on)
        self.selection = on
        self.notice()

    def _mask(self, on: Selected) -> Bool[Tensor, " K"]:
        return on.mask(self._live.interaction.scene, self._units).cpu() & self._free

    def described(self) -> str:
        """Description of the selection for the page."""
        count = int(self.mask.sum())
        match self.selection:
            case None:
                return "nothing: click a part, or hold Shift and draw a rectangle"
            case Unit():
                return f"unit {self.selection.index} of level {self.selection.level}, {count} kernels that can move"
            case Whole():
                return f"the whole object, {count} kernels that can move"
        return f"{count} kernels"

    async def _clicked(self, event: Any) -> None:
        if self._page is None:
            return
        kernel = first_hit(self._page, self._reach, event.ray_origin, event.ray_direction, self._free)
        if kernel is None:
            self.select(None)
        elif int(self._index[kernel]) >= 0:
            self.select(self._part(int(self._index[kernel])))

    def _part(self, index: int) -> Selected:
        return Whole() if self._level is None else Unit(self._level + 1, index)

    async def _brushed(self, event: Any) -> None:
        if self._page is None:
            return
        inside = in_rectangle(self._page, event.client.camera, event.screen_min, event.screen_max) & self._free
        numbers = inside.nonzero()[:, 0].tolist()
        self.select(Kernels(tuple(numbers)) if numbers else None)

    def _grab(self, event: Any) -> _Grab | None:
        """The hand whose pin a drag began on; None elsewhere."""
        if event.phase == "start" and self._page is not None:
            self._grabs.pop(event.client_id, None)
            point = vector(event.start_position)
            hand = self._hand_under(event, self._page, point)
            if hand >= 0:
                self._grabs[event.client_id] = _Grab(hand, point)
        found = self._grabs.get(event.client_id)
        if event.phase == "end":
            self._grabs.pop(event.client_id, None)
        return found

    def _hand_under(self, event: Any, page: Tensor, point: Tensor) -> int:
        """The hand of the pins whose handle is dragged, else of the first kernel under a point; -1 for none."""
        index = event.instance_index
        if index is not None and index >= len(self._movable):
            found = self._hand[self._pins == index - len(self._movable)]
            return int(found[0]) if len(found) else -1
        eye = vector(event.client.camera.position)
        kernel = first_hit(page, self._reach, eye.tolist(), (point - eye).tolist(), self._free | (self._hand >= 0))
        return -1 if kernel is None else int(self._hand[kernel])

    def _drag_hand(self, grab: _Grab, event: Any) -> None:
        """Moves a hand as far as the pointer has gone since the drag began; it keeps the turn that it had."""
        interaction = self._live.interaction
        way = (vector(event.end_position) - grab.point) / self._placing.scale

        def move() -> None:
            if grab.place is None:
                grab.place = interaction.place_of_hand(grab.hand)
            start, turn = grab.place
            x, y, z = (torch.tensor(start) + way).tolist()
            self.hand_moved(grab.hand, (x, y, z))
            self._live.act(Hand((x, y, z), max(1, round(HAND_SECONDS * interaction.fps)), turn, grab.hand))

        self._live.do(move)
        if event.phase == "end":
            self._label.visible = False
        else:
            self._point(event, f"hand {grab.hand}: {float(way.norm()) / interaction.scene.diagonal:.2f} diagonals")

    def _grasp(self, event: Any) -> None:
        """Selects the unit under a drag's start unless the selection overlaps it."""
        index = event.instance_index
        if event.phase != "start" or index is None or not 0 <= index < len(self._movable):
            return
        chosen = self._part(int(self._movable[index]))
        if not bool((self._mask(chosen) & self.mask).any()):
            self.select(chosen)

    def pull(self, start: Sequence[float], end: Sequence[float]) -> tuple[tuple[float, float, float], float]:
        """Direction and size [weights] of the force for a drag between two points of the page."""
        x, y, z = (float(b) - float(a) for a, b in zip(start, end, strict=True))
        weights = self.gain * math.hypot(x, y, z) / SIZE
        return (x, y, z), min(weights, self._live.interaction.most_force)

    async def _dragged(self, event: Any) -> None:
        if (grab := self._grab(event)) is not None:
            self._drag_hand(grab, event)
            return
        name = f"drag-{event.client_id}"
        self._grasp(event)
        direction, weights = self.pull(event.start_position, event.end_position)
        on = self.selection
        if event.phase == "end" or on is None:
            self._label.visible = False
            self._live.do(lambda: self._live.act(Release(name)))
        elif weights > 1e-4:
            self._point(event, f"{weights:.2f} x weight")
            self._live.do(lambda: self._live.act(Force(on, direction, weights, name=name)))

    async def _flicked(self, event: Any) -> None:
        self._grasp(event)
        direction, weights = self.pull(event.start_position, event.end_position)
        amount = min(weights * _FLICK, self._live.interaction.most_force / self._live.interaction.fps)
        on = self.selection
        if event.phase == "end":
            self._label.visible = False
            if on is not None and weights > 1e-4:
                self._live.do(lambda: self._live.act(Impulse(on, direction, amount)))
        elif on is not None:
            self._point(event, f"{amount:.3f} weight s")

    def _point(self, event: Any, text: str) -> None:
        with self._server.atomic():
            self._label.position, self._label.text, self._label.visible = event.end_position, text, True


def vector(numbers: Iterable[float]) -> Float[Tensor, " 3"]:
    """A point or direction of the page as the browser or numpy gives it."""
    return torch.tensor([float(number) for number in numbers])


@cache
def invisible_handle() -> bytes:
    """A binary glTF of a transparent icosahedron of radius 1, a target for the pointer.

    An ordinary mesh of opacity 0 would still occlude the splats behind it, which are drawn last with a depth test; a
    glTF material with blending does not write depth.
    """
    mesh = icosahedron()
    clear = PBRMaterial(alphaMode="BLEND", baseColorFactor=[255, 255, 255, 0], doubleSided=True)
    mesh.visual = TextureVisuals(material=clear)
    return bytes(mesh.export(file_type="glb"))  # type: ignore[arg-type]


def pin_groups(hand: Int[Tensor, " K"], units: Int[Tensor, " K"]) -> Int[Tensor, " K"]:
    """Groups 0, 1, ... of the kernels in hands: those of one unit in one hand; -1 for the others."""
    held = hand >= 0
    both = torch.stack((hand, units))[:, held]
    return torch.full_like(hand, -1).masked_scatter(held, both.unique(dim=1, return_inverse=True)[1])


def first_hit(
    points: Float[Tensor, "K 3"],
    reach: Float[Tensor, " K"],
    origin: Iterable[float],
    direction: Iterable[float],
    among: Bool[Tensor, " K"],
) -> int | None:
    """The first kernel of the mask ``among`` whose centre is within its ``reach`` of a ray, or None."""
    along = torch.nn.functional.normalize(vector(direction), dim=0)
    away = points - vector(origin)
    depth = away @ along
    passed = (away - depth[:, None] * along).norm(dim=-1)
    hit = (among & (depth > 0) & (passed <= reach)).nonzero()[:, 0]
    return int(hit[depth[hit].argmin()]) if len(hit) else None


def in_rectangle(
    points: Float[Tensor, "K 3"], camera: Any, low: Sequence[float], high: Sequence[float]
) -> Bool[Tensor, " K"]:
    """Points of the page within a rectangle of a viser camera's picture, from its upper left to its lower right corner.

    Corners are in 0..1 of the picture. The camera has a world pose (wxyz, position), the vertical field of view
    [rad] and the aspect (width / height).
    """
    rotation = torch.from_numpy(SO3(np.asarray(camera.wxyz, float)).as_matrix()).to(points)
    seen = (points - vector(camera.position)) @ rotation
    half = math.tan(float(camera.fov) / 2)
    depth = seen[:, 2].clamp_min(1e-6)
    across = 0.5 + 0.5 * seen[:, 0] / (depth * half * float(camera.aspect))
    down = 0.5 + 0.5 * seen[:, 1] / (depth * half)
    inside = (across >= low[0]) & (across <= high[0]) & (down >= low[1]) & (down <= high[1])
    return inside & (seen[:, 2] > 0)
