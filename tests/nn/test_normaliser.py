from __future__ import annotations

import numpy as np
import torch

from gausim.nn.normaliser import RunningNormaliser


def _chunks() -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    scale, shift = torch.tensor([1.0, 5.0, 0.2, 1.0, 1.0]), torch.tensor([0.0, 30.0, -2.0, 4.0, 0.0])
    return [torch.randn(n, 5, generator=generator) * scale + shift for n in (7, 30, 13)]


def test_statistics_are_those_of_everything_seen() -> None:
    normaliser, chunks = RunningNormaliser(3), _chunks()
    for chunk in chunks:
        out = normaliser(chunk)
    seen = torch.cat(chunks).double().numpy()[:, :3]
    expected = (chunks[-1].double().numpy()[:, :3] - seen.mean(0)) / seen.std(0)
    np.testing.assert_allclose(out[:, :3].numpy(), expected, atol=2e-5)
    assert torch.equal(out[:, 3:], chunks[-1][:, 3:])  # what lies behind the first `size` columns passes


def test_evaluation_freezes_and_the_checkpoint_carries_the_statistics() -> None:
    normaliser, chunks = RunningNormaliser(3), _chunks()
    normaliser(chunks[0])
    before = {k: v.clone() for k, v in normaliser.state_dict().items()}
    normaliser.eval()
    frozen = normaliser(chunks[1])
    assert set(before) == {"count", "total", "squares", "updates"}
    assert all(torch.equal(v, before[k]) for k, v in normaliser.state_dict().items())
    other = RunningNormaliser(3).eval()
    assert not torch.allclose(other(chunks[1]), frozen)
    other.load_state_dict(before)
    assert torch.equal(other(chunks[1]), frozen)


def test_constant_features_are_divided_by_the_floor_and_not_by_zero() -> None:
    normaliser = RunningNormaliser(2, floor=0.25)
    normaliser(torch.full((6, 3), 3.0))
    out = normaliser.eval()(torch.tensor([[3.0, 3.0, 3.0], [3.5, 2.5, 1.0]]))
    assert torch.allclose(out, torch.tensor([[0.0, 0.0, 3.0], [2.0, -2.0, 1.0]]), atol=1e-6)


def test_gathering_stops_after_the_limit() -> None:
    normaliser, chunks = RunningNormaliser(3, max_updates=2), _chunks()
    for chunk in chunks:
        normaliser(chunk)
    assert int(normaliser.updates) == 2 and float(normaliser.count) == 37
