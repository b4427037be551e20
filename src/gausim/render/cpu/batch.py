"""One call of the renderer: B states in V views, cut into tasks for the pool."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gausim.core.errors import DivergenceError
from gausim.render.cpu.binning import TILE_HEIGHT, TILE_WIDTH, collect_band, fill_tiles
from gausim.render.cpu.pool import WorkerPool
from gausim.render.cpu.projection import add_band_sums, count_unusable, depth_order, project_adjoint, project_view
from gausim.render.cpu.raster import PIXELS, SUMS, backward_band, forward_band

Array = NDArray[Any]
Gradients = tuple[Array, Array, Array, Array]  # of means, covars, colors, opacities

# A call is cut into at least about this many tasks. A constant, not the number of threads, because the cut decides
# the order of summation and gradients must not depend on the number of threads.
TASKS = 8


@dataclass(slots=True)
class Band:
    """What the backward pass needs of one band of one view."""

    row_low: int
    records: Array
    entries: Array
    start: Array
    row_of: Array
    final: Array
    last: Array
    sums: Array | None = None


@dataclass(slots=True)
class View:
    """The projected kernels of one state in one view, and its bands."""

    ids: Array
    records: Array | None
    extents: Array | None
    order: Array | None
    bands: list[Band | None] = field(default_factory=list)


@dataclass(slots=True)
class Batch:
    """Inputs of one call as C-contiguous float32 arrays, and its options."""

    means: Array  # (B, K, 3)
    covars: Array  # (B, K, 3, 3)
    colors: Array  # (B, V, K, 3)
    opacities: Array  # (B, K)
    viewmats: Array  # (B, V, 4, 4)
    Ks: Array  # (B, V, 3, 3)
    background: Array  # (3,)
    width: int
    height: int
    near: float
    alpha_max: Any  # np.float32: the kernels are compiled for that type
    views: dict[tuple[int, int], View] = field(default_factory=dict)

    @property
    def band_rows(self) -> list[tuple[int, int]]:
        """First and last pixel row of each band of a view."""
        states, views = self.viewmats.shape[:2]
        tile_rows = -(-self.height // TILE_HEIGHT)
        bands = min(tile_rows, max(1, -(-TASKS // (states * views))))
        cuts = [i * tile_rows // bands * TILE_HEIGHT for i in range(bands + 1)]
        return [(low, min(high, self.height) - 1) for low, high in zip(cuts, cuts[1:], strict=False)]

    def forward(self, pool: WorkerPool, keep: bool) -> tuple[Array, Array]:
        """Draws everything: rgb (B, V, H, W, 3) and alpha (B, V, H, W). ``keep`` holds on to what backward needs."""
        states, views = self.viewmats.shape[:2]
        rgb = np.empty((states, views, self.height, self.width, 3), np.float32)
        alpha = np.empty((states, views, self.height, self.width), np.float32)
        rows = self.band_rows
        pairs = [(b, v) for b in range(states) for v in range(views)]

        def draw(item: tuple[int, int, int]) -> None:
            b, v, index = item
            band = self._draw_band(self.views[b, v], rows[index], index, rgb[b, v], alpha[b, v])
            self.views[b, v].bands[index] = band if keep else None

        def project(item: tuple[int, int]) -> None:
            self.views[item] = self._project(*item, len(rows))
            if len(rows) == 1:
                draw((*item, 0))
                self._forget(item)

        pool.run(project, pairs)
        if len(rows) > 1:
            pool.run(draw, [(b, v, i) for b, v in pairs for i in range(len(rows))])
            for item in pairs:
                self._forget(item)
        return rgb, alpha

    def backward(self, pool: WorkerPool, grad_rgb: Array, grad_alpha: Array) -> Gradients:
        """Gradients of means, covars, colors and opacities."""
        states, views = self.viewmats.shape[:2]
        count = self.means.shape[1]

        def composite(item: tuple[int, int, int]) -> None:
            b, v, index = item
            band = self.views[b, v].bands[index]
            assert band is not None
            band.sums = backward_band(
                band.records, band.entries, band.start, band.row_low, self.background, self.alpha_max,
                grad_rgb[b, v], grad_alpha[b, v], band.final, band.last,
            )  # fmt: skip

        bands = range(len(self.band_rows))
        pool.run(composite, [(b, v, i) for b in range(states) for v in range(views) for i in bands])
        grads = (
            np.empty((states, count, 3), np.float32),
            np.empty((states, count, 3, 3), np.float32),
            np.empty((states, views, count, 3), np.float32),
            np.empty((states, count), np.float32),
        )
        parts = max(1, TASKS // states)
        cuts = [i * count // parts for i in range(parts + 1)]
        pool.run(
            lambda part: self._finish(part, grads),
            [(b, low, high) for b in range(states) for low, high in zip(cuts, cuts[1:], strict=False) if high > low],
        )
        return grads

    def _project(self, b: int, v: int, bands: int) -> View:
        inputs = self.means[b], self.covars[b], self.colors[b, v], self.opacities[b]
        unusable = count_unusable(*inputs)
        if unusable:
            raise DivergenceError(
                f"render: {unusable} of {self.means.shape[1]} Gaussians of state {b}, view {v} have a mean, covariance "
                "or colour that is not finite, or an opacity outside 0..1. Look for the step that made them so."
            )
        records, extents, ids, depth = project_view(
            *inputs, self.viewmats[b, v], self.Ks[b, v], self.width, self.height, self.near
        )
        return View(ids, records, extents, depth_order(depth), [None] * bands)

    def _draw_band(self, view: View, rows: tuple[int, int], index: int, rgb: Array, alpha: Array) -> Band:
        strips = -(-self.width // TILE_WIDTH)
        row_of = np.empty(view.ids.shape[0], np.int32)
        records, extents, bound = collect_band(view.records, view.extents, view.order, row_of, *rows, strips)
        entries, start = fill_tiles(extents, bound, *rows, strips)
        final = np.empty((start.shape[0] - 1, PIXELS), np.float32)
        last = np.empty((start.shape[0] - 1, PIXELS), np.float32)
        forward_band(records, entries, start, rows[0], self.background, self.alpha_max, rgb, alpha, final, last)
        return Band(rows[0], records, entries, start, row_of, final, last)

    def _forget(self, item: tuple[int, int]) -> None:
        view = self.views[item]
        view.records = view.extents = view.order = None

    def _finish(self, part: tuple[int, int, int], grads: Gradients) -> None:
        (b, low, high), (means, covars, colors, opacities) = part, grads
        means[b, low:high], covars[b, low:high], opacities[b, low:high] = 0, 0, 0
        colors[b, :, low:high] = 0
        for v in range(self.viewmats.shape[1]):
            view = self.views[b, v]
            first, end = np.searchsorted(view.ids, (low, high))
            total = np.zeros((end - first, SUMS), np.float32)
            for band in view.bands:
                assert band is not None and band.sums is not None
                add_band_sums(total, band.sums, band.row_of, first)
            ids = view.ids[first:end]
            colors[b, v, ids] = total[:, 6:]
            project_adjoint(
                self.means[b], self.covars[b], self.opacities[b], self.viewmats[b, v], self.Ks[b, v], self.width,
                self.height, ids, total, means[b], covars[b], opacities[b],
            )  # fmt: skip
