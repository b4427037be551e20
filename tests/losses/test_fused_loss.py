"""The compiled image loss against plain torch in float64."""

from __future__ import annotations

import math
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
import torch

from gausim.core import ConfigError
from gausim.kernels.compiled import torch_only
from gausim.kernels.image_loss import FAST, blur_moments, gather_row, spread_along_width, ssim_slopes
from gausim.losses import ImageLoss

# A sum over as many pixels as a full register holds: an addition, or one fused with its product (which of the two LLVM
# takes differs between processors).
NEON = r"\bf(?:add|ml[as])\s+v\d+\.4s"
PACKED = {"x86_64": r"\bv(?:add|fn?m(?:add|sub)\d+)ps\s[^\n]*%[yz]mm", "aarch64": NEON, "arm64": NEON}


def pair(states: int, views: int, height: int, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(height * width)
    shape = (states, views, height, width, 3)
    return torch.rand(shape, generator=generator), torch.rand(shape, generator=generator)


def agree(loss: ImageLoss, prediction: torch.Tensor, target: torch.Tensor) -> None:
    values, gradient = loss.value_and_gradient(prediction, target)
    expected, slope = loss.value_and_gradient(prediction.double(), target.double())
    assert values.dtype == gradient.dtype == torch.float32
    torch.testing.assert_close(values.double(), expected, rtol=2e-6, atol=0)
    assert float((gradient - slope).norm()) <= 1e-6 * float(slope.norm())


SIZES = [(17, 23, 5), (6, 40, 5), (33, 7, 5), (5, 5, 5), (9, 8, 3), (21, 11, 11)]  # height, width, window


@pytest.mark.parametrize(("height", "width", "window"), SIZES)
@pytest.mark.parametrize("balance", [0.9, 0.0, 1.0])
def test_value_and_gradient_equal_torch_in_float64(height: int, width: int, window: int, balance: float) -> None:
    agree(ImageLoss(balance=balance, window=window), *pair(3, 2, height, width))


def test_the_oracle_is_the_derivative_of_its_value() -> None:
    prediction, target = (x.double() for x in pair(1, 2, 6, 7))
    prediction.requires_grad_(True)
    loss = ImageLoss(pixels=84)
    assert torch.autograd.gradcheck(lambda x: loss(x, target), (prediction,), atol=1e-6)


@pytest.mark.parametrize("corner", [(0, 0), (0, -1), (-1, 0), (-1, -1), (2, 20), (10, 1)])
@pytest.mark.parametrize("which", [0, 1])
def test_one_coloured_pixel_at_a_border(corner: tuple[int, int], which: int) -> None:
    images = [torch.zeros(1, 1, 19, 31, 3), torch.zeros(1, 1, 19, 31, 3)]
    images[which][0, 0, corner[0], corner[1], 1] = 0.7
    agree(ImageLoss(), *images)


def test_objects_that_touch_no_border_or_some() -> None:
    for rows, columns in ((slice(10, 20), slice(12, 30)), (slice(0, 9), slice(25, 40)), (slice(30, 33), slice(3, 4))):
        prediction, target = pair(2, 1, 33, 40)
        inside = torch.zeros(33, 40, 1)
        inside[rows, columns] = 1
        agree(ImageLoss(), prediction * inside, (target * inside).roll(2, 2))


def test_all_black_costs_exactly_nothing() -> None:
    black = torch.zeros(2, 2, 12, 13, 3)
    values, gradient = ImageLoss().value_and_gradient(black, black)
    assert torch.equal(values, torch.zeros(2)) and torch.equal(gradient, black)


def test_nothing_comes_from_beyond_the_reach_of_the_window() -> None:
    prediction, target = torch.zeros(1, 1, 40, 40, 3), torch.zeros(1, 1, 40, 40, 3)
    prediction[0, 0, 18:22, 10:14] = 0.5
    gradient = ImageLoss().value_and_gradient(prediction, target)[1][0, 0]
    inside = torch.zeros(40, 40, dtype=torch.bool)
    inside[14:26, 6:18] = True
    assert float(gradient[~inside].abs().max()) == 0.0
    assert float(gradient[14:26, 6:18].abs().amax(-1).min()) > 0.0


@pytest.fixture
def torch_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def test_bits_do_not_depend_on_the_number_of_threads(torch_threads: None) -> None:
    images = pair(5, 3, 40, 37)
    results = []
    for threads in (1, 2, 4):
        torch.set_num_threads(threads)
        results.append(ImageLoss().value_and_gradient(*images))
    for values, gradient in results[1:]:
        assert torch.equal(values, results[0][0]) and torch.equal(gradient, results[0][1])


def test_inputs_need_not_be_contiguous() -> None:
    prediction, target = pair(2, 2, 18, 15)
    strided = prediction.movedim(-1, 2).contiguous().movedim(2, -1)
    spread = target[:1].expand(2, -1, -1, -1, -1)
    assert not strided.is_contiguous() and not spread.is_contiguous()
    whole = ImageLoss().value_and_gradient(prediction, spread.contiguous())
    parts = ImageLoss().value_and_gradient(strided, spread)
    assert torch.equal(whole[0], parts[0]) and torch.equal(whole[1], parts[1])


def test_backward_scales_the_gradient_and_leaves_it_whole() -> None:
    prediction, target = pair(3, 1, 14, 15)
    _, slope = ImageLoss().value_and_gradient(prediction, target)
    prediction.requires_grad_(True)
    loss = ImageLoss()(prediction, target)
    weights = torch.tensor([1.0, -2.0, 0.0])
    for _ in range(2):  # twice through one graph
        (gradient,) = torch.autograd.grad(loss, prediction, weights, retain_graph=True)
        torch.testing.assert_close(gradient, slope * weights[:, None, None, None, None], rtol=0, atol=0)


def test_float32_on_the_cpu_is_compiled_unless_switched_off() -> None:
    images = pair(1, 1, 16, 17)
    compiled = ImageLoss().value_and_gradient(*images)[1]
    with torch_only():
        plain = ImageLoss().value_and_gradient(*images)[1]
    assert not torch.equal(compiled, plain)  # other roundings
    torch.testing.assert_close(compiled, plain, rtol=1e-3, atol=1e-3 * float(plain.abs().max()))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_prediction_that_is_not_finite_gives_such_a_loss(value: float) -> None:
    prediction, target = pair(1, 1, 12, 12)
    prediction[0, 0, 5, 6, 2] = value
    assert not torch.isfinite(ImageLoss().value_and_gradient(prediction, target)[0]).any()


@pytest.mark.parametrize("double", [False, True])
def test_images_smaller_than_the_window_are_refused(double: bool) -> None:
    small = torch.zeros(1, 1, 4, 20, 3, dtype=torch.float64 if double else torch.float32)
    with pytest.raises(ConfigError, match=r"20x4 pixels are smaller than the SSIM window of 5"):
        ImageLoss()(small, small)


@pytest.mark.slow
def test_the_process_that_compiles_gives_the_bits_of_later_ones(tmp_path: Path) -> None:
    code = """
import hashlib, torch
from gausim.losses import ImageLoss
x, y = torch.rand(2, 1, 2, 40, 37, 3, generator=torch.Generator().manual_seed(0))
values, gradient = ImageLoss().value_and_gradient(x, y)
print(hashlib.sha256(values.numpy().tobytes() + gradient.numpy().tobytes()).hexdigest())
"""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    runs = [subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
            for _ in range(2)]  # fmt: skip
    assert list(tmp_path.rglob("*.nbc"))  # the second one had something to load
    assert len(runs[0].stdout) > 60 and runs[0].stdout == runs[1].stdout


def packed_sums(kernel: Any, arguments: tuple[Any, ...]) -> int:
    # A fresh compilation: numba does not show the code of functions that it loads from its cache.
    fresh = numba.njit(nogil=True, fastmath=FAST, error_model="numpy")(kernel.py_func)
    fresh(*arguments)
    (code,) = fresh.inspect_asm().values()
    return len(re.findall(PACKED[platform.machine()], code))


@pytest.mark.skipif(platform.machine() not in PACKED, reason="names of vector instructions unknown here")
def test_inner_loops_are_vector_instructions(monkeypatch: pytest.MonkeyPatch) -> None:
    taps, rows = (np.float32(0.2),) * 5, (np.uint64(0),) * 5
    image, maps, slopes = np.zeros(300, np.float32), np.zeros((5, 90), np.float32), np.zeros((3, 102), np.float32)
    spread, one = np.zeros((5, 3, 90), np.float32), np.float32(1)
    calls = {  # arguments, and how many sums one step of the loop needs: five taps are four sums
        blur_moments: ((image, image, rows, taps, maps, 6), 5 * 4),
        ssim_slopes: ((maps, taps, slopes, 12), 5 * 4),
        spread_along_width: ((slopes, taps, spread[0]), 4),
        gather_row: ((spread, rows, taps, image[:78], image[:78], one, one, image[:78]), 3 * 4 + 2),
    }
    for kernel, (arguments, least) in calls.items():
        assert packed_sums(kernel, arguments) >= least, kernel.py_func.__name__
    monkeypatch.setattr(numba.config, "LOOP_VECTORIZE", 0)  # the check notices loops that are not
    assert [packed_sums(kernel, arguments) for kernel, (arguments, _) in calls.items()] == [0] * len(calls)
