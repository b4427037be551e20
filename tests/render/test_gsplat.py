"""The CUDA renderer: what it hands to gsplat (a stand-in drawn by the reference), its refusals; on a GPU, parity."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from types import ModuleType

import pytest
import torch

from gausim.core import ConfigError, Rendered
from gausim.render import gsplat as backend
from gausim.render.gsplat import GsplatRenderer
from gausim.render.reference import ReferenceRenderer


def rasterization(
    *, means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane, radius_clip, eps2d, packed,
    backgrounds, covars,
):  # fmt: skip
    """gsplat 1.5.3's function of that name: its arguments, its checks of shapes, its reading of the covariances."""
    batch, count, views = means.shape[:-2], means.shape[-2], viewmats.shape[-3]
    assert quats is None and scales is None and (radius_clip, eps2d, packed) == (0.0, 0.3, False)
    assert means.shape == (*batch, count, 3) and covars.shape == (*batch, count, 3, 3)
    assert opacities.shape == (*batch, count) and colors.shape == (*batch, views, count, 3)
    assert viewmats.shape == (*batch, views, 4, 4) and Ks.shape == (*batch, views, 3, 3)
    assert backgrounds.shape == (*batch, views, 3)
    upper = covars.triu()
    drawn = ReferenceRenderer(near=near_plane)(
        means, upper + upper.mT.tril(-1), colors, opacities, viewmats, Ks, (width, height)
    )
    image = drawn.rgb + (1 - drawn.alpha)[..., None] * backgrounds[..., None, None, :]
    return image, drawn.alpha[..., None], {}


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """A module gsplat whose kernels are the reference's, on a machine that seems to have a CUDA device."""
    package, cuda, kernels = ModuleType("gsplat"), ModuleType("gsplat.cuda"), ModuleType("gsplat.cuda._backend")
    package.__spec__ = importlib.util.spec_from_loader("gsplat", None)
    package.__version__, package.rasterization, kernels._C = "1.5.3+pt24cu124", rasterization, object()
    package.cuda, cuda._backend = cuda, kernels
    for module in (package, cuda, kernels):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(backend, "DEVICE", "cpu")
    return package


def assert_same(images: Rendered, expected: Rendered, atol: float) -> None:
    for name in ("rgb", "alpha"):
        torch.testing.assert_close(getattr(images, name), getattr(expected, name), atol=atol, rtol=0)


def test_states_and_views_reach_gsplat_in_order(inputs: Callable, stand_in: ModuleType) -> None:
    given = inputs(2, 3, 80, (34, 22)).to(torch.float32)
    arguments = (*given.tensors[:4], given.viewmats, given.Ks, given.size)
    images = GsplatRenderer(near=2.3)(*arguments, background=given.background)
    expected = ReferenceRenderer(near=2.3)(*arguments, background=given.background)
    assert_same(images, expected, 1e-6)
    assert_same(GsplatRenderer()(*arguments), ReferenceRenderer()(*arguments), 1e-6)  # another near plane, black
    assert float((expected.alpha - ReferenceRenderer()(*arguments).alpha).abs().max()) > 0.01


def test_gradients_come_back_whole(inputs: Callable, stand_in: ModuleType) -> None:
    """Of the covariances in particular: gsplat reads one triangle, the gradient belongs to both."""
    given = inputs(2, 2, 60, (34, 22)).to(torch.float32)
    _, found = given.draw_with_gradients(GsplatRenderer())
    _, expected = given.draw_with_gradients(ReferenceRenderer())
    for value, truth in zip(found, expected, strict=True):
        assert float(truth.norm()) > 0
        torch.testing.assert_close(value, truth, atol=1e-5 * float(truth.abs().max()), rtol=1e-4)
    torch.testing.assert_close(found[1], found[1].mT)


def test_scene_without_kernels_is_background(inputs: Callable, stand_in: ModuleType) -> None:
    """gsplat itself would divide by their number."""
    given = inputs(2, 3, 4, (10, 6)).to(torch.float32)
    none = [x[:, :0] for x in (given.means, given.covars)] + [given.colors[:, :, :0], given.opacities[:, :0]]
    none[2].requires_grad_()
    images = GsplatRenderer()(*none, given.viewmats, given.Ks, given.size, background=given.background)
    assert torch.equal(images.rgb.detach(), given.background.expand(2, 3, 6, 10, 3))
    assert float(images.alpha.detach().abs().max()) == 0
    images.rgb.sum().backward()


def test_what_gsplat_cannot_draw_is_refused(inputs: Callable, stand_in: ModuleType) -> None:
    with pytest.raises(ConfigError, match="means as float32 on a CUDA device, got torch.float64"):
        inputs(2, 2, 5, (8, 8)).to(torch.float64).draw(GsplatRenderer())
    with pytest.raises(ConfigError, match=r"render.near: expected more than 0, got 0\.0"):
        GsplatRenderer(near=0.0)


def test_it_draws_only_where_all_of_gsplat_is_there(inputs: Callable, stand_in: ModuleType, monkeypatch) -> None:
    assert backend.unavailable() is None
    given, kernels = inputs(2, 2, 5, (8, 8)).to(torch.float32), sys.modules["gsplat.cuda._backend"]
    for change, reason in (
        (lambda: monkeypatch.setattr(kernels, "_C", None), "no CUDA toolkit"),
        (lambda: monkeypatch.delattr(kernels, "_C"), "do not build or load"),
        (lambda: monkeypatch.setattr(stand_in, "__version__", "1.6.0"), "1.6.0, expected 1.5.3"),
        (lambda: monkeypatch.setattr(importlib.util, "find_spec", lambda name: None), "not installed"),
    ):
        change()
        assert reason in str(backend.unavailable())
        with pytest.raises(ConfigError, match=reason):
            given.draw(GsplatRenderer())


@pytest.mark.gpu
@pytest.mark.parametrize("name", ["usual", "big", "tiny", "around_the_camera"])
def test_gpu_images_and_gradients_equal_the_reference(case: Callable, name: str) -> None:
    reason = backend.unavailable()
    if reason is not None:
        pytest.skip(reason)
    given = case(name)
    images, gradients = given.to("cuda", torch.float32).draw_with_gradients(GsplatRenderer())
    expected, true_gradients = given.to(torch.float64).draw_with_gradients(ReferenceRenderer())
    for plane in ("rgb", "alpha"):
        error = (getattr(images, plane).detach().cpu().double() - getattr(expected, plane).detach()).abs()
        # Single pixels may fall on the other side of a threshold (1/255, 1e-4): gsplat's exponential is a fast one.
        assert float(error.quantile(0.99)) < 1e-4 and float(error.max()) < 2e-2, plane
    names = ("means", "covars", "colors", "opacities", "background")
    for of, value, truth in zip(names, gradients, true_gradients, strict=True):
        assert float((value.cpu() - truth).norm() / truth.norm()) < 5e-3, of
