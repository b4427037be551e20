"""The edge half of a message-passing layer, in blocks that stay in the cache, with its own backward pass."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from gausim.nn.linear import product

# Numbers per block of edges and thread on the CPU: 512 KiB, so that what one operation writes the next still finds in
# the core's second-level cache. A GPU takes all edges at once: each launch costs it more than the memory traffic.
BLOCK = 1 << 17
# With fewer edges than this, the number of operations is what costs, and autograd's own are fewer.
FEW = 200
NORM_EPS = 1e-5  # of torch.nn.LayerNorm


class EdgeWeights(NamedTuple):
    """Parameters of the edge update of one layer; matrices are (outputs, inputs)."""

    norm_weight: Tensor
    norm_bias: Tensor
    first_weight: Tensor
    first_bias: Tensor
    second_weight: Tensor
    second_bias: Tensor


def edge_update(
    edges: Float[Tensor, "E H"],
    source: Float[Tensor, "N H"],
    destination: Float[Tensor, "N H"],
    edge_index: Int[Tensor, "2 E"],
    weights: EdgeWeights,
    *,
    bf16: bool = False,
) -> tuple[Float[Tensor, "E H"], Float[Tensor, "N H"]]:
    """New edges ``e + W2 silu(W1 norm(e) + b1 + source[s] + destination[d]) + b2`` and their sum per destination.

    Without gradients ``edges`` is overwritten and returned. With gradients only the edges and the argument of silu are
    kept for the backward pass, which recomputes the rest; first derivatives only. On a GPU torch.compile sees the
    operations; on the CPU it calls the blocks as they are, for what it makes of the operations is slower.

    Args:
        edges: the edges' residual stream.
        source: what each node contributes as the source of an edge.
        destination: what each node contributes as the destination of an edge.
        edge_index: (source, destination) per edge; sorted by destination is fastest, any order is right.
        weights: of the layer.
        bf16: of float32 edges the products, and the kept argument of silu, are bfloat16; the stream and all sums stay
            float32.
    """
    low = torch.bfloat16 if bf16 and edges.dtype == torch.float32 else edges.dtype
    if torch.compiler.is_compiling() and edges.device.type != "cpu":
        return _traceable(edges, source, destination, edge_index, weights, low)
    return _blocked(edges, source, destination, edge_index, weights, low)


def _traceable(
    edges: Tensor, source: Tensor, destination: Tensor, edge_index: Tensor, weights: EdgeWeights, low: torch.dtype
) -> tuple[Tensor, Tensor]:
    """The same in differentiable operations, for a compiler, which fuses them, and for few edges."""
    normed = nn.functional.layer_norm(edges, edges.shape[1:], weights.norm_weight, weights.norm_bias, NORM_EPS)
    hidden = nn.functional.linear(normed.to(low), weights.first_weight.to(low), weights.first_bias.to(low))
    hidden = hidden + source.to(low).index_select(0, edge_index[0])
    hidden = hidden + destination.to(low).index_select(0, edge_index[1])
    message = nn.functional.linear(
        nn.functional.silu(hidden), weights.second_weight.to(low), weights.second_bias.to(low)
    )
    new = edges + message
    return new, torch.zeros_like(source, dtype=edges.dtype).index_add(0, edge_index[1], new)


@torch.compiler.disable
def _blocked(
    edges: Tensor, source: Tensor, destination: Tensor, edge_index: Tensor, weights: EdgeWeights, low: torch.dtype
) -> tuple[Tensor, Tensor]:
    if torch.is_grad_enabled() and len(edges) < FEW:
        return _traceable(edges, source, destination, edge_index, weights, low)
    if torch.is_grad_enabled():
        new, received = _EdgeUpdate.apply(edges, source, destination, edge_index, low, *weights)
        return new, received
    return _update(edges, source, destination, edge_index, weights, low, keep=False)[:2]


def _blocks(edges: Tensor) -> list[slice]:
    count = len(edges)
    if edges.device.type == "cpu":  # blocks of equal size: a short last one would cost as many calls as a full one
        whole = max(1, BLOCK * torch.get_num_threads() // edges.shape[1])
        size = -(-count // max(1, round(count / whole)))
    else:
        size = count
    return [slice(start, start + size) for start in range(0, count, max(size, 1))]


def _normed(edges: Tensor, weights: EdgeWeights) -> tuple[Tensor, Tensor, Tensor]:
    """Normalised edges, and mean and reciprocal deviation of each."""
    normed: tuple[Tensor, Tensor, Tensor] = torch.native_layer_norm(
        edges, edges.shape[1:], weights.norm_weight, weights.norm_bias, NORM_EPS
    )
    return normed


def _update(
    edges: Tensor,
    source: Tensor,
    destination: Tensor,
    edge_index: Tensor,
    weights: EdgeWeights,
    low: torch.dtype,
    *,
    keep: bool,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """New edges (written over ``edges`` unless ``keep``), their sums, and the argument of silu if ``keep``."""
    source, destination = source.to(low).contiguous(), destination.to(low).contiguous()
    first, first_bias, second, second_bias = (w.to(low) for w in weights[2:])
    received = torch.zeros_like(source, dtype=edges.dtype)
    kept, new = list[Tensor](), list[Tensor]()
    for block in _blocks(edges):
        start, end = edge_index[0, block], edge_index[1, block]
        ends = source.index_select(0, start).add_(destination.index_select(0, end))
        hidden = product(_normed(edges[block], weights)[0].to(low), first, first_bias, ends)
        message = nn.functional.silu(hidden, inplace=not keep)
        if low == edges.dtype:
            updated = product(message, second, second_bias, edges[block])
        else:
            updated = edges[block] + product(message, second, second_bias)
        received.index_add_(0, end, updated)
        if keep:
            kept.append(hidden)
            new.append(updated)
        else:
            edges[block] = updated
    return (_joined(new, edges), received, _joined(kept, edges.to(low))) if keep else (edges, received, None)


def _joined(blocks: list[Tensor], empty: Tensor) -> Tensor:
    """The blocks one after the other; ``empty`` where there are none."""
    if len(blocks) == 1:  # no copy
        return blocks[0]
    return torch.cat(blocks) if blocks else empty


class _EdgeUpdate(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        edges: Tensor,
        source: Tensor,
        destination: Tensor,
        edge_index: Tensor,
        low: torch.dtype,
        *weights: Tensor,
    ) -> tuple[Tensor, Tensor]:
        new, received, hidden = _update(
            edges, source, destination, edge_index, EdgeWeights(*weights), low, keep=True
        )  # fmt: skip
        ctx.save_for_backward(edges, edge_index, hidden, *weights)
        ctx.node_type = source.dtype
        return new, received

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_new: Tensor, grad_received: Tensor) -> tuple[Tensor | None, ...]:
        edges, edge_index, kept, *parameters = ctx.saved_tensors
        weights, low = EdgeWeights(*parameters), kept.dtype
        first, second = weights.first_weight.to(low), weights.second_weight.to(low)
        grad_edges = torch.empty_like(edges)
        grad_source, grad_destination = (torch.zeros_like(grad_received) for _ in range(2))
        grads = EdgeWeights(*(torch.zeros_like(w) for w in weights))
        for block in _blocks(edges):
            start, end = edge_index[0, block], edge_index[1, block]
            normed, mean, deviation = _normed(edges[block], weights)
            hidden = kept[block]
            grad = grad_received.index_select(0, end).add_(grad_new[block])
            grad_low = grad.to(low)
            grads.second_weight.add_(product(grad_low.t(), nn.functional.silu(hidden).t()))
            grads.second_bias.add_(grad.sum(0))
            inner = torch.ops.aten.silu_backward(product(grad_low, second.t()), hidden)
            grads.first_weight.add_(product(inner.t(), normed.to(low).t()))
            through = product(inner, first.t()).to(edges.dtype)
            inner = inner.to(edges.dtype)
            grad_source.index_add_(0, start, inner)
            grad_destination.index_add_(0, end, inner)
            back, norm_weight, norm_bias = torch.ops.aten.native_layer_norm_backward(
                through, edges[block], edges.shape[1:], mean, deviation, *weights[:2], (True, True, True)
            )
            grads.norm_weight.add_(norm_weight)
            grads.norm_bias.add_(norm_bias)
            torch.add(grad, back, out=grad_edges[block])
        grads.first_bias.add_(grad_destination.sum(0))
        return grad_edges, grad_source.to(ctx.node_type), grad_destination.to(ctx.node_type), None, None, *grads
