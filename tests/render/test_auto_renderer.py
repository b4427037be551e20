"""render=auto: what it chooses where, and that it says so once."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator

import pytest
import torch

from gausim.core import ConfigError
from gausim.render import auto
from gausim.render.auto import AutoRenderer, chosen
from gausim.render.cpu import CpuRenderer

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


def test_options_reach_the_renderers(inputs: Callable) -> None:
    renderer = AutoRenderer(threads=3, near=0.2)
    assert (renderer.cpu.threads, renderer.cpu.near, renderer.gsplat.near) == (3, 0.2, 0.2)
    with pytest.raises(ConfigError, match="render.near"):
        AutoRenderer(near=0.0)


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
