"""Pages in a real browser: one simulates an object as Python does, and nobody breaks it; one plays a motion."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.bodies import NEURAL, make_model, make_scene
from helpers.chromium import Page, chromium, needs_chromium
from helpers.plain import unit_motion, unit_scene
from PIL import Image

from benchmarks.reference_renderer import ReferenceRenderer
from gausim.compose.page import body_page
from gausim.core import DataError, Trajectory
from gausim.core.state import SimState, initial_sway
from gausim.io.page import Start, save_page
from gausim.io.player import save_player
from gausim.models.rollout.dynamics import SceneDynamics
from gausim.models.step.simulator import GausSim
from gausim.ops.orbit import orbit_cameras
from gausim.render.draw import film

SIZE, FRAMES = (480, 420), 100
PULLS = 1000  # frames
HOSTILE = "</script><script>window.broken=1</script><img src=x onerror='window.broken=1'>\u2028${window.broken=1}"


@pytest.fixture(scope="module", params=["solid", "springs"])
def model(request: pytest.FixtureRequest) -> GausSim:
    scene = replace(make_scene(90), law=request.param)
    return make_model(replace(scene, sh=0.3 * scene.sh), **NEURAL)


def swing(model: GausSim) -> tuple[SimState, list[float]]:
    """A swing, and its modal coordinates one frame before."""
    state = initial_sway(model.scenes[0], 0.06)
    moved = state.previous - state.positions
    return state, torch.einsum("kam,ka->m", model.modal_projection(0), moved).tolist()


def write(model: GausSim, path: Path, *, ceiling: float = 1e9, name: str = "seq", about: str = "text") -> None:
    start = Start(name, swing(model)[1], 30, 20)
    camera = orbit_cameras(model.scenes[0].means, azimuths=[40.0], size=SIZE)
    save_page(path, body_page(model, 0, starts=[start], ceiling=ceiling, about=[(about, about)]), camera)


@contextmanager
def opened(path: Path, size: tuple[int, int] = SIZE) -> Iterator[Page]:
    with chromium(path.parent, size=size) as page:
        page.open(path.as_uri())
        page.wait(lambda: page.run("!!window.page && window.page.drawn > 2"), 60, "pictures")
        page.run("page.play(false); page.adapts = false; page.sharpness = 1; 0")
        yield page
        assert not page.problems, page.problems
        assert page.requests == [path.as_uri()]


def frames_of(page: Page, begin: str, unit: int, accelerations: list[Any]) -> torch.Tensor:
    """Units (F, N, 2, 3, 4) of the frames after ``begin`` under accelerations [scene units / s^2] of one unit."""
    script = f"""(() => {{ const body = page.body, square = page.facts.fps ** 2; {begin};
        return {json.dumps(accelerations)}.map((a) => {{
            body.step(a && body.push([{unit}], a.map((value) => value / square)));
            return [...body.place(body.z)]; }}); }})()"""
    return torch.tensor(page.run(script)).unflatten(1, (-1, 2, 3, 4))


def largest_error(model: GausSim, units: torch.Tensor, expected: Trajectory) -> float:
    """Largest distance of a kernel from where Python has it [diagonals]."""
    scene, batch = model.scenes[0], model.batch((0,))
    unit = batch.members[0].unit_of_kernel
    centres = torch.cat((model.units(batch)[2][-1].rest, torch.zeros(1, 3)))
    rows = units[:, unit, 0]
    moved = (rows[..., :3] @ (scene.means - centres[unit])[..., None])[..., 0] + rows[..., 3]
    return float((moved - expected.positions[1:]).norm(dim=-1).max()) / scene.diagonal


def some_unit(model: GausSim) -> tuple[int, torch.Tensor]:
    """The unit that moves most easily, and the mask of its kernels."""
    unit = int(model.modal_scene(0).motions.square().sum(-1).unflatten(0, (-1, 12)).sum(-1).argmax())
    return unit, model.batch((0,)).members[0].unit_of_kernel == unit


@needs_chromium
@torch.no_grad()
def test_frames_and_pictures_are_those_of_python(model: GausSim, tmp_path: Path) -> None:
    write(model, tmp_path / "p.html")
    scene, (state, _), dynamics = model.scenes[0], swing(model), SceneDynamics(model, correction_scale=0.0)
    unit, mask = some_unit(model)
    pulls = [[300.0 * np.sin(f / 5), 150.0, -100.0 * np.cos(f / 9)] if f < 60 else None for f in range(FRAMES)]

    def force(frame: int) -> torch.Tensor | None:
        pull = pulls[frame]
        return None if pull is None else (mask * dynamics.masses)[:, None] * torch.tensor(pull, dtype=torch.float32)

    free = dynamics.rollout(state, FRAMES)
    forced = dynamics.rollout(SimState(scene.means, scene.means), FRAMES, forces=force)
    assert all(float((t.positions - scene.means).norm(dim=-1).max()) > 0.02 * scene.diagonal for t in (free, forced))
    camera = orbit_cameras(scene.means, azimuths=[40.0], size=SIZE)
    with opened(tmp_path / "p.html") as page:
        for begin, accelerations, expected in (
            ("body.begin(page.facts.starts[0])", [None] * FRAMES, free), ("body.rest()", pulls, forced),
        ):  # fmt: skip
            assert largest_error(model, frames_of(page, begin, unit, accelerations), expected) < 1e-3
        shown = film(ReferenceRenderer(), scene, free.part(slice(0, 13, 4)), camera)[1:, 0].numpy().astype(float)
        page.run("document.getElementById('panel').style.display = 'none'")  # the picture fills the window
        page.run("page.body.begin(page.facts.starts[0]), page.part = 1")
        for number, expected_picture in enumerate(shown):
            four = "for (let i = 0; i < 4; i++) page.body.step(); "
            page.run(four + "page.draw(); page.shot = page.canvas.toDataURL(); 0")
            with Image.open(io.BytesIO(base64.b64decode(page.run("page.shot").split(",")[1]))) as image:
                seen = np.asarray(image.convert("RGB")).astype(float)
            error = np.mean((seen - expected_picture) ** 2)
            assert 10 * np.log10(255**2 / max(error, 1e-9)) > 40, f"frame {4 * number + 4}: mean square {error}"


@needs_chromium
def test_random_pulling_stays_bounded_and_moves_no_pin(model: GausSim, tmp_path: Path) -> None:
    with torch.no_grad():
        ceiling = 2 * float(model.energy(model.batch((0,)), swing(model)[0]))
    write(model, tmp_path / "p.html", ceiling=ceiling)
    unit, _ = some_unit(model)
    with opened(tmp_path / "p.html") as page:
        page.run(f"""window.pulled = (() => {{
            let seed = 1, worst = 0, moved = 0, odd = 0, frame = 0;
            const random = () => (seed = (seed * 16807) % 2147483647) / 2147483647 - 0.5;
            const {{ body, facts }} = page, size = 4 * facts.diagonal;
            const free = Array.from({{ length: facts.units }}, (_, n) => n).filter((n) => page.patch(n).includes(n));
            page.pin({unit});
            const place = [...page.pins.get({unit}).to];
            return (frames) => {{
              for (; frames > 0; frames--, frame++) {{
                if (frame % 40 === 0) {{
                  const at = free[Math.floor((random() + 0.5) * free.length)];
                  page.controls.hand.selectedIndex = frame % 80 ? 1 : 0;
                  page.grab = at === {unit} ? null : page.held_by({{ unit: at }}, {{}});
                  if (page.grab) page.grab.way = [0, 0, 0].map(() => size * random());
                }}
                if (frame % 97 === 0) page.slide("damping", 6 * random());
                page.advance();
                for (const from of [body.before, body.z]) {{
                  worst = Math.max(worst, body.energy(body.z, from) / body.ceiling);
                }}
                odd += body.place(body.z).some((value) => !Number.isFinite(value));
                moved = Math.max(moved, ...body.displacement({unit}).map((value, i) => Math.abs(value - place[i])));
              }}
              return {{ worst, moved: moved / facts.diagonal, odd, limited: body.limited }};
            }};
        }})(); 0""")
        for _ in range(PULLS // 250):
            found = page.run("pulled(250)")
        assert found["odd"] == 0 and found["limited"] > 0
        # As in Python no frame has more than twice the ceiling (energy_guard.py).
        assert found["moved"] < 1e-6 and found["worst"] < 2 + 1e-4, found


@needs_chromium
def test_a_mouse_drags_pins_and_turns_and_a_hidden_page_rests(model: GausSim, tmp_path: Path) -> None:
    write(model, tmp_path / "p.html")
    unit, _ = some_unit(model)
    with opened(tmp_path / "p.html", (400, 800)) as page:
        assert page.run("document.documentElement.scrollWidth") == 400
        place = f"(() => {{ page.draw(); return page.seen(page.camera(), page.centre({unit})); }})()"
        x, y, _ = page.run(place)
        page.press(x, y), page.release(x, y)
        assert page.run("page.pins.size") == 1, "a click pins"
        page.press(x, y), page.release(x, y)
        assert page.run("page.pins.size") == 0, "and lets go"
        page.drag((x, y), (x + 60, y), hold=True)
        held = page.run("page.grab.unit")
        page.run("for (let i = 0; i < 30; i++) page.advance(); 0")
        assert page.run(f"page.draw(), page.seen(page.camera(), page.centre({held}))[0]") > x + 15
        page.release(x + 60, y)
        before = page.run("page.camera().view")
        page.drag((30, 30), (90, 60))
        assert page.run("page.camera().view") != before and page.run("page.grab") is None
        page.run("page.controls.start.selectedIndex = 1, page.reset(), page.play(true), 0")
        page.wait(lambda: page.run("page.frame > 22"), 60, "frames beyond training")
        assert "not in training" in page.run("page.controls.status.textContent")
        page.run("window.away = true; Object.defineProperty(document, 'hidden', { get: () => window.away })")
        page.run("new Promise((go) => setTimeout(go, 300))")
        still = page.run("page.frame")
        page.run("new Promise((go) => setTimeout(go, 300))")
        assert page.run("page.frame") == still
        page.run("window.away = false; document.dispatchEvent(new Event('visibilitychange')); 0")
        page.wait(lambda: page.run("page.frame") > still, 20, "the page wakes")


@needs_chromium
def test_names_and_numbers_are_no_code(tmp_path: Path) -> None:
    hostile = make_model(replace(make_scene(60), name=HOSTILE), **NEURAL)
    write(hostile, tmp_path / "p.html", name=HOSTILE, about=HOSTILE)
    with opened(tmp_path / "p.html") as page:
        assert page.run("window.broken") is None
        assert page.run("document.getElementById('name').textContent") == HOSTILE
        assert page.run("page.controls.start.options[1].textContent") == HOSTILE
        assert page.run("document.title").startswith("</script>")


def test_numbers_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    model = make_model(make_scene(60), **NEURAL)
    with pytest.raises(DataError, match="finite"):
        write(model, tmp_path / "p.html", ceiling=float("nan"))
    with torch.no_grad():
        model.scenes[0].means[3, 0] = torch.inf
    with pytest.raises(DataError, match="'rest'"):
        write(model, tmp_path / "p.html")
    assert not (tmp_path / "p.html").exists()


WINDOW = (480, 320)


def shown(page: Page, time: float) -> np.ndarray:
    """The picture at a time [frames]."""
    address = page.run(f"(player.show({time}), player.canvas.toDataURL('image/png'))")
    with Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))) as image:
        return np.asarray(image.convert("RGB")).astype(float)


@needs_chromium
@pytest.mark.slow
def test_the_page_shows_what_our_renderer_draws_and_plays(tmp_path: Path) -> None:
    scene = unit_scene(count=300, degree=3)
    scene = replace(scene, sh=0.4 * scene.sh, name="toy")
    made, background = unit_motion(scene, frames=4), torch.tensor([0.2, 0.4, 0.1])
    camera = orbit_cameras(scene.means, azimuths=[50.0], size=WINDOW)
    save_player(tmp_path / "m.html", scene, made, camera, background=background)
    expected = film(ReferenceRenderer(), scene, made, camera, background=background)[:, 0].numpy().astype(float)
    with chromium(tmp_path, size=WINDOW) as page:
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
