"""Make the picture of the viewer: its page in a headless Chromium, with a divided world.

`python -m docs.pictures.viewer_picture docs/images` makes it again.
The program needs Chromium and Playwright.
"""

from __future__ import annotations

import shutil
import sys
import threading
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

from cavmarl.env.parallel import parallel_env
from cavmarl.viewer.show_world import show_worlds
from cavmarl.viewer.web_options import WebOptions

SOFTWARE_GL = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
SIZE = {"width": 1280, "height": 800}
KEYS = {
    "population.insertions": 20,
    "sensors.lidar.rays": 48,
    "rig": {
        "front": {"type": "rgb_camera", "rate_hz": 10, "z_m": 1.4, "width": 240, "height": 120}
    },
}
SECONDS = 600.0


def write_viewer_picture(path: Path) -> Path:
    """Draw a crossing in four zones, with an agent, its sensor data and its observation."""
    env = parallel_env("grid4x4", zones=4, agents=20, background=120, overrides=KEYS)
    told: list[str] = []
    begun = threading.Event()

    def tell(text: str) -> None:
        told.append(text)
        begun.set()

    def drive() -> None:
        show_worlds([env], "idm", 1, WebOptions(port=0), tell, SECONDS)

    threading.Thread(target=drive, daemon=True).start()
    begun.wait(300.0)
    with sync_playwright() as playwright:
        chromium = shutil.which("chromium")
        browser = playwright.chromium.launch(executable_path=chromium, args=SOFTWARE_GL)
        page = browser.new_page(viewport=SIZE)
        page.goto(told[0].split()[-1])
        _until(page, "Boolean(window.viewer && viewer.frame && viewer.frame.time > 20)")
        page.fill("#wanted", "car_2")
        page.press("#wanted", "Enter")
        page.select_option("#ghosts", "0")
        page.evaluate("viewer.camera.scale = 9")
        page.evaluate("document.querySelector('#loads-box').open = true")
        _until(page, "document.querySelectorAll('#loads tr').length > 0")
        page.click("#play")
        page.wait_for_timeout(1500)
        page.screenshot(path=str(path))
        browser.close()
    return path


def _until(page: Page, script: str) -> None:
    for _ in range(600):
        if page.evaluate(script):
            return
        page.wait_for_timeout(200)
    raise TimeoutError(script)


if __name__ == "__main__":
    print(write_viewer_picture(Path(sys.argv[1]) / "viewer.png"))
