"""Fast forms against plain ones, and where compiled code is kept."""

import os
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numba
import pytest
import torch
from torch import Tensor

from gausim.kernels.jit import caching
from gausim.kernels.operations import OPERATIONS, Operation, plain_forms
from gausim.models.template.finite_strain import strain_pull
from gausim.models.template.springs import spring_pull
from gausim.ops.deformation import polar_rotation
from gausim.ops.similarity import gaussian_taps, image_loss
from gausim.render.draw import deformed_appearance


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The temporary folder of the process is another; numba's configuration is as before afterwards."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    yield tmp_path
    monkeypatch.undo()
    numba.config.reload_config()


def nowhere() -> None:
    raise RuntimeError("cannot cache function: no locator available")


def test_compiled_code_is_kept_in_a_private_folder_or_nowhere(temporary: Path, monkeypatch) -> None:
    for place, found in (("/proc/none", False), (str(temporary), True)):
        monkeypatch.setattr(tempfile, "tempdir", place)
        assert caching(nowhere) == found
    (folder,) = temporary.iterdir()
    assert os.environ["NUMBA_CACHE_DIR"] == str(folder) == numba.config.CACHE_DIR
    assert folder.stat().st_mode & 0o077 == 0


def test_a_folder_that_others_could_write_is_not_trusted(temporary: Path, caplog) -> None:
    (temporary / f"gausim-numba-{os.getuid()}").mkdir()
    (temporary / f"gausim-numba-{os.getuid()}").chmod(0o777)
    assert not caching(nowhere)
    assert "NUMBA_CACHE_DIR" in caplog.text


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def pictures(height: int, width: int, box: tuple[slice, slice] = (slice(None), slice(None))) -> tuple[Tensor, Tensor]:
    """Prediction and truth; outside a box both are black, and what is in it is shifted a little in the truth."""
    images = random(2, 3, 2, height, width, 3).sigmoid()
    inside = torch.zeros(height, width, 1, dtype=torch.float64)
    inside[box] = 1
    prediction, target = images * inside
    return prediction, target if box[0] == slice(None) else target.roll((2, 2), (2, 3))


def pixel(which: int, row: int, column: int) -> tuple[Tensor, Tensor]:
    """All black but for one pixel of one image."""
    images = torch.zeros(2, 1, 1, 19, 31, 3, dtype=torch.float64)
    images[which, 0, 0, row, column, 1] = 0.7
    return images[0], images[1]


def deformed(degree: int) -> tuple[Tensor, ...]:
    """Positions, gradients, rotations, covariances and colours; 37 kernels are no multiple of a block of sixteen."""
    gradients, root = torch.eye(3) + 0.3 * random(3, 5, 3, 3), random(37, 3, 3, seed=1)
    rotations = polar_rotation(gradients)
    return random(3, 37, 3), gradients, rotations, root @ root.mT, random(37, (degree + 1) ** 2, 3, seed=2)


def appearance(form: Callable[..., Any], *x: Tensor, trained: bool = False) -> Any:
    """Of a rest scene that is trained as well, or is not."""
    if not trained:
        x = (*x[:3], *(t.detach() for t in x[3:]))
    unit = torch.randint(0, 5, (37,), generator=torch.Generator().manual_seed(3))
    return form(*x[:3], unit, *x[3:], 4 * random(2, 3, seed=4).to(x[0]))


def loss(form: Callable[..., Any], *x: Tensor, window: int = 5, balance: float = 0.9) -> Any:
    return form(*x, gaussian_taps(window), balance=balance, scale=7.0)


def spring_pull_of(form: Callable[..., Any], first: Tensor, second: Tensor, *x: Tensor) -> Any:
    """Of springs, one of which is pressed to its least length at the end."""
    offset = random(7, 3, seed=2).to(first)
    second = torch.cat((second[:, :6], second[:, 6:] * 1e-5 - offset[6:]), 1)
    return form(first, second, offset, offset.norm(dim=-1), *x)


Form, Case = Callable[..., Any], tuple[Operation[..., Any], Callable[..., Any], tuple[Tensor, ...]]
SIZES = [(17, 23, 5), (6, 40, 5), (33, 7, 5), (5, 5, 5), (9, 8, 3), (21, 11, 11)]  # height, width, window
BOXES = [(slice(10, 20), slice(12, 30)), (slice(0, 9), slice(25, 38)), (slice(30, 31), slice(3, 4))]
CORNERS = [(0, 0, 0), (1, 0, -1), (0, -1, 0), (1, -1, -1), (0, 10, 1)]
CASES: dict[str, Case] = {
    **{f"image_loss-{h}-{w}-{n}-{b}": (image_loss, partial(loss, window=n, balance=b), pictures(h, w))
       for (h, w, n), b in zip(SIZES, (0.9, 0.0, 1.0, 0.9, 0.0, 0.9), strict=True)},
    **{f"image_loss-box-{i}": (image_loss, loss, pictures(33, 40, box)) for i, box in enumerate(BOXES)},
    **{f"image_loss-pixel-{i}-{r}-{c}": (image_loss, loss, pixel(i, r, c)) for i, r, c in CORNERS},
    **{f"deformed_appearance-{d}": (deformed_appearance, appearance, deformed(d)) for d in range(4)},
    "strain_pull": (strain_pull, lambda form, *x: form(*x),
                    (*0.3 * random(2, 4, 5, 3, 3), random(5, 2, seed=1).exp(), random(1)[0])),
    "spring_pull": (spring_pull, spring_pull_of, (*0.3 * random(2, 4, 7, 3), random(7, seed=1).exp(), random(1)[0])),
    "deformed_appearance-trained": (deformed_appearance, partial(appearance, trained=True), deformed(1)),
}  # fmt: skip


def test_every_operation_has_a_case() -> None:
    assert {made.__name__ for made, _, _ in CASES.values()} == set(OPERATIONS)


@pytest.mark.parametrize("name", CASES)
def test_fast_form_in_float32_is_the_plain_one_in_float64(name: str) -> None:
    made, call, inputs = CASES[name]
    found = []
    for form, dtype in ((made.fast, torch.float32), (made.plain, torch.float64)):
        leaves = [x.to(dtype).requires_grad_() for x in inputs]
        results = call(form, *leaves)
        results = list(results) if isinstance(results, tuple) else [results]
        slopes = [r for r in results if r.requires_grad]
        if slopes:
            total = sum((r * random(*r.shape, seed=i).to(dtype)).sum() for i, r in enumerate(slopes))
            results += torch.autograd.grad(total, leaves, materialize_grads=True)
        found.append(results)
    assert found[1][0].any() and len(found[0]) == len(found[1])
    for number, (value, truth) in enumerate(zip(*found, strict=True)):
        assert value.dtype is torch.float32, number
        assert float((value - truth).detach().norm()) <= 2e-6 * float(truth.detach().norm()) + 1e-9, number


@pytest.fixture
def torch_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("name", ["image_loss-17-23-5-0.9", "deformed_appearance-2"])
def test_bits_do_not_depend_on_the_number_of_threads(torch_threads: None, name: str) -> None:
    made, call, inputs = CASES[name]
    found = []
    for threads in (1, 2, 4):
        torch.set_num_threads(threads)
        leaves = [x.float().requires_grad_() for x in inputs]
        results = call(made.fast, *leaves)
        if results[0].requires_grad:
            results = (*results, *torch.autograd.grad(sum(r.sum() for r in results), leaves, allow_unused=True))
        found.append(results)
    for other in found[1:]:
        assert all(a is b is None or torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_fast_forms_take_float32_on_the_cpu_and_can_be_switched_off() -> None:
    x = torch.ones(2)
    made: Operation[..., str] = Operation(lambda *_: "plain", "math:fabs")
    vars(made)["fast"] = lambda *_: "fast"
    assert made(x) == made(x, torch.arange(2)) == made(x.requires_grad_()) == "fast"
    assert made(x, x.double()) == made(x.to("meta")) == "plain"
    _, call, inputs = CASES["deformed_appearance-1"]
    given = [x.float() for x in inputs]
    fast, plain = (call(form, *given)[1] for form in (deformed_appearance.fast, deformed_appearance.plain))
    assert not torch.equal(fast, plain)  # other roundings
    with plain_forms(["image_loss"]):
        assert torch.equal(call(deformed_appearance, *given)[1], fast)
        with plain_forms():
            assert torch.equal(call(deformed_appearance, *given)[1], plain)
    assert torch.equal(call(deformed_appearance, *given)[1], fast)
