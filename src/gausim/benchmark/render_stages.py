"""The parts of one image of the CPU renderer, one after the other, and the work of its two hot loops."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gausim.benchmark.splats import Splats
from gausim.render.cpu.batch import Band, Batch, Images
from gausim.render.cpu.raster import BLOCKS, LANES


class Stages:
    """One view, drawn and differentiated once; each part can then be repeated alone, as often as wanted."""

    def __init__(self, scene: Splats) -> None:
        """Runs every part once."""
        self.batch = Batch(
            means=scene.means.numpy(),
            covars=scene.covars.numpy(),
            colors=scene.colors.numpy(),
            opacities=scene.opacities.numpy(),
            viewmats=scene.viewmats.numpy(),
            Ks=scene.Ks.numpy(),
            background=scene.background.numpy(),
            width=scene.size[0],
            height=scene.size[1],
            near=0.01,
            alpha_max=np.float32(0.999),
        )
        shape = (1, 1, self.batch.height, self.batch.width)
        self.images = Images(np.empty((*shape, 3), np.float32), np.empty(shape, np.float32), None)
        self.grads = Images(scene.weights().numpy(), np.zeros(shape, np.float32), None)
        self.batch.make_views()
        self.view = self.batch.views[0, 0]
        self.project()
        self.sort()
        self.bin()
        self.composite()
        self.view.make_sums()
        self.composite_adjoint()
        self.project_adjoint()

    @property
    def parts(self) -> dict[str, Callable[[], None]]:
        """What can be timed, by name."""
        return {
            "projection": self.project,
            "order by depth": self.sort,
            "binning": self.bin,
            "compositing": self.composite,
            "compositing, backward": self.composite_adjoint,
            "projection, backward": self.project_adjoint,
        }

    @property
    def bands(self) -> list[Band]:
        """The bands of the view."""
        return [band for band in self.view.bands if band is not None]

    def project(self) -> None:
        """Projects all kernels."""
        for low, high in self.batch.kernel_ranges(1):
            self.batch.project((0, 0, low, high))

    def sort(self) -> None:
        """Orders them by depth."""
        self.batch.sort((0, 0))

    def bin(self) -> None:
        """Lists the kernels of every tile."""
        self.view.bands = [self.batch.bin(0, 0, index) for index in range(len(self.batch.band_rows))]

    def composite(self) -> None:
        """Draws all tiles."""
        for band in self.bands:
            self.batch.composite(band, self.images.of(0, 0))

    def composite_adjoint(self) -> None:
        """Goes back through all tiles."""
        for index in range(len(self.bands)):
            self.batch.composite_adjoint((0, 0, index), self.grads, None)

    def project_adjoint(self) -> None:
        """Takes the sums back to the kernels."""
        grads = self.batch.make_gradients(background=False)
        for low, high in self.batch.kernel_ranges(1):
            self.batch.project_adjoint(0, (0, low, high), grads)

    def evaluated(self) -> int:
        """Pixels for which the two loops evaluate a kernel: sixteen for each that a block of pixels looks at."""
        return LANES * sum(int(band.used[:, :BLOCKS].sum()) for band in self.bands)
