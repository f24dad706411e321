"""The page in a real browser: it draws, uses no other host, and shows markup in names as text."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from cavmarl.env.vector import make_vec
from cavmarl.recordings.recording import Recording
from cavmarl.viewer.live_recording import ShownRecording, recording_stages
from cavmarl.viewer.show_world import serve_stages
from cavmarl.viewer.web_options import WebOptions
from tests.support.chromium import until
from tests.viewer.conftest import Served

Serve = Callable[..., Served]
CAMERA = {"front": {"type": "rgb_camera", "rate_hz": 10, "z_m": 1.2, "width": 64, "height": 36}}
WITHOUT_WEBGL2 = """
const real = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
  return kind === "webgl2" ? null : real.call(this, kind, ...more);
};
"""


def opened(browser: Any, served: Served, script: str = "") -> tuple[Any, list[str], set[str]]:
    """Open a page and wait for its first frame; return the page, its errors and the used hosts."""
    page = browser.new_page(viewport={"width": 1280, "height": 760})
    problems: list[str] = []
    hosts: set[str] = set()
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("console", lambda message: problems.append(message.text))
    page.on("request", lambda request: hosts.add(request.url.split("/")[2]))
    if script:
        page.add_init_script(script)
    page.goto(served.server.address)
    until(page, "window.viewer && viewer.frame")
    return page, problems, hosts


def test_the_page_draws_and_follows_a_vehicle_and_uses_no_other_host(
    browser: Any, serve: Serve
) -> None:
    served = serve()
    page, problems, hosts = opened(browser, served)
    until(page, "viewer.firstPicture > 0")
    assert page.evaluate("viewer.frame.count") >= 3
    assert page.evaluate("viewer.calls") <= 10  # draw calls
    page.fill("#wanted", "car_1")
    page.press("#wanted", "Enter")
    until(page, "document.querySelector('#observation').rows.length > 5")
    assert "car_1" in page.inner_text("#vehicle-name")
    assert page.get_attribute("#follow", "aria-pressed") == "true"
    page.focus("#scene")
    page.keyboard.press("Space")
    until(page, "viewer.live.paused")
    tick = page.evaluate("viewer.live.tick")
    page.keyboard.press(".")
    until(page, f"viewer.live.tick > {tick}")
    page.select_option("#ghosts", "1")
    until(page, "viewer.frame.ghosts.has(1)")
    page.evaluate("document.querySelector('#past').value = 0")
    page.dispatch_event("#past", "input")
    assert "looking back" in page.inner_text("#status")
    page.click("#live")
    assert not problems
    assert hosts == {f"127.0.0.1:{served.server.port}"}


def test_a_seat_is_driven_with_the_arrow_keys(
    browser: Any, serve: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    served = serve()
    noted = served.note_actions(monkeypatch)
    page, problems, _ = opened(browser, served)
    page.fill("#wanted", "car_0")
    page.press("#wanted", "Enter")
    page.click("#seat")
    page.keyboard.down("ArrowUp")
    page.keyboard.down("ArrowLeft")
    page.wait_for_timeout(600)
    assert served.run.seats.keys() == {0}
    assert any(throttle == 1.0 and steering > 0.3 for throttle, steering in noted)
    page.keyboard.up("ArrowUp")
    page.keyboard.press("Escape")
    page.wait_for_timeout(400)
    assert not served.run.seats
    assert not problems


def test_a_page_can_add_a_vehicle_and_close_and_open_a_road(browser: Any, serve: Serve) -> None:
    served = serve(insertions=9, background=4)
    page, problems, _ = opened(browser, served)
    assert page.is_visible("#insert")
    before = page.evaluate("viewer.frame.count")
    page.click("#insert")
    place = page.evaluate(
        """(() => {
          const [x, y] = viewer.vehicles.placeOf(0, 1);
          const [px, py] = viewer.camera.toPixels(x, y);
          const box = document.querySelector("#scene").getBoundingClientRect();
          return [px + box.x, py + box.y];
        })()"""
    )
    page.mouse.click(*place)
    until(page, f"viewer.frame.count > {before}")
    assert page.get_attribute("#insert", "aria-pressed") == "false"
    page.click("#close")
    page.mouse.click(*place)
    until(page, "document.querySelector('#events').textContent.includes('road closed')")
    assert "vehicle added" in page.text_content("#events")
    page.click("#open")
    page.mouse.click(*place)
    until(page, "document.querySelector('#events').textContent.includes('road opened')")
    page.click("#open")
    page.mouse.click(*place)
    until(page, "document.querySelector('#notice').textContent.includes('no closed road')")
    page.click("#insert")
    page.mouse.click(5, 400)
    until(page, "document.querySelector('#notice').textContent.includes('no road for cars')")
    assert not problems


def test_a_page_cannot_add_vehicles_without_room_for_them(browser: Any, serve: Serve) -> None:
    page, _, _ = opened(browser, serve())
    assert not page.is_visible("#insert")
    assert not page.is_visible("#close")


def test_every_control_has_a_name(browser: Any, serve: Serve) -> None:
    page, _, _ = opened(browser, serve())
    unnamed = page.evaluate(
        """[...document.querySelectorAll('button, input, select')].filter((one) =>
        !one.textContent.trim() && !one.getAttribute('aria-label') && !one.labels?.length)
        .map((one) => one.id)"""
    )
    assert unnamed == []
    assert page.evaluate("document.documentElement.lang") == "en"


def test_markup_in_names_of_a_map_is_shown_as_text(
    browser: Any, serve: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    nasty = "<script>alert(1)</script><img src=x onerror=alert(1)>"
    served = serve()
    network = served.env.network
    # Use a patch, because worlds of one process share the network of a map.
    monkeypatch.setitem(vars(network), "lane_ids", (nasty,) * len(network.lane_ids))
    page, problems, _ = opened(browser, served)
    page.on("dialog", lambda dialog: problems.append(dialog.message))
    page.fill("#wanted", "car_0")
    page.press("#wanted", "Enter")
    until(page, "document.querySelector('#state').rows.length > 5")
    assert nasty in page.inner_text("#state")
    assert page.evaluate("document.querySelectorAll('#state script, #state img').length") == 0
    assert not problems


def test_without_webgl2_a_message_and_a_still_picture_are_shown(browser: Any, serve: Serve) -> None:
    page, problems, _ = opened(browser, serve(), WITHOUT_WEBGL2)
    until(page, "viewer.stillDrawn > 0")
    assert "no WebGL2" in page.inner_text("#notice")
    colors = page.evaluate(
        """(() => { const c = document.querySelector('#scene');
        const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
        const seen = new Set(); for (let k = 0; k < d.length; k += 4)
        seen.add(`${d[k]},${d[k + 1]},${d[k + 2]}`); return seen.size; })()"""
    )
    assert colors > 3
    assert not problems


def test_the_page_draws_the_sensors_and_the_route_of_a_vehicle(browser: Any, serve: Serve) -> None:
    page, problems, _ = opened(browser, serve(env="merge", zones=1, rig=CAMERA))
    page.fill("#wanted", "car_0")
    page.press("#wanted", "Enter")
    until(page, "document.querySelectorAll('#pictures canvas').length === 1")
    until(page, "viewer.shapes.way.length > 4 && viewer.shapes.all.length > 2")
    drawn = """(() => { const c = document.querySelector('#labels');
        const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
        let n = 0; for (let k = 3; k < d.length; k += 4) n += d[k] > 0; return n; })()"""
    until(page, f"{drawn} > 20000")  # labels have fewer pixels, the camera's cone has more
    page.uncheck("#sensors")
    until(page, "viewer.shapes && viewer.shapes.all.length === 0")
    until(page, f"{drawn} < 20000 && {drawn} > 0")
    # The test's own calls of getImageData cause a message.
    assert not [one for one in problems if "getImageData" not in one]


def test_a_page_can_seek_in_a_recording_and_choose_its_world(browser: Any, tmp_path: Path) -> None:
    with ExitStack() as stack:
        address, span = replayed(stack, tmp_path / "run")
        page = browser.new_page()
        problems: list[str] = []
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.goto(f"{address}#world=1")
        until(page, "window.viewer && viewer.frame && viewer.firstPicture")
        assert page.input_value("#world") == "1"
        page.click("#play")
        wanted = Recording(tmp_path / "run").ticks(1, 0)[7]
        page.evaluate(
            f"(() => {{ const past = document.querySelector('#past'); past.value = '{wanted}';"
            "past.dispatchEvent(new Event('input')); })()"
        )
        until(page, f"viewer.frame.tick === {wanted}")
        assert page.get_attribute("#past", "max") == str(span[1])
        assert page.is_hidden("#reset")
        page.click("#all")
        for k in range(2):
            shown = f"document.querySelectorAll('#worlds iframe')[{k}].contentWindow"
            until(page, f"Boolean({shown}.viewer && {shown}.viewer.frame)")
            assert page.evaluate(f"{shown}.viewer.world") == k
        page.click("#all")
        assert page.locator("#worlds iframe").count() == 0
        assert not problems
        page.select_option("#world", "0")
        until(page, "viewer.hello.world === 0 && viewer.frame")
        assert not problems


def replayed(stack: ExitStack, path: Path) -> tuple[str, list[int]]:
    """Serve a recording of two worlds; return the address, and the first and last tick."""
    vec = make_vec("ring", num_envs=2, agents=1, background=2, record=path)
    vec.reset(seed=0)
    for _ in range(30):
        vec.step(vec.suggest_actions())
    vec.close()
    found = recording_stages(Recording(path))
    shown = [ShownRecording(Recording(path), *one) for one in found]
    stages = [stage for *_, stage in found]
    address = serve_stages(stack, stages, WebOptions(port=0), lambda _: None)
    over = threading.Event()

    def drive() -> None:
        while not over.is_set():
            over.wait(min(0.02, *(one.turn() for one in shown)))

    thread = threading.Thread(target=drive)
    thread.start()
    stack.callback(thread.join)
    stack.callback(over.set)
    return address, stages[0].hello["span"]


def test_a_page_asks_for_the_token(browser: Any, serve: Serve) -> None:
    served = serve(options=WebOptions(port=0, token="open sesame"))
    page = browser.new_page()
    page.goto(served.server.address)
    page.wait_for_selector("#token-box[open]")
    page.fill("#token", "open sesame")
    page.press("#token", "Enter")
    until(page, "viewer.frame")
    assert "open" not in page.url


@pytest.mark.parametrize("width", [360])
def test_a_small_screen_does_not_scroll_sideways(browser: Any, serve: Serve, width: int) -> None:
    page, _, _ = opened(browser, serve())
    page.set_viewport_size({"width": width, "height": 640})
    assert page.evaluate("document.documentElement.scrollWidth") <= width
