import numpy as np
import torch

from gausim.nn.normaliser import RunningNormaliser, gathering_nothing


def _chunks() -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    scale, shift = torch.tensor([1.0, 5.0, 0.2, 1.0, 1.0]), torch.tensor([0.0, 30.0, -2.0, 4.0, 0.0])
    return [torch.randn(n, 5, generator=generator) * scale + shift for n in (7, 30, 13)]


def test_statistics_are_of_everything_absorbed_up_to_the_limit() -> None:
    normaliser, chunks = RunningNormaliser(3), _chunks()
    for chunk in chunks:
        normaliser(chunk)
        normaliser.absorb()
    out = normaliser(chunks[-1])
    seen = torch.cat(chunks).double().numpy()[:, :3]
    expected = (chunks[-1].double().numpy()[:, :3] - seen.mean(0)) / seen.std(0)
    np.testing.assert_allclose(out[:, :3].numpy(), expected, atol=2e-5)
    assert torch.equal(out[:, 3:], chunks[-1][:, 3:])  # what lies behind the first `size` columns passes
    normaliser, chunks = RunningNormaliser(3, max_updates=2), _chunks()
    for chunk in chunks:
        normaliser(chunk)
        normaliser.absorb()
    assert int(normaliser.updates) == 2 and float(normaliser.count) == 37


def test_it_is_one_function_between_updates_and_never_divides_by_zero() -> None:
    normaliser, chunks = RunningNormaliser(3), _chunks()
    assert torch.equal(normaliser(chunks[0]), chunks[0])  # nothing is known yet
    normaliser.absorb()
    first = normaliser(chunks[1])
    normaliser(chunks[2])
    assert torch.equal(normaliser(chunks[1]), first)
    normaliser.absorb()
    assert not torch.allclose(normaliser(chunks[1]), first)
    normaliser = RunningNormaliser(2, floor=0.25)
    normaliser(torch.full((6, 3), 3.0))
    normaliser.absorb()
    out = normaliser.eval()(torch.tensor([[3.0, 3.0, 3.0], [3.5, 2.5, 1.0]]))
    assert torch.allclose(out, torch.tensor([[0.0, 0.0, 3.0], [2.0, -2.0, 1.0]]), atol=1e-6)


def test_sums_over_parts_are_those_of_the_whole() -> None:
    parts, whole, chunks = [RunningNormaliser(3) for _ in range(3)], RunningNormaliser(3), _chunks()
    for part, chunk in zip(parts, chunks, strict=True):
        part(chunk)
    parts[0].gathered.copy_(sum(part.gathered for part in parts))
    whole(torch.cat(chunks))
    for normaliser in (parts[0], whole):
        normaliser.absorb()
    torch.testing.assert_close(parts[0].state_dict(), whole.state_dict(), rtol=1e-12, atol=1e-12)
    assert float(whole.count) == 50 and float(whole.gathered.abs().sum()) == 0.0


def test_evaluation_freezes_and_the_checkpoint_carries_the_statistics() -> None:
    normaliser, chunks = RunningNormaliser(3), _chunks()
    normaliser(chunks[0])
    normaliser.absorb()
    before = {k: v.clone() for k, v in normaliser.state_dict().items()}
    normaliser.eval()
    frozen = normaliser(chunks[1])
    normaliser.absorb()
    assert set(before) == {"count", "total", "squares", "updates"}
    assert all(torch.equal(v, before[k]) for k, v in normaliser.state_dict().items())
    other = RunningNormaliser(3).eval()
    assert not torch.allclose(other(chunks[1]), frozen)
    other.load_state_dict(before)
    assert torch.equal(other(chunks[1]), frozen)


def test_frozen_or_computed_again_it_gathers_nothing() -> None:
    normaliser, chunks = RunningNormaliser(3), _chunks()
    with gathering_nothing([normaliser]):
        normaliser(chunks[0])
    assert float(normaliser.gathered[0]) == 0.0
    normaliser(chunks[0])
    assert float(normaliser.gathered[0]) == 7.0
    normaliser.frozen = True
    with gathering_nothing([normaliser]):
        normaliser(chunks[0])
    normaliser(chunks[0])
    assert float(normaliser.gathered[0]) == 7.0
