from __future__ import annotations

import pytest
import torch

from gausim.benchmark import Options, Row
from gausim.benchmark.network import run, useful_flops
from gausim.nn.meshgraphnet import MeshGraphNet


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    return run(Options(torch.device("cpu"), quick=True, rounds=1))


def test_every_variant_is_compared_with_the_textbook_form(rows: list[Row]) -> None:
    values = {(row.case.split(", ")[-1], row.metric): row.value for row in rows}
    assert len(values) == len(rows)
    for name in ("split fp32", "split bf16", "checkpointed fp32"):
        for metric in ("forward", "forward + backward", "kept for the backward pass"):
            ratio = values[name, metric] / values["naive", metric]
            assert values[name, f"{metric} / naive"] == pytest.approx(ratio) and ratio > 0
    assert values["checkpointed fp32", "kept for the backward pass / naive"] < 0.5
    assert values["split fp32", "forward, useful FLOP/s"] > 0
    assert not any("compiled" in row.case for row in rows)


def test_useful_operations_counted_by_hand() -> None:
    network = MeshGraphNet(node_features=3, edge_features=2, outputs=5, hidden=8, layers=2)
    nodes, edges = 10, 30
    encoders = nodes * (3 * 8 + 8 * 8) + edges * (2 * 8 + 8 * 8)
    layer = nodes * (8 * 16 + 16 * 8 + 8 * 8) + edges * (8 * 8 + 8 * 8)
    decoder = nodes * (8 * 4 + 4 * 2 + 2 * 5)
    forward, backward = useful_flops(network, nodes, edges)
    assert forward == 2 * (encoders + 2 * layer + decoder)
    assert backward == 2 * forward - 2 * (nodes * 3 * 8 + edges * 2 * 8)
