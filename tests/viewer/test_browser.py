"""The viewer in a real browser: the page loads, a drag moves the object where it goes, sessions replay bit for bit."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.chromium import CTRL, SHIFT, Page, chromium, needs_chromium
from helpers.column import make_interaction

pytest.importorskip("viser", reason="the extra 'view' is not installed")

from viser.transforms import SO3

from gausim.interaction.selections import Kernels
from gausim.interaction.session import Force, Hand, Impulse
from gausim.viewer.access import Access
from gausim.viewer.app import Subject, Viewer

pytestmark = needs_chromium
SIZE = (1280, 800)


@contextmanager
def opened(subject: Subject, folder: Path) -> Iterator[tuple[Viewer, Page]]:
    """A viewer and a browser that shows it; nothing may have gone wrong at the end."""
    viewer = Viewer(subject, Access(port=0))
    viewer.live.pace = 0.2  # a browser that draws by software answers the mouse between frames
    viewer.start()
    try:
        with chromium(folder, size=SIZE) as page:
            page.open(viewer.url)
            page.wait(lambda: "simulated" in page.text() and viewer.live.interaction.tick > 3, 60, "the page")
            yield viewer, page
            ours = [text for text in page.problems if "passive event listener" not in text]  # viser's own
            assert not ours, ours
            home = (viewer.url, viewer.url.replace("http", "ws"), "data:", "blob:")
            outside = [address for address in page.requests if not address.startswith(home)]
            assert not outside, outside
            assert viewer.live.is_alive() and not any(worker.failures for worker in viewer.workers)
    finally:
        viewer.stop()


def on_screen(viewer: Viewer, point: torch.Tensor) -> tuple[float, float]:
    """Where a point of the page's scene is seen [pixels]."""
    camera = next(iter(viewer.server.get_clients().values())).camera
    seen = SO3(camera.wxyz).as_matrix().T @ (point.double().numpy() - camera.position)
    focal = SIZE[1] / 2 / np.tan(camera.fov / 2)
    return SIZE[0] / 2 + focal * seen[0] / seen[2], SIZE[1] / 2 + focal * seen[1] / seen[2]


def drag(viewer: Viewer, page: Page) -> tuple[torch.Tensor, tuple[float, float], Force]:
    """Drags the part farthest from what is pinned to the right; its place, where the mouse is held, and the force."""
    scene, interaction = viewer.live.interaction.scene, viewer.live.interaction
    centres = viewer.pointer._centres(scene.means)
    root = viewer.placing.to_page(scene.means[scene.pinned]).mean(0)
    farthest = centres[(centres - root).norm(dim=-1).argmax()]
    start = on_screen(viewer, farthest)
    end = (start[0] + 160, start[1])
    page.drag(start, end, hold=True)
    page.wait(lambda: interaction.acting, 10, "a force")
    force = next(e.event for e in reversed(interaction.session().entries) if isinstance(e.event, Force))
    return viewer.placing.to_scene(farthest), end, force


def pause(viewer: Viewer, page: Page) -> None:
    page.press_button("Pause")
    page.wait(lambda: not viewer.live.playing, 10, "a pause")


def reset(viewer: Viewer, page: Page) -> None:
    page.press_button("Reset")
    page.wait(lambda: viewer.live.interaction.frame_number == 0, 10, "a reset")


def test_page_pulls_where_the_mouse_goes_and_resets(tmp_path: Path) -> None:
    with opened(Subject("a column", make_interaction(), sessions=tmp_path), tmp_path) as (viewer, page):
        live = viewer.live
        centre, end, force = drag(viewer, page)
        ends = centre, centre + torch.tensor(force.direction)
        seen, pulled = (on_screen(viewer, viewer.placing.to_page(at)) for at in ends)
        assert force.weights > 0 and pulled[0] > seen[0], "does not pull to the right on the screen"
        page.release(*end)
        page.wait(lambda: not live.interaction.acting, 10, "letting go")
        pause(viewer, page)
        reset(viewer, page)
        assert torch.equal(live.interaction.frame.positions, live.interaction.scene.means) and not live.message


@pytest.mark.slow
def test_a_pin_goes_where_the_mouse_goes(tmp_path: Path) -> None:
    with opened(Subject("a column", make_interaction(), sessions=tmp_path), tmp_path) as (viewer, page):
        live, scene = viewer.live, viewer.live.interaction.scene
        pins = viewer.placing.to_page(scene.means)[scene.pinned]
        eye = torch.tensor(next(iter(viewer.server.get_clients().values())).camera.position)
        pin = pins[(pins - eye).norm(dim=1).argmin()]  # the nearest, which no other kernel hides
        start = on_screen(viewer, pin)
        end = (start[0] + 80, start[1])
        page.drag(start, end, hold=True)
        page.wait(lambda: any(isinstance(e.event, Hand) for e in live.interaction.session().entries), 60, "a hand")
        begun = live.interaction.frame_number
        page.wait(lambda: live.interaction.frame_number > begun + 8, 60, "the hand to arrive")
        to = torch.tensor(live.interaction.place_of_hand(0)[0])
        seen = on_screen(viewer, viewer.placing.to_page(viewer.placing.to_scene(pin) + to))
        assert abs(seen[0] - end[0]) < 15 and abs(seen[1] - end[1]) < 15, (seen, end)
        page.release(*end)
        moved = (live.interaction.frame.positions - scene.means)[scene.pinned]
        torch.testing.assert_close(moved, to.expand_as(moved), atol=1e-4, rtol=0)
        assert not live.interaction.acting and not live.message


@pytest.mark.slow
def test_page_brushes_flicks_and_takes_a_session(tmp_path: Path) -> None:
    interaction = make_interaction(keep=None)
    with opened(Subject("a column", interaction, sessions=tmp_path), tmp_path) as (viewer, page):
        pointer, live = viewer.pointer, viewer.live
        centre = on_screen(viewer, viewer.placing.to_page(interaction.scene.means).mean(0))
        page.drag((centre[0] - 200, centre[1] - 200), (centre[0] + 200, centre[1] + 200), modifiers=SHIFT)
        page.wait(lambda: isinstance(pointer.selection, Kernels), 10, "a brushed region")
        assert int(pointer.mask.sum()) > 1
        start = on_screen(viewer, pointer._centres(interaction.scene.means)[0])
        end = (start[0] + 160, start[1])
        page.drag(start, end, modifiers=CTRL, hold=True)
        assert not interaction.acting, "a flick pulls before it is released"
        page.release(*end, modifiers=CTRL)
        page.wait(lambda: any(isinstance(e.event, Impulse) for e in interaction.session().entries), 10, "an impulse")
        pause(viewer, page)
        recorded = interaction.trajectory()
        page.press_button("Session")
        page.press_button("Save the session")
        page.wait(lambda: viewer.page.saved, 10, "a saved session")
        page.give_file(viewer.page.saved[-1])
        page.wait(lambda: live.message.startswith("The session is over"), 60, "the session's end")
        again = interaction.trajectory()
        assert again.frames == recorded.frames and torch.equal(again.positions, recorded.positions)
        (tmp_path / "broken.json").write_text("{")
        page.give_file(tmp_path / "broken.json")
        page.wait(lambda: "the file" in live.message, 10, "what is wrong with the file")
