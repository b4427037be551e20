from __future__ import annotations

import torch

from gausim.benchmark import cluster
from gausim.benchmark.harness import Options


def test_every_size_reports_its_bound_its_count_and_its_speed() -> None:
    rows = cluster.run(Options(torch.device("cpu"), quick=True, rounds=1))
    found = {(row.case, row.metric): row.value for row in rows}
    for count in cluster.SIZES[True]:
        case = f"agglomerative, {count} kernels"
        assert found[case, "clusters ratio"] == 1.0
        assert 0.5 < found[case, "widest cluster"] <= 1 + 1e-9
        assert 0 < found[case, "clusters"] < count
        assert found[f"ball, {count} kernels", "widest cluster"] <= 1 + 1e-9
    assert len(found) == len(rows)
