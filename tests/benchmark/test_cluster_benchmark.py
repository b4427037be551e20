from __future__ import annotations

import torch

from gausim.benchmark import cluster
from gausim.benchmark.harness import Options


def test_every_size_reports_its_count_and_its_speed() -> None:
    rows = cluster.run(Options(torch.device("cpu"), quick=True, rounds=1))
    found = {(row.case, row.metric): row.value for row in rows}
    for count in cluster.SIZES[True]:
        case = f"{count} kernels"
        assert found[case, "clusters ratio"] == 1.0 and found[case, "time ratio"] > 0
        assert 0 < found[case, "clusters"] < count
    assert len(found) == len(rows)
