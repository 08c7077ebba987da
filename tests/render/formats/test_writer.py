from __future__ import annotations

import dataclasses
import json
import tarfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from pycocotools.coco import COCO

from handsim import HandModel, HandSimError, look_at
from handsim.cli.main import main
from handsim.errors import DatasetError
from handsim.files.outputs import save_json
from render import Pictures, RenderedFrame, merge_renderings
from render.formats.shards import BESIDE
from render.formats.writer import CONFIG, FORMATS, open_writer
from tests.folders import contents
from tests.limits import file_size_limit
from tests.programs import ROOT, run_python
from tests.render.formats.reading import depth_of, exr_content


def broken(frame: RenderedFrame) -> Iterator[RenderedFrame]:
    yield frame
    raise KeyboardInterrupt


@pytest.mark.parametrize("name", FORMATS)
def test_a_shard_is_there_whole_or_not_at_all(name: str, make_frame, tmp_path: Path) -> None:
    writer = open_writer(name, tmp_path / "set")
    assert writer.done() == frozenset()
    writer.write(3, [make_frame(0), make_frame(1)])
    whole = contents(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        writer.write(12, broken(make_frame(2)))
    assert writer.done() == {3}
    assert contents(tmp_path) == whole
    assert open_writer(name, tmp_path / "set").done() == {3}


@pytest.mark.parametrize("name", FORMATS)
def test_the_same_frames_give_the_same_bytes_in_any_order(name: str, make_frame, tmp_path: Path) -> None:
    for folder, order in (("a", (0, 1)), ("b", (1, 0))):
        writer = open_writer(name, tmp_path / folder)
        for shard in order:
            writer.write(shard, [make_frame(2 * shard, ("right", "left")), make_frame(2 * shard + 1)])
        writer.finish()
        writer.finish()
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


@pytest.mark.parametrize("name", FORMATS)
def test_a_shard_may_be_written_anew(name: str, make_frame, tmp_path: Path) -> None:
    writer = open_writer(name, tmp_path / "a")
    writer.write(0, [make_frame(0), make_frame(1), make_frame(2)])
    writer.write(0, [make_frame(4)])
    other = open_writer(name, tmp_path / "b")
    other.write(0, [make_frame(4)])
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


@pytest.mark.parametrize("name", FORMATS)
def test_what_killed_writers_left_is_cleared(name: str, make_frame, tmp_path: Path) -> None:
    writer = open_writer(name, tmp_path)
    writer.write(0, [make_frame()])
    shards = tmp_path.rglob("shard-00000*")
    (place,) = (path.parent for path in shards if path.relative_to(tmp_path).parts[0] not in BESIDE)
    (place / ".shard-00000.tmp-1").mkdir()
    (place / ".shard-00000.tmp-1" / "rest.jpg").write_bytes(b"")
    (place / ".shard-00000.tmp-2.tar").write_bytes(b"")
    (place / ".shard-00007.tmp-3").mkdir()  # somebody else's, at work
    writer.write(0, [make_frame()])
    assert [path.name for path in place.glob(".shard*")] == [".shard-00007.tmp-3"]
    assert writer.done() == {0}


@pytest.mark.parametrize("name", FORMATS)
def test_a_place_that_takes_no_files_is_told(name: str, make_frame, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    writer = open_writer(name, tmp_path / "file" / "set")
    words = r"writing shard 0 failed: (Not a directory|.*is a file, not a folder); shards that were"
    with pytest.raises(HandSimError, match=words) as told:
        writer.write(0, [make_frame()])
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("name", FORMATS)
def test_a_full_disk_is_told_and_finished_shards_stay(name, make_frame, tmp_path):
    """The file system's own limit on a file's size stands for a full disk; both are an OSError."""
    writer = open_writer(name, tmp_path)
    writer.write(0, [make_frame(0)])
    before = contents(tmp_path)
    with file_size_limit(300), pytest.raises(HandSimError, match="writing shard 1 failed"):
        writer.write(1, [make_frame(1)])
    assert contents(tmp_path) == before
    assert writer.done() == {0}


@pytest.mark.parametrize("name", ["web", "freihand", "interhand", "COCO"])
def test_an_unknown_format_is_told(name: str, tmp_path: Path) -> None:
    words = f"unknown format '{name}'.*valid names: webdataset, coco, yolo, exr, png"
    with pytest.raises(HandSimError, match=words):
        open_writer(name, tmp_path)


@pytest.mark.parametrize("name", ["coco", "yolo"])
@pytest.mark.parametrize("content", ["[{", "{}", "[1]"])
def test_a_damaged_index_is_told(name: str, content: str, make_frame, tmp_path: Path) -> None:
    writer = open_writer(name, tmp_path)
    writer.write(0, [make_frame()])
    (index,) = tmp_path.rglob("index.json")
    index.write_text(content)
    with pytest.raises(DatasetError, match=r"index\.json: damaged.*delete the folder shard-00000"):
        writer.finish()
    index.unlink()
    with pytest.raises(DatasetError, match="cannot be read"):
        writer.finish()


@pytest.mark.parametrize("name", ["png", "exr", "coco", "yolo"])
def test_two_frames_of_one_name_are_told(name: str, make_frame, tmp_path: Path) -> None:
    with pytest.raises(HandSimError, match="two frames of a shard are called 'small_000001'"):
        open_writer(name, tmp_path).write(0, [make_frame(1), make_frame(1)])


@pytest.mark.parametrize("name", ["png", "coco", "yolo"])
def test_only_photographs_lie_among_the_photographs(name: str, make_frame, tmp_path: Path) -> None:
    """What trains on all pictures of a folder, as ultralytics does, must find no depth or ids there."""
    writer = open_writer(name, tmp_path)
    writer.write(0, [make_frame(number, noisy=True) for number in range(3)])
    writer.finish()
    pictures = [path for path in (tmp_path / "images").rglob("*") if path.suffix in (".png", ".jpg")]
    assert sorted(path.stem for path in pictures) == [f"small_{number:06d}" for number in range(3)]
    for picture in pictures:
        assert cv2.imread(str(picture), cv2.IMREAD_UNCHANGED).dtype == np.uint8
        for kind in ("depth", "depth_ideal", "ids", "normals"):
            within = picture.relative_to(tmp_path / "images").with_suffix(".png")
            assert (tmp_path / kind / within).is_file()


@pytest.mark.parametrize("name", ["coco", "yolo"])
def test_images_name_their_files_of_depth_and_ids(name: str, make_frame, tmp_path: Path) -> None:
    frame = make_frame(2)
    writer = open_writer(name, tmp_path)
    writer.write(0, [frame])
    writer.finish()
    (file,) = (*tmp_path.glob("annotations.json"), *tmp_path.rglob("*_data.json"))
    (image,) = json.loads(file.read_text())["images"]
    depth = depth_of((tmp_path / image["depth_file"]).read_bytes())
    np.testing.assert_allclose(depth, frame.ideal.depth, atol=1e-4)
    ids = cv2.imread(str(tmp_path / image["ids_file"]))
    np.testing.assert_array_equal(ids[..., 1], frame.ideal.instances)
    assert (tmp_path / image["normals_file"]).is_file() and "depth_ideal_file" not in image


def test_a_shard_without_depth_replaces_one_with_depth(make_frame, tmp_path: Path) -> None:
    frame, writer = make_frame(0), open_writer("coco", tmp_path)
    writer.write(0, [frame])
    writer.write(0, [dataclasses.replace(frame, ideal=Pictures(rgb=frame.ideal.rgb))])
    assert [path.name for path in tmp_path.rglob("*.png")] == []


def test_png_and_exr_hold_the_pictures(make_frame, tmp_path: Path) -> None:
    frame = make_frame(7, ("right", "left"), noisy=True)
    for name, inside in (("png", "images"), ("exr", ".")):
        open_writer(name, tmp_path / name).write(0, [frame])
        record = json.loads((tmp_path / name / inside / "shard-00000" / "small_000007.json").read_text())
        assert [hand["side"] for hand in record["hands"]] == ["right", "left"]
        if name == "png":
            depth = depth_of((tmp_path / "png" / record["depth_file"]).read_bytes())
            np.testing.assert_allclose(depth, frame.noisy.depth, atol=1e-4)
            ideal = depth_of((tmp_path / "png" / record["depth_ideal_file"]).read_bytes())
            np.testing.assert_allclose(ideal, frame.ideal.depth, atol=1e-4)
    picture = cv2.imread(str(tmp_path / "png" / "images" / "shard-00000" / "small_000007.png"))
    np.testing.assert_array_equal(picture[..., ::-1], frame.noisy.rgb)
    channels = exr_content(tmp_path / "exr" / "shard-00000" / "small_000007.exr")[1]
    np.testing.assert_array_equal(channels["Z"], frame.ideal.depth)


# ---- clips


@pytest.fixture
def clip(make_frame, camera, tmp_path: Path) -> tuple[Path, list[RenderedFrame]]:
    other = dataclasses.replace(camera, name="other").at(look_at(np.array([0.1, -0.5, -0.3]), np.zeros(3)))
    views = [(number, view) for number in (4, 5) for view in (camera, other)]
    frames = [make_frame(number, ("right", "left"), camera=view, noisy=True) for number, view in views]
    writer = open_writer("webdataset", tmp_path)
    writer.write(0, frames)
    writer.finish()
    return tmp_path / "shard-00000.tar", frames


def test_a_tar_holds_samples_and_the_hand(clip) -> None:
    path, _ = clip
    with tarfile.open(path) as tar:
        members = tar.getmembers()
        shapes = json.load(tar.extractfile("__hand_shapes.json__"))
    assert {(member.mtime, member.uid, member.gid, member.uname) for member in members} == {(0, 0, 0, "")}
    names = [member.name for member in members]
    assert len(set(names)) == len(names)
    pictures = ("image_{}.jpg", "depth_{}.png", "depth_ideal_{}.png", "normals_{}.png", "ids_{}.png")
    tables = ("cameras", "hands", "hand_crops", "objects", "markers", "choices", "info")
    expected = {name.format(stream) for name in pictures for stream in ("small", "other")}
    expected |= {f"{kind}.json" for kind in tables}
    assert {name.partition(".")[2] for name in names if name.startswith("000004.")} == expected
    assert len(shapes["umetrack"]["mesh_vertices"]) == len(HandModel.named("M").surface.vertices)


def test_webdataset_iterates_it(clip) -> None:
    webdataset = pytest.importorskip("webdataset")
    path, frames = clip
    samples = list(webdataset.WebDataset(str(path), shardshuffle=False))
    assert [sample["__key__"] for sample in samples] == ["000004", "000005"]
    for sample, frame in zip(samples, frames[::2], strict=True):
        np.testing.assert_allclose(depth_of(sample["depth_small.png"]), frame.noisy.depth, atol=1e-4)
        np.testing.assert_allclose(depth_of(sample["depth_ideal_small.png"]), frame.ideal.depth, atol=1e-4)
        picture = cv2.imdecode(np.frombuffer(sample["image_other.jpg"], np.uint8), cv2.IMREAD_COLOR)
        assert picture.shape == (72, 96, 3)
        assert set(json.loads(sample["cameras.json"])) == {"small", "other"}
        assert json.loads(sample["objects.json"])["pen"][0]["object_name"] == "pen"


def test_people_who_share_a_clip_get_no_common_hand(make_frame, tmp_path: Path) -> None:
    frame = make_frame(0)
    small = HandModel.named("S").shape
    other = dataclasses.replace(make_frame(1), hands=(dataclasses.replace(frame.hands[0], shape=small),))
    open_writer("webdataset", tmp_path).write(0, [frame, other])
    with tarfile.open(tmp_path / "shard-00000.tar") as tar:
        assert "__hand_shapes.json__" not in tar.getnames()


def test_what_a_clip_cannot_hold_is_told(make_frame, camera, tmp_path: Path) -> None:
    writer = open_writer("webdataset", tmp_path)
    first, second = make_frame(0), make_frame(1)
    for frames, told in [
        ([first, second, first], "the pictures of frame 0 do not follow one another"),
        ([first, first], "frame 0 has two pictures of one camera: small, small"),
        ([make_frame(0, ("left", "left"))], "hands left and left"),
        ([make_frame(camera=dataclasses.replace(camera, name="a.b"))], "camera 'a.b': a stream's name"),
    ]:
        with pytest.raises(HandSimError, match=told):
            writer.write(0, frames)
    assert writer.done() == frozenset()


def test_writers_need_no_window():
    """Files can be written, and read, where nothing can be drawn."""
    code = "import sys, render.formats.writer; print({'pyrender', 'OpenGL', 'torch'} & set(sys.modules))"
    assert run_python(code).stdout == "set()\n"


def test_the_page_names_every_format():
    page = (ROOT / "docs" / "formats.md").read_text("utf-8")
    assert all(f"| `{name}` |" in page for name in FORMATS)


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
    former = [rendering(tmp_path / name, make_frame, ("coco",)) for name in "df"]
    for folder in former:
        save_json(folder / CONFIG, {"formats": ["freihand"], "take_frames": 4})
    out = tmp_path / "c"
    with pytest.raises(HandSimError, match="has the formats png, expected coco"):
        merge_renderings([coco, png], out)
    with pytest.raises(HandSimError, match="two or more different folders"):
        merge_renderings([coco, coco], out)
    with pytest.raises(HandSimError, match="unknown format of a rendering 'freihand'; valid names: webd"):
        merge_renderings(former, out)
    with pytest.raises(HandSimError, match="expected a folder that handsim render wrote"):
        merge_renderings([coco, tmp_path], out)
    assert not out.exists()
    other = rendering(tmp_path / "e", make_frame, ("png",))
    next((png / "images" / "shard-00001").glob("*.png")).parent.joinpath("index.json").write_text("[{}]")
    with pytest.raises(DatasetError, match="its index does not fit its files"):
        merge_renderings([other, png], out)
