"""One call of the renderer: B states in V views, divided into tasks for the pool."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gausim.core.errors import DivergenceError
from gausim.kernels.pool import WorkerPool
from gausim.render.cpu.binning import TILE_HEIGHT, TILE_WIDTH, bin_band
from gausim.render.cpu.projection import (
    EXTENT,
    RECORD,
    SUMS,
    count_unusable,
    depth_order,
    project_adjoint,
    project_kernels,
)
from gausim.render.cpu.raster import PIXELS, backward_band, forward_band
from gausim.render.limits import NEAR

Array = NDArray[Any]

# A call is divided into at least about this many tasks. A constant, not the number of threads, because the division
# determines the order of summation, and loss gradients must not depend on the number of threads.
TASKS = 8
# [tiles] Selecting a tile's kernels reads all kernels of its strip in the band: the cost is quadratic in the height.
BAND_TILES = 8
ALONE = WorkerPool(1)  # runs tasks in the thread that calls it


class Images(NamedTuple):
    """Drawn images, or their loss gradients."""

    rgb: Array  # (B, V, H, W, 3)
    alpha: Array  # (B, V, H, W)

    def of(self, b: int, v: int) -> tuple[Array, Array]:
        """The images of one view."""
        return self.rgb[b, v], self.alpha[b, v]


class Gradients(NamedTuple):
    """Loss gradients of the inputs; that of the background only if requested."""

    means: Array
    covars: Array
    colors: Array
    opacities: Array
    background: Array | None


class Band(NamedTuple):
    """Results for one band of one view that the backward pass needs."""

    kernels: tuple[Array, Array, Array, int]  # of bin_band: records, entries and their start; the first pixel row
    seen: tuple[Array, Array, Array]  # of forward_band: final, last, used


@dataclass(slots=True)
class View:
    """The kernels of one state projected into one view, indexed by the kernel, and the view's bands."""

    depth: Array
    spans: Array  # (K, 2): first and last pixel row
    row_of: Array  # (bands, K): the row of a kernel in the arrays of a band that it reaches
    records: Array | None
    extents: Array | None
    order: tuple[Array, Array] | None = None  # of depth_order
    bands: list[Band | None] = field(default_factory=list)
    offsets: Array | None = None  # (bands + 1,): where the rows of each band start in ``sums``
    sums: Array | None = None

    def make_sums(self) -> None:
        """Allocates the sums of the backward pass, all bands in one array."""
        self.offsets = np.cumsum([0, *(band.kernels[0].shape[0] for band in self.bands if band is not None)])
        self.sums = np.empty((self.offsets[-1], SUMS), np.float32)


@dataclass
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
    views: dict[tuple[int, int], View] = field(default_factory=dict)

    @cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """State and view of every image."""
        states, views = self.viewmats.shape[:2]
        return [(b, v) for b in range(states) for v in range(views)]

    @cached_property
    def band_rows(self) -> list[tuple[int, int]]:
        """First and last pixel row of each band of a view."""
        tile_rows = -(-self.height // TILE_HEIGHT)
        bands = min(tile_rows, max(_parts(len(self.pairs)), -(-tile_rows // BAND_TILES)))
        cuts = [(low * TILE_HEIGHT, high * TILE_HEIGHT) for low, high in ranges(tile_rows, bands)]
        return [(low, min(high, self.height) - 1) for low, high in cuts]

    @cached_property
    def band_of_row(self) -> Array:
        """The band of each pixel row."""
        return np.repeat(np.arange(len(self.band_rows)), [last - first + 1 for first, last in self.band_rows])

    def forward(self, pool: WorkerPool, *, keep: bool) -> Images:
        """Draws all images; ``keep`` stores the bands for the backward pass."""
        shape = (*self.viewmats.shape[:2], self.height, self.width)
        images = Images(np.empty((*shape, 3), np.float32), np.empty(shape, np.float32))
        bands, kernels = range(len(self.band_rows)), ranges(self.means.shape[1], _parts(len(self.pairs)))

        def sort(item: tuple[int, int]) -> None:
            view = self.views[item]
            view.order = depth_order(view.depth, view.spans)

        def draw(item: tuple[int, int, int]) -> None:
            b, v, index = item
            band = self.bin(b, v, index)
            forward_band(*band.kernels, self.background, *images.of(b, v), *band.seen)
            self.views[b, v].bands[index] = band if keep else None

        def draw_all(pairs: Sequence[tuple[int, int]], run: Callable[..., None]) -> None:
            run(self.project, [(*item, *part) for item in pairs for part in kernels])
            run(sort, pairs)
            run(draw, [(*item, i) for item in pairs for i in bands])
            for item in pairs:  # what only the forward pass needs
                self.views[item].records = self.views[item].extents = self.views[item].order = None

        for item in self.pairs:
            self.views[item] = self.new_view()
        if len(self.pairs) >= TASKS:
            pool.run(lambda item: draw_all([item], ALONE.run), self.pairs)
        else:
            draw_all(self.pairs, pool.run)
        return images

    def backward(self, pool: WorkerPool, grads: Images, *, background: bool) -> Gradients:
        """Loss gradients of the inputs from those of the images."""
        (states, views), count = self.viewmats.shape[:2], self.means.shape[1]
        bands, kernels = range(len(self.band_rows)), ranges(count, _parts(states))
        result = Gradients(
            np.zeros((states, count, 3), np.float32),
            np.zeros((states, count, 3, 3), np.float32),
            np.empty((states, views, count, 3), np.float32),
            np.zeros((states, count), np.float32),
            np.zeros((states, views, len(bands), 3), np.float64) if background else None,
        )

        composite = partial(self.composite_adjoint, grads, result.background)

        def adjoint(of_states: Sequence[int], of_views: Sequence[int], run: Callable[..., None]) -> None:
            def finish(part: tuple[int, int, int]) -> None:
                for v in of_views:
                    self.project_adjoint(v, part, result)

            pairs = [(b, v) for b in of_states for v in of_views]
            for item in pairs:
                self.views[item].make_sums()
            run(composite, [(*item, i) for item in pairs for i in bands])
            run(finish, [(b, *part) for b in of_states for part in kernels])
            for item in pairs:
                self.views[item].sums = None

        def one_by_one(b: int) -> None:
            for v in range(views):
                adjoint([b], [v], ALONE.run)

        if states >= TASKS:  # the sums stay in the cache
            pool.run(one_by_one, range(states))
        else:
            adjoint(range(states), range(views), pool.run)
        if result.background is None:
            return result
        return result._replace(background=result.background.sum((0, 1, 2)).astype(np.float32))

    def new_view(self) -> View:
        """A view whose arrays the forward pass fills."""
        count, bands = self.means.shape[1], len(self.band_rows)
        return View(
            depth=np.empty(count, np.float32),
            row_of=np.empty((bands, count), np.int32),
            records=np.empty((count, RECORD), np.float32),
            extents=np.empty((count, EXTENT), np.float32),
            spans=np.empty((count, 2), np.int32),
            bands=[None] * bands,
        )

    def project(self, part: tuple[int, int, int, int]) -> None:
        """Projects kernels ``low .. high - 1`` of state b into view v; ``part`` = (b, v, low, high).

        Raises:
            DivergenceError: a kernel is not finite or its opacity lies outside 0..1.
        """
        b, v, low, high = part
        view = self.views[b, v]
        kernels = self.means[b], self.covars[b], self.colors[b, v], self.opacities[b]
        if unusable := count_unusable(*kernels, low, high):
            raise DivergenceError(
                f"render: {unusable} of the Gaussians {low} to {high - 1} of state {b}, view {v} have a mean, "
                "covariance or colour that is not finite, or an opacity outside 0..1. Look for the step that made "
                "them so."
            )
        project_kernels(
            *kernels, self.viewmats[b, v], self.Ks[b, v], self.width, self.height, NEAR, low, high,
            view.records, view.extents, view.spans, view.depth,
        )  # fmt: skip

    def bin(self, b: int, v: int, index: int) -> Band:
        """Lists the kernels of every tile of a band."""
        view, rows = self.views[b, v], self.band_rows[index]
        assert view.order is not None
        records, entries, start = bin_band(
            view.records, view.extents, *view.order, view.row_of[index], *rows, -(-self.width // TILE_WIDTH)
        )  # fmt: skip
        tiles = start.shape[0] - 1
        final, last = np.empty((tiles, PIXELS), np.float32), np.empty((tiles, PIXELS), np.float32)
        return Band((records, entries, start, rows[0]), (final, last, np.empty(tiles, np.int64)))

    def composite_adjoint(self, grads: Images, background: Array | None, item: tuple[int, int, int]) -> None:
        """Sums the loss gradients of a band's pixels for each of its kernels; ``item`` = (b, v, band)."""
        b, v, index = item
        view = self.views[b, v]
        band, sums, offsets = view.bands[index], view.sums, view.offsets
        assert band is not None and sums is not None and offsets is not None
        backward_band(
            *band.kernels, self.background, *grads.of(b, v), *band.seen,
            sums[offsets[index] : offsets[index + 1]], None if background is None else background[item],
        )  # fmt: skip

    def project_adjoint(self, v: int, part: tuple[int, int, int], grads: Gradients) -> None:
        """Adds the loss gradients of kernels ``low .. high - 1`` from a view's sums; ``part`` = (b, low, high)."""
        b, low, high = part
        view = self.views[b, v]
        project_adjoint(
            self.means[b], self.covars[b], self.opacities[b], self.viewmats[b, v], self.Ks[b, v], self.width,
            self.height, low, high, view.depth, view.spans, self.band_of_row, view.row_of, view.offsets, view.sums,
            grads.means[b], grads.covars[b], grads.opacities[b], grads.colors[b, v],
        )  # fmt: skip


def _parts(images: int) -> int:
    """Parts of the work on each of ``images`` views or states; all of them together make about TASKS tasks."""
    return max(1, -(-TASKS // images))


def ranges(count: int, parts: int) -> list[tuple[int, int]]:
    """The numbers from 0 to ``count`` in ranges of about one size, each with its first and one past its last."""
    cuts = [i * count // parts for i in range(parts + 1)]
    return [(low, high) for low, high in zip(cuts, cuts[1:], strict=False) if high > low]
