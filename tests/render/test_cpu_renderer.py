"""The compiled renderer against the oracle in float64, and its own promises."""

import itertools
from collections.abc import Callable

import pytest
import torch

from benchmarks.reference_renderer import ReferenceRenderer
from gausim.core import ConfigError, DivergenceError
from gausim.render.cpu import CpuRenderer

CASES = ["usual", "two_bands", "dense", "big", "tiny", "around_the_camera", "off_screen"]
NAMES = ("means", "covars", "colors", "opacities", "background")


@pytest.mark.parametrize("name", CASES)
def test_image_and_gradients_equal_the_reference(case: Callable, name: str) -> None:
    given = case(name)
    images, deformation_gradients = given.to(torch.float32).draw_with_gradients(CpuRenderer(threads=2))
    expected, expected_gradients = given.to(torch.float64).draw_with_gradients(ReferenceRenderer())
    assert float(expected.alpha.detach().max()) > 0.1
    torch.testing.assert_close(images.rgb.double(), expected.rgb, atol=1e-5, rtol=0)
    torch.testing.assert_close(images.alpha.double(), expected.alpha, atol=1e-5, rtol=0)
    for of, value, truth in zip(NAMES, deformation_gradients, expected_gradients, strict=True):
        assert float((value - truth).norm() / truth.norm()) < 1e-4, of


def test_one_view_alone_is_cut_into_more_bands_and_stays_the_same(inputs: Callable) -> None:
    """A single view has nine bands, six views have two each: images agree bit for bit, gradients to rounding."""
    given = inputs(2, 3, 300, (40, 130)).to(torch.float32)
    together, deformation_gradients = given.draw_with_gradients(CpuRenderer(threads=2))
    sums = [torch.zeros_like(x) for x in deformation_gradients]
    g = torch.Generator().manual_seed(5)
    weights = torch.randn(together.rgb.shape, generator=g), torch.randn(together.alpha.shape, generator=g)
    for b, v in itertools.product(range(2), range(3)):
        state, view = slice(b, b + 1), slice(v, v + 1)
        parts = (given.means[state], given.covars[state], given.colors[state, view], given.opacities[state])
        leaves = [x.detach().requires_grad_() for x in (*parts, given.background)]
        cameras = given.viewmats[state, view], given.Ks[state, view]
        alone = CpuRenderer(threads=2)(*leaves[:4], *cameras, given.size, background=leaves[4])
        assert torch.equal(alone.rgb[0, 0], together.rgb[b, v])
        loss = (alone.rgb * weights[0][state, view]).sum() + (alone.alpha * weights[1][state, view]).sum()
        for i, grad in enumerate(torch.autograd.grad(loss, leaves)):
            sums[i][((state,), (state,), (state, view), (state,), ())[i]] += grad
    for value, expected in zip(sums, deformation_gradients, strict=True):
        assert float((value - expected).norm() / expected.norm()) < 1e-5


def test_threads_change_no_bit(inputs: Callable) -> None:
    given = inputs(2, 2, 400, (40, 130)).to(torch.float32)
    images, gradients = given.draw_with_gradients(CpuRenderer(threads=1))
    again, again_gradients = given.draw_with_gradients(CpuRenderer(threads=5))
    assert torch.equal(again.rgb, images.rgb) and torch.equal(again.alpha, images.alpha)
    assert all(torch.equal(a, b) for a, b in zip(again_gradients, gradients, strict=True))


def test_wrong_types_options_and_changed_inputs_are_refused(inputs: Callable) -> None:
    given = inputs(2, 2, 30, (20, 20)).to(torch.float32)
    given.colors.requires_grad_()
    images = given.draw(CpuRenderer(threads=1))
    given.means += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        images.rgb.sum().backward()
    with pytest.raises(ConfigError, match="means as float32"):
        inputs(2, 2, 5, (8, 8)).to(torch.float64).draw(CpuRenderer())
    with pytest.raises(ConfigError, match="threads"):
        CpuRenderer(threads=0)


@pytest.mark.parametrize("name", ["means", "covars", "colors", "opacities"])
def test_numbers_that_are_not_finite_are_refused(inputs: Callable, name: str) -> None:
    given = inputs(2, 2, 30, (20, 20)).to(torch.float32)
    getattr(given, name).reshape(-1)[40] = float("inf" if name == "means" else "nan")
    with pytest.raises(DivergenceError, match="1 of the Gaussians .* of state"):
        given.draw(CpuRenderer(threads=2))
