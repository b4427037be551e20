"""Rendering of predicted states and their image loss, a few states at a time."""

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

# Pixels rendered and compared in one call: enough to divide calls between images and to keep a GPU busy; few enough for
# the images to be a small part of the memory.
CPU_PIXELS, GPU_PIXELS = 1_000_000, 4_000_000


class ViewGroup(NamedTuple):
    """Sequences of a batch (by index) that one call of the renderer can draw together."""

    scene_id: int
    members: tuple[int, ...]
    cameras: Cameras


class Chunk(NamedTuple):
    """States rendered and compared together: steps, counted in the stretch, of some members of one view group."""

    group: int
    members: tuple[int, ...]
    span: slice


class Comparison:
    """Image loss of a rollout's predicted frames, stretch by stretch.

    Images are freed after their chunk: each chunk is rendered and compared, and the loss gradients with respect to its
    states are computed at once. The memory of rendering therefore does not grow with the number of steps.

    Attributes:
        last: last images of the latest stretch, per member; at first those of the rest state.
    """

    def __init__(
        self,
        renderer: Renderer,
        loss: ImageLoss,
        batch: SceneBatch,
        groups: Sequence[ViewGroup],
        appearances: Sequence[SceneAppearance],
        frames: Sequence[UInt8[Tensor, "T _ _ _ 4"]],
        rest: Sequence[Float[Tensor, "_ _ _ C"]],
    ) -> None:
        """Stores the constants of a rollout.

        ``groups`` are the members by scene and cameras, with one of the ``appearances`` each; ``frames`` are the true
        frames 1..T and ``rest`` the rest state's images of each member. Groups may differ in views and image size.
        """
        self._renderer, self._loss, self._batch = renderer, loss, batch
        self._groups, self._appearances, self._frames = groups, appearances, frames
        self.last = list(rest)

    def __call__(self, states: States, start: int) -> tuple[Float[Tensor, "T S"], Float[Tensor, ""]]:
        """Image loss of each predicted frame and member, and the squared change of the predicted images (summed).

        Only the losses are differentiable in the states; ``start`` is the number of frames predicted before.
        """
        losses, motion = _Compare.apply(*states, self, start)
        return losses, motion

    def chunks(self, steps: int) -> list[Chunk]:
        """Chunks in the order of rendering: a few steps of one member, or all steps of several members."""
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
        """The member's rows of positions, deformation gradients and rotations in the batch."""
        place = self._batch.members[member]
        return place.kernels, place.units, place.units

    def draw(self, chunk: Chunk, states: States) -> Float[Tensor, "M T V H W C"]:
        """Images of the states of a chunk, member by member; differentiable in the states."""
        group, units = self._groups[chunk.group], self._batch.members[chunk.members[0]].unit_of_kernel
        drawn = draw(self._renderer, self._appearances[chunk.group], *states, units, group.cameras)
        images = channels(drawn.rgb, drawn.alpha, self._loss)
        return images.unflatten(0, (len(chunk.members), -1))

    def compare(
        self, images: Float[Tensor, "M T V H W C"], chunk: Chunk, start: int
    ) -> tuple[Float[Tensor, "M T"], Float[Tensor, "M T V H W C"], Float[Tensor, ""]]:
        """Losses of a chunk's images, the gradient of their sum, and the squared change from frame to frame."""
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
    """The channels that a loss compares: the colours, with the opacity if the loss uses it."""
    return torch.cat((rgb, alpha[..., None]), -1) if loss.compares_alpha else rgb


class _Compare(torch.autograd.Function):
    """Rendering and loss of a stretch as one graph node, which stores the loss gradients of the states only."""

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
            for own, member in zip(values.to(losses), chunk.members, strict=True):  # a list would be sent to the device
                losses[chunk.span, member] = own
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
    """The rows of a chunk's members in its steps, member by member, as a new leaf tensor."""
    return torch.cat([values.detach()[chunk.span, work.rows(member)[kind]] for member in chunk.members])


def _scatter(
    images: Tensor, slope: Tensor, leaves: list[Tensor], kept: list[Tensor | None], chunk: Chunk, work: Comparison
) -> None:
    """Computes the loss gradients with respect to a chunk's states and writes them to its members' rows."""
    wanted = [kind for kind, leaf in enumerate(leaves) if leaf.requires_grad]
    found = torch.autograd.grad(images, [leaves[kind] for kind in wanted], slope, allow_unused=True)
    for kind, gradient in zip(wanted, found, strict=True):
        target = kept[kind]
        if target is None or gradient is None:
            continue
        for member, part in zip(chunk.members, gradient.chunk(len(chunk.members)), strict=True):
            target[chunk.span, work.rows(member)[kind]] = part
