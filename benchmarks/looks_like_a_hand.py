"""Whether a hand tracker that was trained on photographs takes the renders for hands.

    python -m benchmarks.looks_like_a_hand OUT [--clean 300 --mixed 300 --empty 100 --seed 0] [--judge FILE]

Writes two sets of 640 x 480 pictures of one hand each, as `handsim render --format coco` writes them:
OUT/clean (plain and graded backgrounds) and OUT/mixed (rooms; pictures without a hand
among them). Five kinds of pose x palm, back and edge views x six skin tones x both sides; the hand's box
takes 20 to 30 % of the frame.
OUT/*/judged.json is the COCO file with each picture's view, pose and tone.

The judge is a program of the user's own: `judge --images DIR --annotations COCO --report JSON` finds hands in
the pictures without being told where they are. With --judge it is run, and its figures are printed by view,
pose, tone, side and background; without, its command lines are.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from benchmarks.record import run
from gloves import Take, attach, load_layout
from handsim import Camera, HandModel, join_qpos, sample_shape
from handsim.errors import PoseError
from handsim.hand.shape import SIDES, Side
from handsim.space.camera import preset
from poses.shapes import gesture, make_valid
from render import Backgrounds, ExposureConfig, RenderConfig, RenderedFrame
from render.color_sensor import sample_exposure
from render.formats.writer import open_writer
from render.painting.figures import sample_appearance
from render.scenery.backgrounds import Background
from render.scenery.lights import Lighting, sample_surroundings
from render.skin.look import TONES
from render.studio import FrameChoices, Moment, Studio

POSES: Final[dict[str, tuple[str, ...]]] = {
    "open": ("flat", "spread", "stretched", "four", "asl_b", "count_thumb_5"),
    "relaxed": ("relaxed", "typing_rest", "duck_bill", "tabletop", "asl_c", "letter_c"),
    "fist": (
        *("fist", "soft_fist", "fist_thumb_beside", "thumb_up"),
        *("cylinder_grasp", "ball_grasp", "grasp_medium_wrap", "grasp_power_sphere"),
    ),
    "pointing": ("point", "two", "gun", "horns", "shaka", "three", "little_up", "grip_pointing"),
    "pinch": ("pinch_index", "pinch_middle", "ok", "pinch_pad_index", "tripod", "pinch_fist"),
}
VIEWS: Final = {"palm": (0.0, 0.0, 1.0), "back": (0.0, 0.0, -1.0), "edge": (0.0, -1.0, 0.0)}
SETS: Final = {
    "clean": Backgrounds({"plain": 1, "gradient": 1}),
    "mixed": Backgrounds({"room": 1}),
}
FILL: Final = (0.2, 0.3)  # the hand's box over the frame
TILT: Final = np.deg2rad(22.0)  # how far a view is off its axis at most, each way
JUDGED: Final = "judged.json"
GROUPS: Final = ("view", "pose", "tone", "side", "background")


class Case(NamedTuple):
    """What one picture shows."""

    pose: str
    view: str
    tone: str
    side: Side
    gesture: str
    model: HandModel
    qpos: np.ndarray
    camera: Camera
    background: str


def make_case(number: int, background: str, rng: np.random.Generator) -> Case:
    """Kinds go round by number; all else is drawn."""
    pose = list(POSES)[number % 5]
    view = list(VIEWS)[number // 5 % 3]
    side = SIDES[number // 15 % 2]
    tone = list(TONES)[(number // 30 + number) % 6]
    name = POSES[pose][int(rng.integers(len(POSES[pose])))]
    model, qpos = sample_pose(name, side, rng)
    camera = place_camera(model, qpos, view, rng)
    return Case(pose, view, tone, side, name, model, qpos, camera, background)


def sample_pose(name: str, side: Side, rng: np.random.Generator) -> tuple[HandModel, np.ndarray]:
    while True:
        model = HandModel(sample_shape(side=side, rng=rng))
        low, high = model.skeleton.ranges.T
        angles = np.clip(gesture(name) + np.deg2rad(rng.normal(0.0, 3.0, 20)), low, high)
        try:
            return model, join_qpos(make_valid(model, angles[None]))[0]
        except PoseError:  # fingers too thick for so narrow a palm
            continue


def place_camera(model: HandModel, qpos: np.ndarray, view: str, rng: np.random.Generator) -> Camera:
    """Off the view's axis and rolled a little, at the distance that gives the hand its share of the frame."""
    camera = preset("vga")
    size = np.array(camera.size)
    ahead = np.array(VIEWS[view]) * [1.0, 1.0 if model.shape.side == "right" else -1.0, 1.0]
    if view == "edge" and rng.random() < 0.35:
        ahead = -ahead  # the little finger's side
    ahead = ahead + np.tan(np.clip(rng.normal(0.0, TILT / 1.5, 3), -TILT, TILT))
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [1.0, 0.0, 0.0])  # fingers up
    right /= np.linalg.norm(right)
    roll = np.clip(rng.normal(0.0, np.deg2rad(25.0)), -1.0, 1.0)
    right = np.cos(roll) * right + np.sin(roll) * np.cross(ahead, right)
    rotation = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    skin = model.skin(qpos[None])[0]
    local, share, distance = (skin - skin.mean(axis=0)) @ rotation, rng.uniform(*FILL), 0.6
    for _ in range(8):
        pixels = local[:, :2] / (local[:, 2:] + distance) * camera.K[0, 0]
        distance *= (np.ptp(pixels, axis=0) / size).max() / share
    free = np.clip(size / 2 - np.abs(pixels).max(axis=0) - 15.0, 0.0, [120.0, 70.0])
    shift = rng.uniform(-1.0, 1.0, 2) * free / camera.K[0, 0] * distance
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = skin.mean(axis=0) - rotation @ np.array([*shift, distance])
    return camera.at(pose)


def photograph(
    number: int,
    case: Case,
    background: Background,
    lighting: Lighting,
    *,
    shown: bool,
    rng: np.random.Generator,
) -> RenderedFrame:
    """A picture of the hand, or of what is behind it."""
    qpos = case.qpos[None] if shown else np.full((1, len(case.qpos)), np.nan)
    hand = attach(load_layout("dense19"), case.model)
    look = sample_appearance(False, tones=TONES[case.tone], rng=rng)
    config = RenderConfig(passes=("rgb", "ids", "depth"), painter="compiled")
    studio = Studio([hand], look, config)
    moment = Moment(Take.of_poses([hand], qpos[:, None], rate=60.0), 0)
    if shown:
        moment = studio.reaching(moment, [case.camera])
    exposure = sample_exposure(ExposureConfig(), rng=rng)
    lighting = lighting.turned(case.camera.T_world_camera[:3, :3])
    choices = FrameChoices(lighting, background, exposure, None, None, int(rng.integers(2**31)))
    return dataclasses.replace(studio.photograph(moment, case.camera, choices), number=number)


def frames_of(name: str, hands: int, empty: int, seed: int, cases: list[Case]) -> Iterator[RenderedFrame]:
    """The pictures of one set, those without a hand last; what they show is added to `cases`."""
    for number in range(hands + empty):
        rng = np.random.default_rng([seed, list(SETS).index(name), number])
        background, lighting, _ = sample_surroundings(SETS[name], np.eye(3), rng=rng)
        cases.append(make_case(number, background.kind, rng))
        yield photograph(number, cases[-1], background, lighting, shown=number < hands, rng=rng)
        if sys.stderr.isatty():
            print(f"\r{name}: {number + 1} of {hands + empty}", end="", file=sys.stderr)


def write_set(name: str, hands: int, empty: int, seed: int, out: Path) -> None:
    """Pictures and judged.json of one set."""
    writer, cases = open_writer("coco", out), []
    writer.write(0, frames_of(name, hands, empty, seed, cases))
    writer.finish()
    coco = json.loads((out / "annotations.json").read_text(encoding="utf-8"))
    for image, case in zip(coco["images"], cases, strict=True):
        image["file_name"] = f"images/{image['file_name']}"
        image |= {name: getattr(case, name) for name in ("pose", "view", "tone", "gesture", "background")}
    (out / JUDGED).write_text(json.dumps(coco), encoding="utf-8")


def run_judge(program: Path | None, out: Path) -> None:
    """Run the judge on a set and print its figures, or print how to run it."""
    report = out / "report.json"
    line = ["--images", str(out), "--annotations", str(out / JUDGED), "--report", str(report)]
    line += [word for group in GROUPS for word in ("--by", group)]
    if program is None:
        print("JUDGE", *line)
        return
    done = subprocess.run([sys.executable, str(program), *line], capture_output=True, text=True, check=False)
    if not report.is_file():
        sys.exit(f"{program}: left no report\n{done.stderr}")
    figures = json.loads(report.read_text(encoding="utf-8"))
    print(f"\n{out.name:22s}{'n':>6s}{'found':>8s}{'error':>8s}{'PCK.1':>8s}{'side':>8s}  [%]")
    for name, row in [*figures["sets"].items(), ("all", figures["total"])]:
        values = (row["found"], row["err"], row["pck_all"], row["side"])
        cells = "".join(f"{'-' if value is None else format(100 * value, '.1f'):>8s}" for value in values)
        print(f"{name:22s}{row['n']:6d}{cells}")
    empty = [found for _, found in figures["controls"]]
    if empty:
        print(f"pictures without a hand: one reported in {sum(empty)} of {len(empty)}")


def main(
    out: Path,
    clean: int = 300,
    mixed: int = 300,
    empty: int = 100,
    seed: int = 0,
    judge: Path | None = None,
) -> None:
    for name, hands, bare in (("clean", clean, 0), ("mixed", mixed, empty)):
        if hands + bare:
            write_set(name, hands, bare, seed, out / name)
            run_judge(judge, out / name)


if __name__ == "__main__":
    run(main, __doc__)
