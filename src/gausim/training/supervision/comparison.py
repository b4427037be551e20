"""Drawing what was predicted and comparing it with the frames, a few states at a time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from gausim.core import Cameras, Renderer
from gausim.data.images import composite
from gausim.losses.image import ImageLoss
from gausim.render.draw import SceneAppearance, draw
from gausim.training.contracts import SceneBatch
from gausim.training.rollout import States

# Pixels that are drawn and compared together: enough for each call to be cut by state and not within an image, and to
# keep a GPU busy; few enough for the images to be a small part of the memory.
CPU_PIXELS, GPU_PIXELS = 1_000_000, 4_000_000


class ViewGroup(NamedTuple):
    """Sequences of a batch, by their places in it, that one call of the renderer can draw together."""

    scene_id: int
    members: tuple[int, ...]
    cameras: Cameras


class Chunk(NamedTuple):
    """States that are drawn and compared together: steps of some members of one view group, counted in the stretch."""

    group: int
    members: tuple[int, ...]
    span: slice


class Comparison:
    """Compares the frames that a rollout predicts with the true ones, stretch by stretch.

    No image outlives its chunk: each chunk is drawn and compared, and the gradients with respect to its states are
    formed at once. The memory of drawing therefore does not grow with the number of steps.

    Attributes:
        last: the images that the latest stretch ended with, per member; at first those of the rest state.
    """

    def __init__(
        self,
        renderer: Renderer,
        loss: ImageLoss,
        batch: SceneBatch,
        groups: Sequence[ViewGroup],
        looks: Sequence[SceneAppearance],
        frames: Sequence[UInt8[Tensor, "T _ _ _ 4"]],
        rest: Sequence[Float[Tensor, "_ _ _ C"]],
    ) -> None:
        """Binds what stays the same over a rollout.

        ``groups`` are the members by scene and cameras, with the appearance (``looks``) of each group's scene; the true
        ``frames`` 1..T and images of the ``rest`` state are each member's. Groups may differ in views and image size.
        """
        self._renderer, self._loss, self._batch = renderer, loss, batch
        self._groups, self._looks, self._frames = groups, looks, frames
        self.last = list(rest)

    def __call__(self, states: States, start: int) -> tuple[Float[Tensor, "T S"], Float[Tensor, ""]]:
        """Image loss of each predicted frame and member, and the squared change of the predicted images (summed).

        Differentiable in the states through the losses alone; ``start`` frames were predicted before them.
        """
        losses, motion = _Compare.apply(*states.tensors(), self, start)
        return losses, motion

    def chunks(self, steps: int) -> list[Chunk]:
        """The states in the order in which they are drawn: a few steps of one member, or several members whole."""
        result = []
        budget = CPU_PIXELS if self._batch.rest.device.type == "cpu" else GPU_PIXELS
        for number, group in enumerate(self._groups):
            pixels = len(group.cameras.viewmats) * group.cameras.width * group.cameras.height
            length = max(1, budget // pixels)
            together = max(1, length // steps)
            for first in range(0, len(group.members), together):
                members = group.members[first : first + together]
                result += [Chunk(number, members, slice(t, min(t + length, steps))) for t in range(0, steps, length)]
        return result

    def rows(self, member: int) -> tuple[slice, slice, slice]:
        """Where the member's positions, gradients and rotations stand in the batch."""
        place = self._batch.members[member]
        return place.kernels, place.units, place.units

    def draw(self, chunk: Chunk, states: States) -> Float[Tensor, "M T V H W C"]:
        """Images of the states of a chunk, member by member; gradients flow into the states."""
        group, units = self._groups[chunk.group], self._batch.members[chunk.members[0]].unit_of_kernel
        drawn = draw(self._renderer, self._looks[chunk.group], *states.tensors(), units, group.cameras)
        images = channels(drawn.rgb, drawn.alpha, self._loss)
        return images.unflatten(0, (len(chunk.members), -1))

    def compare(
        self, images: Float[Tensor, "M T V H W C"], chunk: Chunk, start: int
    ) -> tuple[Float[Tensor, "M T"], Float[Tensor, "M T V H W C"], Float[Tensor, ""]]:
        """Losses of a chunk's images, the gradient of their sum, and the squared change since the frames before."""
        span = slice(start + chunk.span.start, start + chunk.span.stop)
        frames = torch.stack([self._frames[i][span].to(images.device, non_blocking=True) for i in chunk.members])
        target = channels(*composite(frames), self._loss)
        values, slope = self._loss.value_and_gradient(images.flatten(0, 1), target.flatten(0, 1))
        change = images.new_zeros(())
        for drawn, i in zip(images[..., :3], chunk.members, strict=True):
            change += F.mse_loss(drawn[0], self.last[i], reduction="sum")
            if len(drawn) > 1:
                change += F.mse_loss(drawn[1:], drawn[:-1], reduction="sum")
            self.last[i] = drawn[-1]
        return values.unflatten(0, images.shape[:2]), slope.unflatten(0, images.shape[:2]), change


def channels(rgb: Float[Tensor, "*B 3"], alpha: Float[Tensor, " *B"], loss: ImageLoss) -> Float[Tensor, "*B C"]:
    """The channels that a loss compares: the colours, and the opacity where it asks for it."""
    return torch.cat((rgb, alpha[..., None]), -1) if loss.compares_alpha else rgb


class _Compare(torch.autograd.Function):
    """Drawing and loss of a stretch as one node that keeps only the gradients with respect to the states."""

    @staticmethod
    def forward(
        ctx: Any, positions: Tensor, deformation_gradients: Tensor, rotations: Tensor, work: Comparison, start: int
    ) -> tuple[Tensor, Tensor]:
        inputs, wanted = (positions, deformation_gradients, rotations), ctx.needs_input_grad[:3]
        kept = [torch.zeros_like(x) if need else None for x, need in zip(inputs, wanted, strict=True)]
        losses = positions.new_zeros(positions.shape[0], len(work.last))
        motion = positions.new_zeros(())
        for chunk in work.chunks(positions.shape[0]):
            leaves = [
                _gather(x, kind, chunk, work).requires_grad_(need)
                for kind, (x, need) in enumerate(zip(inputs, wanted, strict=True))
            ]
            with torch.set_grad_enabled(any(wanted)):
                images = work.draw(chunk, States(*leaves))
            values, slope, change = work.compare(images.detach(), chunk, start)
            losses[chunk.span, list(chunk.members)] = values.to(losses).mT
            motion += change
            if images.requires_grad:
                _scatter(images, slope, leaves, kept, chunk, work)
        ctx.save_for_backward(*kept)
        ctx.rows = [work.rows(member) for member in range(len(work.last))]
        ctx.mark_non_differentiable(motion)
        return losses, motion

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *incoming: Tensor) -> Any:
        result = [None if kept is None else torch.zeros_like(kept) for kept in ctx.saved_tensors]
        for member, rows in enumerate(ctx.rows):
            for kept, scaled, r in zip(ctx.saved_tensors, result, rows, strict=True):
                if scaled is not None:
                    weight = incoming[0][:, member].reshape(-1, *[1] * (kept.dim() - 1))
                    torch.mul(kept[:, r], weight, out=scaled[:, r])
        return (*result, None, None)


def _gather(values: Tensor, kind: int, chunk: Chunk, work: Comparison) -> Tensor:
    """The rows of a chunk's members in its steps, member by member, as a leaf of its own."""
    return torch.cat([values.detach()[chunk.span, work.rows(member)[kind]] for member in chunk.members])


def _scatter(
    images: Tensor, slope: Tensor, leaves: list[Tensor], kept: list[Tensor | None], chunk: Chunk, work: Comparison
) -> None:
    """Forms the gradients with respect to a chunk's states and writes them to where its members stand."""
    wanted = [kind for kind, leaf in enumerate(leaves) if leaf.requires_grad]
    found = torch.autograd.grad(images, [leaves[kind] for kind in wanted], slope, allow_unused=True)
    for kind, gradient in zip(wanted, found, strict=True):
        target = kept[kind]
        if target is None or gradient is None:
            continue
        for member, part in zip(chunk.members, gradient.chunk(len(chunk.members)), strict=True):
            target[chunk.span, work.rows(member)[kind]] = part
