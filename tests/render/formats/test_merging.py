"""Merged renderings: readers find every picture once, with keys and ids of its own."""

from __future__ import annotations

import json
import tarfile
from pathlib import Path

import pytest
from pycocotools.coco import COCO

from handsim.cli.main import main
from handsim.errors import DatasetError, HandSimError
from handsim.files.json_files import save_json
from render.formats.merging import CONFIG, merge_renderings
from render.formats.writer import open_writer


def rendering(folder, make_frame, formats, *, frames=4, start=0):
    """What `render_take` leaves: two shards of each format, and its settings."""
    for name in formats:
        writer = open_writer(name, folder if len(formats) == 1 else folder / name)
        for shard in range(2):
            writer.write(shard, [make_frame(start + number) for number in (2 * shard, 2 * shard + 1)])
        writer.finish()
    save_json(folder / CONFIG, {"formats": list(formats), "frames": frames, "take": folder.name})
    return folder


@pytest.mark.parametrize("formats", [("coco",), ("webdataset", "coco", "png", "exr")])
def test_every_picture_is_there_once(tmp_path, make_frame, formats):
    folders = [rendering(tmp_path / name, make_frame, formats) for name in "ab"]
    assert merge_renderings(folders, tmp_path / "c") == 4
    coco = COCO(tmp_path / "c" / ("" if len(formats) == 1 else "coco") / "annotations.json")
    images = coco.loadImgs(coco.getImgIds())
    assert sorted(image["frame"] for image in images) == list(range(8))
    assert len({image["file_name"] for image in images}) == len({image["id"] for image in images}) == 8
    assert len(set(coco.getAnnIds())) == 8
    for image in images:
        base = tmp_path / "c" / ("" if len(formats) == 1 else "coco") / "images"
        first = tmp_path / ("a" if image["frame"] < 4 else "b") / base.relative_to(tmp_path / "c")
        name = f"shard-{image['frame'] % 4 // 2:05d}/small_{image['frame'] % 4:06d}.jpg"
        assert (base / image["file_name"]).read_bytes() == (first / name).read_bytes()
    if len(formats) == 1:
        return
    keys = []
    for tar in sorted((tmp_path / "c" / "webdataset").glob("*.tar")):
        with tarfile.open(tar) as opened:
            for name in opened.getnames():
                if name.endswith(".info.json"):
                    keys.append(name.partition(".")[0])
                    assert json.loads(opened.extractfile(name).read())["number"] == int(keys[-1])
    assert keys == [f"{number:06d}" for number in range(8)]
    for kind, ending in (("png/images", ".png"), ("exr", ".exr")):
        for number in range(8):
            start = tmp_path / "c" / kind / f"shard-{number // 2:05d}" / f"small_{number:06d}"
            assert start.with_suffix(ending).is_file()
            record = json.loads(start.with_suffix(".json").read_text())
            assert record["number"] == number
            if ending == ".png":
                copied, first = tmp_path / "c" / "png", tmp_path / ("a" if number < 4 else "b") / "png"
                old = first / "ids" / f"shard-{number % 4 // 2:05d}" / f"small_{number % 4:06d}.png"
                assert (copied / record["ids_file"]).read_bytes() == old.read_bytes()
                assert record["ids_file"] == f"ids/shard-{number // 2:05d}/{start.name}.png"


def test_labels_and_other_pictures_are_copied_with_their_photographs(tmp_path, make_frame):
    folders = [rendering(tmp_path / name, make_frame, ("yolo",)) for name in "ab"]
    merge_renderings(folders, tmp_path / "c")
    images = json.loads((tmp_path / "c" / "annotations.json").read_text())["images"]
    assert len(images) == 8 and (tmp_path / "c" / "data.yaml").is_file()
    for image in images:
        frame = image["frame"]
        first = tmp_path / ("a" if frame < 4 else "b")
        old = f"shard-{frame % 4 // 2:05d}/small_{frame % 4:06d}"
        new = Path(image["file_name"]).with_suffix("")
        assert image["depth_file"] == f"depth/{new}.png"
        for kind, ending in (("labels", ".txt"), ("depth", ".png"), ("normals", ".png"), ("images", ".jpg")):
            copied = (tmp_path / "c" / kind / f"{new}{ending}").read_bytes()
            assert copied == (first / kind / f"{old}{ending}").read_bytes()


def test_merged_renderings_can_be_merged(tmp_path, make_frame):
    folders = [rendering(tmp_path / name, make_frame, ("webdataset",)) for name in "abc"]
    merge_renderings(folders[:2], tmp_path / "ab")
    assert merge_renderings([tmp_path / "ab", folders[2]], tmp_path / "abc") == 6
    samples = set()
    for tar in (tmp_path / "abc").glob("*.tar"):
        with tarfile.open(tar) as opened:
            samples |= {name.partition(".")[0] for name in opened.getnames() if name[0].isdigit()}
    assert samples == {f"{number:06d}" for number in range(12)}


def test_the_command(tmp_path, make_frame, capsys):
    folders = [rendering(tmp_path / name, make_frame, ("coco",)) for name in "ab"]
    line = ["render", "--merge", *map(str, folders), "--out", str(tmp_path / "c")]
    assert main(line) == 0
    assert "4 shards of 2 renderings" in capsys.readouterr().out
    assert main(line) == 1
    assert "is not empty" in capsys.readouterr().err


def test_mistakes_are_told(tmp_path, make_frame):
    coco = rendering(tmp_path / "a", make_frame, ("coco",))
    png = rendering(tmp_path / "b", make_frame, ("png",))
    hands = rendering(tmp_path / "d", make_frame, ("freihand",))
    out = tmp_path / "c"
    with pytest.raises(HandSimError, match="has the formats png, expected coco"):
        merge_renderings([coco, png], out)
    with pytest.raises(HandSimError, match="two or more different folders"):
        merge_renderings([coco, coco], out)
    with pytest.raises(HandSimError, match="format freihand cannot be merged"):
        merge_renderings([hands, hands], out)
    with pytest.raises(HandSimError, match="expected a folder that handsim render wrote"):
        merge_renderings([coco, tmp_path], out)
    assert not out.exists()
    other = rendering(tmp_path / "e", make_frame, ("png",))
    next((png / "images" / "shard-00001").glob("*.png")).parent.joinpath("index.json").write_text("[{}]")
    with pytest.raises(DatasetError, match="its index does not fit its files"):
        merge_renderings([other, png], out)
