from __future__ import annotations

import torch

from gausim.data.images import composite
from gausim.kernels.operations import plain_forms


def test_compiled_and_torch_give_the_same_bits_for_every_value() -> None:
    colour, alpha = torch.arange(256).repeat(256), torch.arange(256).repeat_interleave(256)
    frames = torch.stack((colour, 255 - colour, colour // 2, alpha), -1).to(torch.uint8).reshape(2, 128, 256, 4)
    compiled = composite(frames)
    with plain_forms():
        plain = composite(frames)
    assert all(torch.equal(a, b) for a, b in zip(compiled, plain, strict=True))
    assert float(compiled[0].max()) == 1.0


def test_strided_frames() -> None:
    frames = torch.randint(0, 256, (3, 5, 7, 4), generator=torch.Generator().manual_seed(0)).to(torch.uint8)
    strided = frames.transpose(0, 1)
    assert not strided.is_contiguous()
    for a, b in zip(composite(strided), composite(strided.contiguous()), strict=True):
        assert torch.equal(a, b)
    assert composite(frames[:0])[0].shape == (0, 5, 7, 3)
