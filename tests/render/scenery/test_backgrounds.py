from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from handsim.errors import HandSimError
from render.scenery.backgrounds import KINDS, Background, Backgrounds, draw_background, sample_background
from render.scenery.photographs import photos_beside
from render.scenery.rooms import draw_room

SIZE = (160, 120)


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Two photographs, one of them in a subfolder, and files that are none."""
    folder = tmp_path / "photos"
    (folder / "more").mkdir(parents=True)
    assert cv2.imwrite(str(folder / "blue.png"), np.full((300, 500, 3), (200, 10, 10), dtype=np.uint8))
    assert cv2.imwrite(str(folder / "more" / "red.jpg"), np.full((90, 70, 3), (10, 10, 200), dtype=np.uint8))
    (folder / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 no photograph at all")
    (folder / "empty.png").write_bytes(b"")
    (folder / "notes.txt").write_text("not a picture", encoding="utf-8")
    return folder


def only(kind: str, **more: str) -> Backgrounds:
    return Backgrounds({kind: 1.0}, **more)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "photo"])
def test_backgrounds_repeat_and_differ(kind: str) -> None:
    first, again, other = (sample_background(only(kind), rng=np.random.default_rng(s)) for s in (1, 1, 2))
    assert first == again
    assert first.kind == kind
    picture = draw_background(first, SIZE)
    assert picture.shape == (120, 160, 3)
    assert picture.dtype == np.float32
    assert picture.min() >= 0.0
    assert picture.max() <= 1.0
    assert picture.tobytes() == draw_background(again, SIZE).tobytes()
    assert np.abs(picture - draw_background(other, SIZE)).max() > 0.01
    values = json.loads(json.dumps(dataclasses.asdict(first)))
    assert (draw_background(Background(**values), SIZE) == picture).all()


def test_what_each_kind_is() -> None:
    def spread(kind: str, seed: int) -> float:
        background = sample_background(only(kind), rng=np.random.default_rng(seed))
        return float(np.ptp(draw_background(background, SIZE), axis=(0, 1)).max())

    assert max(spread("plain", seed) for seed in range(5)) == 0.0
    for kind in ("noise", "clutter", "room"):
        assert np.median([spread(kind, seed) for seed in range(5)]) > 0.15


def test_shares_are_kept(rng: np.random.Generator) -> None:
    config = Backgrounds({"plain": 1.0, "noise": 3.0})
    kinds = [sample_background(config, rng=rng).kind for _ in range(400)]
    assert set(kinds) == {"plain", "noise"}
    assert 0.66 < kinds.count("noise") / 400 < 0.84


def test_photographs_fill_the_picture_and_broken_files_are_passed_over(photos: Path) -> None:
    config = only("photo", photos=str(photos))
    seen = set()
    for seed in range(12):
        background = sample_background(config, rng=np.random.default_rng(seed))
        assert background.photo is not None
        seen.add(Path(background.photo).name)
        picture = draw_background(background, SIZE)
        assert picture.shape == (120, 160, 3)
        assert picture[..., 1].max() < 0.01
        blue = Path(background.photo).name == "blue.png"
        assert picture[..., 2 if blue else 0].min() > 0.4
        assert picture[..., 0 if blue else 2].max() < 0.05
    assert seen == {"blue.png", "red.jpg"}


def test_photographs_are_cut_and_neither_repeated_nor_mirrored(tmp_path: Path) -> None:
    wide = np.repeat(np.linspace(20, 230, 400, dtype=np.uint8)[None], 100, axis=0)
    cv2.imwrite(str(tmp_path / "ramp.png"), np.dstack([wide] * 3))
    background = Background("photo", ((0.1, 0.1, 0.1),) * 2, 0, photo=str(tmp_path / "ramp.png"))
    for seed in range(4):
        picture = draw_background(dataclasses.replace(background, seed=seed), (64, 96))
        assert (np.diff(picture[..., 0], axis=1) >= 0.0).all() and np.ptp(picture[0, :, 0]) > 0.0
    several = tmp_path / "several"
    several.mkdir()
    for number in range(7):
        cv2.imwrite(str(several / f"{number}.png"), np.full((40, 60, 3), 30 * number, np.uint8))
    (several / "0broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 no photograph at all")
    walls = photos_beside(several / "5.png", 6)
    assert walls[0] == several / "5.png" and len(set(walls)) == 6 and several / "0broken.jpg" not in walls


def test_folders_without_photographs_are_told(photos: Path, tmp_path: Path) -> None:
    for name in ("blue.png", "more/red.jpg"):
        (photos / name).unlink()
    with pytest.raises(HandSimError, match=r"photos: no photograph that can be read"):
        sample_background(only("photo", photos=str(photos)), rng=np.random.default_rng(0))
    with pytest.raises(HandSimError, match="no such folder"):
        sample_background(only("photo", photos=str(tmp_path / "none")), rng=np.random.default_rng(0))


def test_impossible_configs_are_told() -> None:
    with pytest.raises(HandSimError, match="shares of backgrounds"):
        Backgrounds({"plain": 0.0})
    with pytest.raises(HandSimError, match="shares of backgrounds"):
        Backgrounds({"plain": -1.0})
    with pytest.raises(HandSimError, match="`photos`"):
        Backgrounds({"photo": 1.0})
    with pytest.raises(HandSimError, match=r"unknown background .rom. .did you mean .room."):
        draw_background(Background("rom", ((0.1, 0.1, 0.1),) * 2, 0), SIZE)  # type: ignore[arg-type]
    gone = Background("photo", ((0.1, 0.1, 0.1),) * 2, 0, photo="/nowhere/a.jpg")  # type: ignore[arg-type]
    with pytest.raises(HandSimError, match=r"/nowhere/a\.jpg: not a readable photograph"):
        draw_background(gone, SIZE)


def test_edges_of_rooms_are_smooth() -> None:
    """Nearly as the mean over sixteen rays has them."""
    for seed in (1, 2):
        coarse, fine = (draw_room((80 * k, 60 * k), seed) for k in (1, 4))
        mean = fine.reshape(60, 4, 80, 4, 3).mean(axis=(1, 3))
        off = np.abs(cv2.GaussianBlur(mean, (0, 0), 0.9) - coarse)
        assert np.quantile(off, 0.99) < 0.06
