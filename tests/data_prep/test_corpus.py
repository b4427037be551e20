import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.plain import contents
from scipy import ndimage

if importlib.util.find_spec("mujoco") is None:
    pytest.skip("MuJoCo is not installed (extra 'synth')", allow_module_level=True)

from data_prep.corpus import main
from data_prep.random_bodies import maker
from data_prep.random_bodies.lattice import PINS, body_of, pinned, warped
from data_prep.random_bodies.matter import Matter, Modes, modes_of
from data_prep.random_bodies.motion import FiniteElements
from data_prep.random_bodies.plan import Plan
from data_prep.random_bodies.shapes import SHAPES
from data_prep.synthetic.bodies import Array, Body, tet_volumes
from data_prep.synthetic.bodies import _body as lattice
from data_prep.synthetic.embedding import Embedding
from gausim.core import ConfigError
from gausim.data.corpus import MANIFEST, Corpus

TINY = "--sequences 1 --frames 6 --kernels 60 70 --workers".split()


def beam(length: int, width: int) -> Body:
    """An upright beam of unit cells whose lowest layer is held; it is free from height 1 on."""
    cells = [(i, j, k) for i in range(width) for j in range(width) for k in range(length + 1)]
    return lattice(cells, lambda grid: grid, held_layers=2)


def matter_of(body: Body, young: Array | float = 1.0, poisson_ratio: float = 0.0) -> Matter:
    cells = np.ones(len(body.cells))
    return Matter("even", 1.0, poisson_ratio, young * cells, 2.0 * cells, 0.0 * cells)


def measured_period(body: Body, modes: Modes, x: Array, fps: float) -> float:
    """Seconds between crossings of zero by the motion (F, K, 3) of the cells' middles along the slowest mode."""
    along = middles(body).positions(modes.shapes[0])
    amount = ((x - x[0]) * along).sum((1, 2))
    before = np.flatnonzero((amount[1:-1] * amount[2:]) < 0) + 1
    crossings = before + amount[before] / (amount[before] - amount[before + 1])
    return float(2 * np.diff(crossings).mean() / fps)


def middles(body: Body) -> Embedding:
    return Embedding(body, np.arange(len(body.cells)), np.full((len(body.cells), 3), 0.5))


@pytest.mark.parametrize("kind", SHAPES)
def test_bodies_are_sound(kind: str) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        body = body_of(SHAPES[kind](rng), 120)
        assert body is not None and 100 <= len(body.cells) < 600
        solid = np.zeros(body.grid.max(0) + 1, bool)
        solid[tuple(body.grid.T)] = True
        assert ndimage.label(solid)[1] == 1 and solid.sum() == len(body.cells)
        body = warped(body, 1.7, rng)
        assert tet_volumes(body.nodes, body.tetrahedra).min() > 0 and np.isclose(body.diagonal, 1.7)
        held = [pinned(body, pins, rng) for pins in PINS]
        assert sum(one is not None and 0 < one.held.mean() < 0.6 for one in held) >= 2


def test_slowest_mode_of_a_beam_is_that_of_beam_theory() -> None:
    """Euler and Bernoulli's clamped beam: omega = 1.8751^2 sqrt(E I / (rho A L^4)); linear tetrahedra are stiffer."""
    errors = []
    for width in (2, 4):
        body = beam(10 * width, width)
        body = replace(body, nodes=body.nodes / width)
        exact = 1.8751**2 * np.sqrt(1 / 12 / 2.0 / 10**4)
        errors.append(modes_of(body, matter_of(body), 2).omega[0] / exact - 1)
    assert 0 < errors[1] < 0.5 * errors[0] and errors[1] < 0.1, errors


def test_mujoco_swings_at_the_frequency_of_the_uneven_body() -> None:
    body = beam(8, 2)
    young = np.where(body.nodes[body.cells].mean(1)[:, 2] > 5, 20.0, 1.0)
    matter = matter_of(body, young, 0.3)
    modes = modes_of(body, matter, 3)
    period = 2 * np.pi / modes.omega[0]
    mover = FiniteElements(middles(body), matter, modes, fps=20 / period)
    velocity = modes.shapes[0] / np.abs(modes.shapes[0]).max() * 0.02 * modes.omega[0]
    x, volume = mover.simulate(velocity, 60)
    assert measured_period(body, modes, x, 20 / period) == pytest.approx(period, rel=0.01)
    assert 0.95 < volume <= 1


def test_interrupted_corpus_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    command = [*TINY, "1", "--bodies", "2", "--out"]
    assert main([*command, str(tmp_path / "whole")]) == 0
    original, made = maker.make_body, list[int]()

    def interrupted(plan, number: int):
        if number == 1 and made == [0]:
            raise KeyboardInterrupt
        made.append(number)
        return original(plan, number)

    monkeypatch.setattr(maker, "make_body", interrupted)
    out = tmp_path / "cut"
    assert main([*command, str(out)]) == 130 and not out.exists()
    made.append(-1)
    assert main([*command, str(out)]) == 0 and made == [0, -1, 1]
    assert contents(out) == contents(tmp_path / "whole")


def test_kinds_of_shape_and_material_are_those_asked_for() -> None:
    assert set(SHAPES) == {*Plan().shapes, "bar"}
    plan = Plan(shapes=("bar",), materials=("halves",), cells=(150, 200), sequences=1, frames=4)
    tensors, record = maker.make_body(plan, 0)
    assert (record.shape, record.material) == ("bar", "halves") and len(np.unique(tensors["stiffness"])) == 2
    assert np.ptp(tensors["density"]) == 0
    stiff = tensors["stiffness"] == tensors["stiffness"].max()
    length = tensors["rest"][:, 2]
    assert length[stiff].max() < length[~stiff].min() + 0.1 or length[stiff].min() > length[~stiff].max() - 0.1
    with pytest.raises(ConfigError, match="--shapes: expected one of blob, .* bar, got 'cube'"):
        Plan(shapes=("bar", "cube"))


@pytest.mark.slow
def test_same_bytes_of_any_number_of_processes(tmp_path: Path) -> None:
    for name, workers in (("one", "1"), ("two", "2")):
        command = [*TINY, workers, "--bodies", "4", "--out", str(tmp_path / name)]
        assert main(command) == 0
    one, two = contents(tmp_path / "one"), contents(tmp_path / "two")
    assert one == two and MANIFEST in one
    corpus = Corpus(tmp_path / "one")
    for number in range(4):
        body = corpus.body(number)
        moved = (body.positions - body.rest).norm(dim=-1) / body.record.diagonal
        assert moved.max().item() == pytest.approx(body.record.swing, rel=1e-2)
        assert moved[:, :, body.pinned].max() < 1e-3 and body.pinned.any()
