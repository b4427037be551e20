"""`gausim.load`: the ten lines of the documentation, run as they stand there."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch

import gausim
from gausim.core import ConfigError, DataError
from gausim.ops.orbit import orbit_cameras

ROOT = Path(__file__).resolve().parents[1]


def test_the_example_of_the_documentation(played, tmp_path: Path, monkeypatch) -> None:
    text = (ROOT / "docs" / "reference" / "python.md").read_text()
    code = re.search(r"```python\n(import gausim\n.*?)```", text, re.DOTALL)
    assert code is not None
    lines = [line for line in code[1].splitlines() if line.strip()]
    assert len(lines) <= 10
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile("\n".join(lines), "python.md", "exec"), names)
    sim, image = names["sim"], names["image"]
    assert isinstance(image, np.ndarray) and image.dtype == np.uint8 and image.shape == (32, 32, 3) and image.any()
    assert (tmp_path / "push.json").is_file()
    recorded = sim.trajectory
    again = gausim.load(played.run_dir).replay("push.json")
    for name in ("positions", "deformation_gradients"):
        assert torch.equal(getattr(again, name), getattr(recorded, name))


def test_pushes_draws_and_resets(played) -> None:
    sim = gausim.load(played.run_dir, object="toy", sequence="seq_000")
    rest = sim.interaction.scene.means
    still = sim.render()
    sim.apply_force(direction="x", weights=5)
    sim.step(6)
    assert float((sim.frame.positions - rest)[:, 0].max()) > 1e-3
    names, bent = sim.cameras.names, sim.render(background=(1.0, 1.0, 1.0))
    assert bent[0, 0].tolist() == [255] * 3 and still[0, 0].tolist() == [0] * 3
    assert np.array_equal(sim.render(names[1]), sim.render(sim.cameras.select([1])))
    orbit = orbit_cameras(rest, azimuths=[40.0], size=(32, 32))
    assert np.array_equal(sim.render(40), sim.render(orbit)) and sim.render(40).any()
    sim.release()
    assert sim.interaction.acting == ()
    sim.reset()
    assert torch.equal(sim.frame.positions, rest) and np.array_equal(sim.render(), still)
    with pytest.raises(DataError, match="view 'top': expected one of .'cam_0'"):
        sim.render("top")
    with pytest.raises(ConfigError, match="on=head"):
        sim.apply_force("head", direction="x", weights=1)
    with pytest.raises(DataError, match="no object"):
        gausim.load(played.run_dir, object="cup")
