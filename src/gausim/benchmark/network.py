"""Benchmark of the graph network: time against the textbook form, fraction of the peak, memory of training."""

from __future__ import annotations

import functools
import os
import shutil
import sys
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gausim.benchmark.harness import Options, Row, medians, peak_saved_bytes, torch_threads
from gausim.benchmark.peaks import peaks
from gausim.nn.meshgraphnet import MeshGraphNet

NODE_FEATURES, EDGE_FEATURES, OUTPUTS = 40, 20, 11
NAIVE = "the textbook form in fp32"


def naive_network(
    network: MeshGraphNet,
    node_features: Float[Tensor, "N Cn"],
    edge_features: Float[Tensor, "E Ce"],
    edge_index: Int[Tensor, "2 E"],
) -> Float[Tensor, "N Co"]:
    """The function of ``network``, with its weights, in plain differentiable torch.

    The edge update has one linear layer on the concatenation [edge, source, destination] (Pfaff et al. 2021, equation
    1), whose matrix is composed of the three of the split form. Options of ``network`` have no effect.
    """
    nodes, edges = _mlp(network.node_encoder, node_features), _mlp(network.edge_encoder, edge_features)
    source, destination = edge_index
    layers: Iterable[Any] = network.processor
    for layer in layers:
        normed = layer.node_norm(nodes)
        weight = torch.cat((layer.from_edge.weight, *layer.from_nodes.weight.chunk(2)), 1)
        joined = (layer.edge_norm(edges), normed.index_select(0, source), normed.index_select(0, destination))
        hidden = nn.functional.linear(torch.cat(joined, 1), weight, layer.from_edge.bias)
        edges = edges + _linear(layer.edge_out, nn.functional.silu(hidden))
        received = torch.zeros_like(nodes).index_add(0, destination, edges)
        nodes = nodes + _mlp(layer.node, torch.cat((normed, received), 1))
    return _mlp(network.decoder, network.norm(nodes))


def _linear(layer: nn.Linear, inputs: Tensor) -> Tensor:
    return nn.functional.linear(inputs, layer.weight, layer.bias)


def _mlp(layers: nn.Sequential, inputs: Tensor) -> Tensor:
    for layer in layers:
        inputs = _linear(layer, inputs) if isinstance(layer, nn.Linear) else layer(inputs)
    return inputs


class Size(NamedTuple):
    """Size of graph and network; by default the fine level of the paper's scene with up to 16 + 16 neighbours."""

    nodes: int = 1203
    edges: int = 30_000
    layers: int = 16
    hidden: int = 128


def run(options: Options) -> list[Row]:
    """Forward and forward + backward of every variant, ratios to the textbook form, and memory of the graph.

    Fraction of the peak: useful operations (:func:`useful_flops`) per second over the rate of torch's float32 matrix
    product (:func:`gausim.benchmark.peaks.peaks`). It may exceed 1, as bfloat16 is faster than float32.
    """
    size = Size(nodes=60, edges=700, layers=3, hidden=16) if options.quick else Size()
    with torch_threads(options.threads):
        inputs = _graph(size, options.device)
        networks = _networks(size, options)
        calls: dict[str, Callable[[], Tensor]] = {
            "naive": functools.partial(naive_network, networks["split fp32"], *inputs),
            **{name: functools.partial(network, *inputs) for name, network in networks.items()},
        }
        forward = medians({name: functools.partial(_forward, call) for name, call in calls.items()}, options)
        parameters = {name: list(networks.get(name, networks["split fp32"]).parameters()) for name in calls}
        both = medians({n: functools.partial(_gradients, call, parameters[n]) for n, call in calls.items()}, options)
        kept = {name: float(peak_saved_bytes(call)) for name, call in calls.items() if not name.startswith("compiled")}
        gemm = peaks(options).gemm
    work = useful_flops(networks["split fp32"], size.nodes, size.edges)
    rows = []
    for name in calls:
        case = f"network {size.nodes} nodes, {size.edges} edges, {size.layers} x {size.hidden}, {name}"
        for metric, values, scale, unit, flops in (
            ("forward", forward, 1e3, "ms", work[0]),
            ("forward + backward", both, 1e3, "ms", sum(work)),
            ("kept for the backward pass", kept, 2**-20, "MiB", None),
        ):
            if name not in values:
                continue
            rows.append(Row(case, metric, scale * values[name], unit))
            if name != "naive":
                rows.append(Row(case, f"{metric} / naive", values[name] / values["naive"], "x", NAIVE))
            if flops and name != "naive" and "checkpointed" not in name:
                speed = flops / values[name] / gemm
                rows.append(Row(case, f"{metric}, useful FLOP/s", speed, "1", "fp32 GEMM peak"))
    return rows


def useful_flops(network: MeshGraphNet, nodes: int, edges: int) -> tuple[float, float]:
    """Floating-point operations of the linear layers in one forward pass, and in one backward pass.

    A layer of ``rows`` rows takes ``2 rows inputs outputs`` forward and twice that backward (gradients of its inputs
    and of its matrix), except that the encoders' inputs need no gradient. The split form is counted, without the
    products that the textbook form repeats per edge, norms, activations, gathers and recomputation.
    """
    forward = backward = 0.0
    for name, layer in network.named_modules():
        if isinstance(layer, nn.Linear):
            on_edges = any(part in name for part in ("edge_encoder", "from_edge", "edge_out"))
            work = 2.0 * (edges if on_edges else nodes) * layer.weight.numel()
            forward += work
            backward += work if name.endswith("encoder.0") else 2.0 * work
    return forward, backward


def _graph(size: Size, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    ends = torch.randint(0, size.nodes, (2, size.edges), generator=generator)
    ends[1] = ends[1].sort().values
    nodes = torch.randn(size.nodes, NODE_FEATURES, generator=generator)
    edges = torch.randn(size.edges, EDGE_FEATURES, generator=generator)
    return nodes.to(device), edges.to(device), ends.to(device)


def _networks(size: Size, options: Options) -> dict[str, MeshGraphNet]:
    """The variants by name, all with the same weights."""
    torch.manual_seed(0)
    build = functools.partial(
        MeshGraphNet,
        node_features=NODE_FEATURES,
        edge_features=EDGE_FEATURES,
        outputs=OUTPUTS,
        hidden=size.hidden,
        layers=size.layers,
    )
    networks = {
        "split fp32": build(),
        "split bf16": build(precision="bf16"),
        "checkpointed fp32": build(checkpoint=True),
    }
    if not options.quick:
        if options.device.type == "cuda" or shutil.which(os.environ.get("CXX") or "g++"):
            networks["compiled fp32"] = build(compile=True)
            networks["compiled bf16"] = build(precision="bf16", compile=True)
        else:
            print("network: no C++ compiler was found, so the compiled variants are left out.", file=sys.stderr)
    for network in networks.values():
        network.load_state_dict(networks["split fp32"].state_dict())
        network.to(options.device)
    return networks


@torch.no_grad()
def _forward(call: Callable[[], Tensor]) -> Tensor:
    return call()


def _gradients(call: Callable[[], Tensor], parameters: list[nn.Parameter]) -> object:
    return torch.autograd.grad(call().square().sum(), parameters)
