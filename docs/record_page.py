"""Records a page that is pulled: PYTHONPATH=tests python docs/record_page.py PAGE.html OUT.gif."""

from __future__ import annotations

import io
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from helpers.chromium import Page, chromium
from PIL import Image

from gausim.io.video import write_gif

SIZE, FPS = (720, 540), 20
# Frames of pulling to one side, to the other, and of swinging free.
PULLED, PULLED_BACK, FREE = 14, 14, 44
REACH = 150  # of a pull [pixels]
# The unit that moves most easily, as it is seen.
PLACE = """(() => { const { body, facts } = page, size = (n) => body.meanRows([n]).reduce((sum, v) => sum + v * v, 0);
  let best = 0; for (let n = 1; n < facts.units; n++) if (size(n) > size(best)) best = n;
  page.draw(); return page.seen(page.camera(), page.centre(best)); })()"""


def frames(page: Page) -> Iterator[np.ndarray]:
    """Pictures of the page while the mouse pulls."""
    x, y, _ = page.run(PLACE)
    page.press(x, y)
    way = [(REACH * np.sin(np.pi / 2 * f / PULLED), -0.3 * REACH * f / PULLED) for f in range(PULLED)]
    way += [(REACH * np.cos(np.pi * f / PULLED_BACK), -0.3 * REACH) for f in range(PULLED_BACK)]
    for number in range(PULLED + PULLED_BACK + FREE):
        if number < len(way):
            page.mouse("mouseMoved", x + way[number][0], y + way[number][1], held=True)
        elif number == len(way):
            page.release(x + way[-1][0], y + way[-1][1])
        page.run("page.advance(), page.part = 1, page.draw()")
        with Image.open(io.BytesIO(page.picture())) as shown:
            yield np.asarray(shown.convert("RGB"))


def main(source: Path, out: Path) -> None:
    """Writes the GIF."""
    with tempfile.TemporaryDirectory() as folder, chromium(Path(folder), size=SIZE) as page:
        page.open(source.resolve().as_uri())
        page.wait(lambda: page.run("!!window.page && window.page.drawn > 2"), 60, "pictures")
        page.run("page.play(false), page.adapts = false, page.sharpness = 1, page.reset()")
        page.run("page.controls.more.open = false, document.getElementById('help').style.display = 'none', 0")
        print(f"wrote {out}: {write_gif(out, frames(page), FPS)} frames, {out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
