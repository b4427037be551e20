"""The page that plays a motion, in a real browser: its pictures are those of our renderer, its controls work."""

import base64
import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.chromium import Page, chromium, needs_chromium
from helpers.plain import unit_motion, unit_scene
from PIL import Image

from gausim.io.player import save_player
from gausim.ops.orbit import orbit_cameras
from gausim.render.draw import film
from gausim.render.reference import ReferenceRenderer

pytestmark = [needs_chromium, pytest.mark.slow]
SIZE = (480, 320)


def shown(page: Page, time: float) -> np.ndarray:
    """The picture at a time [frames]."""
    address = page.run(f"(player.show({time}), player.canvas.toDataURL('image/png'))")
    with Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))) as image:
        return np.asarray(image.convert("RGB")).astype(float)


def test_the_page_shows_what_our_renderer_draws_and_plays(tmp_path: Path) -> None:
    scene = unit_scene(count=300, degree=3)
    scene = replace(scene, sh=0.4 * scene.sh, name="toy")
    made, background = unit_motion(scene, frames=4), torch.tensor([0.2, 0.4, 0.1])
    camera = orbit_cameras(scene.means, azimuths=[50.0], size=SIZE)
    save_player(tmp_path / "m.html", scene, made, camera, background=background)
    expected = film(ReferenceRenderer(), scene, made, camera, background=background)[:, 0].numpy().astype(float)
    with chromium(tmp_path, size=SIZE) as page:
        page.open((tmp_path / "m.html").as_uri())
        page.wait(lambda: page.run("!!window.player && player.drawn > 3"), 30, "pictures")
        assert page.run("document.title") == "toy - gausim"
        for frame in (0, 2, 3):
            error = np.mean((shown(page, frame) - expected[frame]) ** 2)
            assert 10 * np.log10(255**2 / max(error, 1e-9)) > 40, f"frame {frame}: mean square {error}"
        between = np.mean((shown(page, 2.5) - expected[2]) ** 2)
        assert between > 1, "nothing moves between two frames"
        page.press_button("Play")
        page.wait(lambda: page.run("player.playing && player.time < 2.4"), 20, "the loop's beginning")
        page.press_button("Pause")
        before = shown(page, 0)
        page.drag((240, 120), (320, 120))
        assert np.abs(shown(page, 0) - before).mean() > 1, "a drag does not turn"
        page.press_button("View")
        assert np.array_equal(shown(page, 0), before)
        page.run("player.loop.checked = false, player.play(true), 0")
        page.wait(lambda: page.run("!player.playing && player.time === 3"), 20, "the end without a loop")
        assert not page.problems, page.problems
        assert page.requests == [(tmp_path / "m.html").as_uri()]
