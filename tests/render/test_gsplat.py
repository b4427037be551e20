"""The choice of a renderer, and gsplat behind it."""

import importlib.util
import logging
import sys
from collections.abc import Callable, Iterator
from types import ModuleType

import pytest
import torch

from benchmarks.reference_renderer import ReferenceRenderer
from gausim.core import ConfigError, Rendered
from gausim.render import auto
from gausim.render import gsplat as backend
from gausim.render.auto import AutoRenderer, chosen
from gausim.render.cpu import CpuRenderer
from gausim.render.gsplat import GsplatRenderer
from gausim.render.limits import NEAR

REASON = "gsplat is not installed (pip install 'gausim[gpu]')"


@pytest.fixture(autouse=True)
def first_time(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    """As in a new process."""
    caplog.set_level(logging.INFO, "gausim")
    chosen.cache_clear()
    yield
    chosen.cache_clear()


def test_on_the_cpu_it_is_the_cpu_renderer(inputs: Callable, caplog: pytest.LogCaptureFixture) -> None:
    given = inputs(2, 2, 80, (34, 22)).to(torch.float32)
    images, deformation_gradients = given.draw_with_gradients(AutoRenderer(threads=2))
    expected, expected_gradients = given.draw_with_gradients(CpuRenderer(threads=2))
    assert torch.equal(images.rgb, expected.rgb) and torch.equal(images.alpha, expected.alpha)
    assert all(torch.equal(a, b) for a, b in zip(deformation_gradients, expected_gradients, strict=True))
    said = [record.getMessage() for record in caplog.records if "render=auto" in record.getMessage()]
    assert len(said) == 1 and "by the CPU renderer, not by gsplat: " in said[0]


@pytest.mark.parametrize(("reason", "choice"), [(None, "gsplat"), (REASON, "cpu")])
def test_on_cuda_it_is_gsplat_or_says_why_not(reason, choice, monkeypatch, caplog) -> None:
    asked = []
    monkeypatch.setattr(auto.gsplat, "unavailable", lambda: asked.append(1) or reason)
    assert [chosen("cuda"), chosen("cuda")] == [choice, choice]
    assert len(asked) == 1 and len(caplog.records) == 1
    message = caplog.records[0].getMessage()
    assert "\n" not in message
    assert caplog.records[0].levelno == (logging.INFO if reason is None else logging.WARNING)
    assert ("by gsplat on the GPU" if reason is None else f"slow, because {REASON}.") in message


@pytest.mark.gpu
def test_gpu_tensors_without_gsplat_are_drawn_on_the_cpu_and_return(inputs, monkeypatch) -> None:
    monkeypatch.setattr(auto.gsplat, "unavailable", lambda: REASON)
    given = inputs(2, 2, 80, (34, 22)).to(torch.float32)
    expected, expected_gradients = given.draw_with_gradients(CpuRenderer())
    images, deformation_gradients = given.to("cuda").draw_with_gradients(AutoRenderer())
    assert images.rgb.device.type == "cuda" and torch.equal(images.rgb.cpu(), expected.rgb)
    for value, truth in zip(deformation_gradients, expected_gradients, strict=True):
        assert value.device.type == "cuda"
        torch.testing.assert_close(value.cpu(), truth)


def rasterization(
    *, means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane, radius_clip, eps2d, packed,
    backgrounds, covars,
):  # fmt: skip
    """gsplat 1.5.3's function of that name: its arguments, its checks of shapes, its reading of the covariances."""
    batch, count, views = means.shape[:-2], means.shape[-2], viewmats.shape[-3]
    assert quats is None and scales is None and (near_plane, radius_clip, eps2d, packed) == (NEAR, 0.0, 0.3, False)
    assert means.shape == (*batch, count, 3) and covars.shape == (*batch, count, 3, 3)
    assert opacities.shape == (*batch, count) and colors.shape == (*batch, views, count, 3)
    assert viewmats.shape == (*batch, views, 4, 4) and Ks.shape == (*batch, views, 3, 3)
    assert backgrounds.shape == (*batch, views, 3)
    upper = covars.triu()
    given = means, upper + upper.mT.tril(-1), colors, opacities, viewmats, Ks, (width, height)
    drawn = ReferenceRenderer()(*given)
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


def test_states_views_and_empty_scenes_reach_gsplat(inputs: Callable, stand_in: ModuleType) -> None:
    given = inputs(2, 3, 80, (34, 22)).to(torch.float32)
    arguments = (*given.tensors[:4], given.viewmats, given.Ks, given.size)
    images = GsplatRenderer()(*arguments, background=given.background)
    assert_same(images, ReferenceRenderer()(*arguments, background=given.background), 1e-6)
    assert_same(GsplatRenderer()(*arguments), ReferenceRenderer()(*arguments), 1e-6)  # on black
    # gsplat itself would divide by their number.
    given = inputs(2, 3, 4, (10, 6)).to(torch.float32)
    none = [x[:, :0] for x in (given.means, given.covars)] + [given.colors[:, :, :0], given.opacities[:, :0]]
    none[2].requires_grad_()
    images = GsplatRenderer()(*none, given.viewmats, given.Ks, given.size, background=given.background)
    assert torch.equal(images.rgb.detach(), given.background.expand(2, 3, 6, 10, 3))
    assert float(images.alpha.detach().abs().max()) == 0
    images.rgb.sum().backward()


def test_gradients_come_back_whole(inputs: Callable, stand_in: ModuleType) -> None:
    """Of the covariances in particular: gsplat reads one triangle, the gradient belongs to both."""
    given = inputs(2, 2, 60, (34, 22)).to(torch.float32)
    _, found = given.draw_with_gradients(GsplatRenderer())
    _, expected = given.draw_with_gradients(ReferenceRenderer())
    for value, truth in zip(found, expected, strict=True):
        assert float(truth.norm()) > 0
        torch.testing.assert_close(value, truth, atol=1e-5 * float(truth.abs().max()), rtol=1e-4)
    torch.testing.assert_close(found[1], found[1].mT)


def test_what_gsplat_cannot_draw_is_refused(inputs: Callable, stand_in: ModuleType) -> None:
    with pytest.raises(ConfigError, match="means as float32 on a CUDA device, got torch.float64"):
        inputs(2, 2, 5, (8, 8)).to(torch.float64).draw(GsplatRenderer())


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
