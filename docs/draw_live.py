"""Recording of docs/live.webp, the picture of docs/live.md: the live twin while two knobs are dragged.

Run it from anywhere: python docs/draw_live.py. It needs Chromium and the extras `test` and `live`.
"""

from __future__ import annotations

import io
import sys
from pathlib import Path

import numpy as np
from PIL import Image

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from playwright.sync_api import sync_playwright  # noqa: E402

from tests.twin.live_page import CHROMIUM, FLAGS, Page, running  # noqa: E402

SIZE, SHOWN = (1360, 800), (1020, 600)
"""Sizes of the window and of the picture, pixels."""
FRAME_MS = 110
DESPACE, TURN = "base/forward/M2 shift z", "base/backward/focal_plane rotate z"


def values() -> list[dict[str, float]]:
    """Return the values of the knobs in each picture: the mirror forward and half back, then the focal plane."""
    there = 5.0 * np.sin(np.linspace(0.0, 2.2, 16))
    turn = 9.0 * np.sin(np.linspace(0.0, 1.6, 14))
    out = [{DESPACE: round(float(z), 2), TURN: 0.0} for z in there]
    out += [{DESPACE: round(float(there[-1]), 2), TURN: round(float(t), 2)} for t in turn]
    return out + [out[-1]] * 8


def main() -> None:
    """Drag the knobs, record, and write the picture."""
    with running("gf7_pair", "--port", "0") as command, sync_playwright() as made:
        browser = made.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = Page(browser, command.address, *SIZE)
        page.ready()
        page.page.select_option("#strip-span", "30")
        page.page.select_option("#crop", "spot")
        pictures = []
        for knobs in values():
            for name, value in knobs.items():
                page.page.evaluate("([name, value]) => liveTwin.knobs.turn(name, value)", [name, value])
            page.page.evaluate("liveTwin.knobs.list()")
            page.still()
            page.page.wait_for_timeout(120)
            shot = Image.open(io.BytesIO(page.page.screenshot())).convert("RGB")
            pictures.append(shot.resize(SHOWN, Image.Resampling.LANCZOS))
        page.close()
        browser.close()
    options = {"duration": FRAME_MS, "loop": 0, "quality": 62, "method": 6}
    pictures[0].save(HERE / "live.webp", save_all=True, append_images=pictures[1:], **options)


if __name__ == "__main__":
    main()
