"""The viewer in a real browser: hands where the take has them, a corrected label that is saved, other pages.

A copy of the take gets two labels of its first hand exchanged over 61 frames. Chromium opens it; frames are
typed into the page, and the bones of the skins are read back from the scene that the page draws. Then a ball
is clicked where the camera shows it, the right label chosen and saved. Last, a page of another address tries
to connect.

Needs a Chromium and the package playwright (pip install playwright); neither is a dependency of handsim.

python -m benchmarks.viewer_in_chromium TAKE [--chromium /usr/bin/chromium] [--picture FILE.png]
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import http.server
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import viser

from gloves.takes.take import LOST, Take, load_take
from track.streams import LOOPBACK
from track.viewer import address_of, opened_server
from track.viewer.contents import open_content

SPAN = 61
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
HOOK = """
const set = Map.prototype.set;
Map.prototype.set = function (key, value) {  // three's store is kept by its canvas
    if (key instanceof HTMLCanvasElement && value && value.store) window.store = value.store;
    return set.call(this, key, value);
};
"""
ROOT = """() => {  // the node that turns handsim's z upwards into three's y
    let root = null;
    window.store.getState().scene.traverse(node => {
        if (!root && Math.abs(node.quaternion.w - 0.5) < 1e-6) root = node;
    });
    return root;
}"""
BONES = """() => {
    const {scene} = window.store.getState(), skins = [];
    scene.updateMatrixWorld(true);
    const inverse = (ROOT)().matrixWorld.clone().invert();
    scene.traverse(node => {
        if (!node.isSkinnedMesh) return;
        let visible = true;
        for (let above = node; above; above = above.parent) visible = visible && above.visible;
        skins.push([visible, node.skeleton.bones.map(bone => {
            const place = bone.position.clone().setFromMatrixPosition(bone.matrixWorld);
            return place.applyMatrix4(inverse).toArray();
        })]);
    });
    return skins;
}""".replace("ROOT", ROOT)
PIXEL = """(point) => {
    const {camera, gl} = window.store.getState();
    const place = camera.position.clone().set(...point).applyMatrix4((ROOT)().matrixWorld).project(camera);
    const box = gl.domElement.getBoundingClientRect();
    return [box.left + (place.x + 1) / 2 * box.width, box.top + (1 - place.y) / 2 * box.height];
}""".replace("ROOT", ROOT)
OTHER = """(address) => new Promise(done => {
    const socket = new WebSocket(address, PROTOCOL);
    socket.onopen = () => done("connected");
    socket.onerror = () => done("refused");
})"""


def exchanged(take: Take) -> tuple[Take, int, tuple[int, int]]:
    """The take with two labels exchanged in some frames: its first of them, and the columns there."""
    for frame in range(take.num_frames // 3, take.num_frames - SPAN):
        rows = slice(frame, frame + SPAN)
        steady = (take.ids[rows] == take.ids[frame]).all(axis=0) & (
            take.labels[rows] == take.labels[frame]
        ).all(axis=0)
        columns = np.flatnonzero(steady & (take.labels[frame] >= 0) & (take.labels[frame] < 19))
        if len(columns) > 1:
            one, other = int(columns[0]), int(columns[-1])
            labels = take.labels.copy()
            labels[rows, one], labels[rows, other] = labels[rows, other].copy(), labels[rows, one].copy()
            return dataclasses.replace(take, labels=labels), frame, (one, other)
    raise SystemExit(f"no {SPAN} frames with two points that stay")


def go_to(page: Any, frame: int) -> None:
    """Type a frame into the field beside the slider, and wait until the page shows it."""
    words = "xpath=following::input[contains(@class, 'NumberInput')][1]"
    field = page.get_by_text("frame", exact=True).locator(words)
    field.fill(str(frame))
    field.press("Enter")
    page.get_by_text(f"frame {frame}", exact=True).wait_for()
    time.sleep(1.0)


def choose(page: Any, label: str, option: str) -> None:
    """Choose an option of a list of the panel."""
    row = page.get_by_text(label, exact=True)
    row.locator("xpath=following::input[1]").click()
    page.get_by_role("option", name=option, exact=True).click()
    time.sleep(0.5)


def check_bones(page: Any, take: Take) -> None:
    """Where the joints are in the scene, beside where the model has them."""
    worst, checked = 0.0, 0
    for frame in np.linspace(0, take.num_frames - 1, 9).astype(int).tolist():
        go_to(page, frame)
        for number, (visible, bones) in enumerate(page.evaluate(BONES)):
            lost = take.status[frame, number] == LOST
            assert visible != lost, f"frame {frame}: hand {number} is {'shown' if visible else 'hidden'}"
            if not lost:
                model = take.hands[number].model
                expected = model.forward_kinematics(take.qpos[frame, number][None])[0, :, :3, 3]
                worst = max(worst, float(np.linalg.norm(np.array(bones) - expected, axis=1).max()))
                checked += len(bones)
    print(f"{checked} joints of 9 frames read back: at most {1e3 * worst:.1e} mm from the model's")


def correct(page: Any, path: Path, true: Take, frame: int, columns: tuple[int, int]) -> None:
    """Correct both labels in the page, one by a click on its ball and one from the list; save; read again."""
    names, (one, other) = true.label_names, columns
    go_to(page, frame + SPAN // 2)
    page.keyboard.press("c")
    time.sleep(2.0)
    middle = frame + SPAN // 2
    page.mouse.click(*page.evaluate(PIXEL, true.points[middle, one].tolist()))
    page.get_by_text(f"ID {true.ids[middle, one]}: ").first.wait_for()
    choose(page, "right label", names[true.labels[middle, one]])
    page.get_by_role("button", name="Correct", exact=True).click()
    page.get_by_text("corrected: ").wait_for()
    choose(page, "point", f"ID {true.ids[middle, other]}: none")
    choose(page, "right label", names[true.labels[middle, other]])
    page.get_by_role("button", name="Correct", exact=True).click()
    page.get_by_text(f"corrected: {names[true.labels[middle, other]]}").wait_for()
    page.get_by_role("button", name="Save take", exact=True).click()
    page.get_by_text(f"saved {path}").first.wait_for()
    wrong = int((load_take(path).labels != true.labels).sum())
    print(f"two labels exchanged in {SPAN} frames, corrected and saved in the page: {wrong} labels differ")


def other_page(browser: Any, address: str) -> None:
    """What becomes of a connection from a page of another address."""
    quiet = type("Quiet", (http.server.SimpleHTTPRequestHandler,), {"log_message": lambda *_: None})
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "index.html").write_text("<html></html>")
        other = http.server.ThreadingHTTPServer((LOOPBACK, 0), functools.partial(quiet, directory=folder))
        threading.Thread(target=other.serve_forever, daemon=True).start()
        page = browser.new_page()
        page.goto(f"http://{LOOPBACK}:{other.server_address[1]}")
        script = OTHER.replace("PROTOCOL", f"'viser-v{viser.__version__}'")
        print(f"a page of another address: {page.evaluate(script, address.replace('http', 'ws'))}")
        other.shutdown()


def main() -> None:
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("take")
    parser.add_argument("--chromium", default="/usr/bin/chromium")
    parser.add_argument("--picture")
    options = parser.parse_args()
    true = load_take(options.take)
    take, frame, columns = exchanged(true)
    ended = threading.Event()
    with tempfile.TemporaryDirectory() as folder, opened_server(LOOPBACK, 0, "benchmark") as server:
        path = Path(folder) / "tracked.npz"
        take.save(path)
        run = open_content(str(path)).show(server)
        serving = threading.Thread(target=run, args=(ended.is_set,), daemon=True)
        serving.start()
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=options.chromium, args=FLAGS)
            page = browser.new_page(viewport={"width": 1280, "height": 900})
            page.set_default_timeout(60_000)
            page.add_init_script(HOOK)
            page.goto(address_of(server))
            page.wait_for_function("window.store !== undefined")
            time.sleep(5.0)
            check_bones(page, true)
            correct(page, path, true, frame, columns)
            if options.picture:
                page.screenshot(path=options.picture)
            other_page(browser, address_of(server))
            browser.close()
        ended.set()
        serving.join()


if __name__ == "__main__":
    main()
