"""The blocks of the documents run as they stand and print what the documents say (tests/documents.py)."""

from __future__ import annotations

import importlib
import re

import pytest

from poses.shapes import SAMPLERS
from tests.documents import PAGES, ROOT, blocks_of, name_of, run_blocks
from track.output.sinks import GROUP as SINKS
from track.streams.live_stream import GROUP as SOURCES
from train.data.batches import CORRUPTIONS
from train.labelers.protocol import LABELERS

NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
SLOW = {
    "angles",
    "calibration",
    "layouts",
    "own_labelers",
    "rigs",
    "cluster",
    "live_output",
    "rendering",
    "stored_arrays",
    "tracking",
    "formats",
    "tutorials/my_captures",
    "tutorials/my_layout",
    "tutorials/my_pictures",
    "tutorials/my_trial",
}
RUN = [page for page in PAGES if blocks_of(page)]
GROUPS = {CORRUPTIONS, LABELERS, SAMPLERS, SINKS, SOURCES}  # of entry points


@pytest.fixture
def commands(tmp_path_factory):
    """A folder for the command handsim, outside the page's own."""
    return tmp_path_factory.mktemp("commands")


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(page, id=name_of(page), marks=[pytest.mark.slow] * (name_of(page) in SLOW))
        for page in RUN
    ],
)
def test_the_blocks_of_a_page_run_and_print_what_the_page_says(path, tmp_path, commands):
    blocks = blocks_of(path)
    for block, printed in zip(blocks, run_blocks(blocks, tmp_path, commands), strict=True):
        if block.prints is None:
            continue
        assert NUMBER.sub("#", printed).split() == NUMBER.sub("#", block.prints).split(), block.name
        for ours, stated in zip(NUMBER.findall(printed), NUMBER.findall(block.prints), strict=True):
            # the last digits depend on the machine
            assert float(ours) == pytest.approx(float(stated), rel=0.05, abs=0.2), block.name


def test_the_script_of_the_readme_mostly_agrees_with_the_truth(tmp_path, commands):
    script = next(block for block in blocks_of(ROOT / "README.md") if block.kind == "python")
    (printed,) = run_blocks([script], tmp_path, commands)
    labels, truth = (list(map(int, re.findall(r"-?\d+", row))) for row in printed.split("]")[:2])
    assert len(labels) == len(truth) >= 14
    assert sum(a == b for a, b in zip(labels, truth, strict=True)) > 0.8 * len(truth)


def test_every_python_and_shell_block_of_the_documents_is_run():
    for path in PAGES:
        text = path.read_text(encoding="utf-8")
        shown = [block for block in blocks_of(path) if f"```{block.kind}\n{block.code}" in text]
        assert len(shown) == len(re.findall(r"^ *```(?:python|sh|bash|console)\b", text, re.M)), path.name


def test_every_link_to_a_file_leads_to_one():
    missing = []
    for path in PAGES:
        for target in re.findall(r"\]\((?!https?:)([^)#]+)", path.read_text(encoding="utf-8")):
            if not (path.parent / target).is_file():
                missing.append(f"{path.name}: {target}")
    assert missing == []


def test_a_block_that_fails_is_named(tmp_path, commands):
    page = tmp_path / "page.md"
    page.write_text(
        "# Page\n\n<!-- test:\nvalue = 3\n-->\n\n```python\nprint(value)\nraise ValueError(value)\n```\n"
    )
    hidden, shown = blocks_of(page)
    assert run_blocks([hidden], tmp_path, commands) == [""]
    with pytest.raises(AssertionError, match=r'page\.md:8", line 2(.|\n)*ValueError: 3'):
        run_blocks([hidden, shown], tmp_path, commands)


def test_a_line_of_the_shell_that_fails_is_named(tmp_path, commands):
    page = tmp_path / "page.md"
    page.write_text("# Page\n\n```sh\nhandsim --version | cut -c 1-7\n```\n\n```sh\nhandsim trian\n```\n")
    right, wrong = blocks_of(page)
    assert run_blocks([right], tmp_path, commands) == ["handsim\n"]
    with pytest.raises(AssertionError, match=r"page\.md:8: exit code 2(.|\n)*did you mean 'train'"):
        run_blocks([wrong], tmp_path, commands)


def test_every_module_that_a_page_names_exists():
    missing = []
    for path in [ROOT / "README.md", *PAGES]:
        for name in re.findall(
            r"`((?:handsim|poses|gloves|render|train|track|film)(?:\.(?!(?:py|json|jpg|npz|mp4|html)\b)\w+)+)",
            path.read_text(),
        ):
            if name not in GROUPS and not _exists(name):
                missing.append(f"{path.name}: {name}")
    assert missing == []


def _exists(name: str) -> bool:
    """Whether a dotted name is a module, or something that a module has."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        try:
            thing: object = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for part in parts[length:]:
            if not hasattr(thing, part) and part not in getattr(thing, "__annotations__", {}):
                return False
            thing = getattr(thing, part, None)
        return True
    return False
