"""The pages quote the figures that docs/figures.toml holds, and no others."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[1]


def _script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("renew_figures", ROOT / "docs" / "renew_figures.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["renew_figures"] = module
    spec.loader.exec_module(module)
    return module


renew = _script()
FIGURES = renew.load_figures()
VALUES = renew.values(FIGURES)
PAGES = {page.relative_to(ROOT).as_posix(): page for page in renew.pages()}


@pytest.mark.parametrize("name", PAGES)
def test_a_page_quotes_what_the_file_holds(name):
    text = PAGES[name].read_text(encoding="utf-8")
    wrong = []
    for quote in renew.quotes(text):
        assert quote.key in VALUES, f"{name} quotes {quote.key}, which docs/figures.toml does not have"
        expected = renew.expected(VALUES, quote.key, quote.part)
        if quote.text != expected:
            wrong.append(f"{quote.key}: {quote.text}, in the file {expected}")
    assert wrong == [], f"{name}: `make figures` puts it right"
    assert text.count("<!--fig:") == text.count("<!--/-->") == len(list(renew.quotes(text)))


def test_every_figure_is_quoted_somewhere():
    quoted = {
        quote.key for page in PAGES.values() for quote in renew.quotes(page.read_text(encoding="utf-8"))
    }
    assert sorted(set(VALUES) - quoted) == []


def test_every_measured_figure_has_a_command_and_a_pattern():
    for name, run in FIGURES["runs"].items():
        for key, figure in run["figures"].items():
            assert figure["value"] and figure["what"], f"{name}.{key}"
            assert ("pattern" in figure) == (name != "paper"), f"{name}.{key}"
        if name != "paper":
            assert {"command", "minutes", "commit", "machine", "date"} <= set(run), name


@pytest.mark.parametrize("name", FIGURES["checks"])
def test_no_measured_number_stands_without_a_tag(name):
    check = FIGURES["checks"][name]
    text = PAGES[name].read_text(encoding="utf-8")
    for heading in check.get("sections", []):
        assert f"# {heading}\n" in text, f"{name} has no section '{heading}'"
    assert renew.untagged(text, check.get("sections"), check["allowed"]) == []


def test_a_number_of_tables_and_of_prose_is_read():
    output = "┃ x ┃ y ┃\n│ handsim │ calibrated │ 99.15 │  98.2 │\n│ handsim │ calibrated │ 97.00 │ 99.0 │\n"
    pattern = r"^handsim \| calibrated \| ([\d.]+) \| ([\d.]+)$"
    assert renew.parse(output, {"pattern": pattern}) == "99.15 | 98.2"
    assert renew.parse(output, {"pattern": pattern, "form": "{1} at {0:.1f}"}) == "98.2 at 99.2"
    assert renew.parse(output, {"pattern": pattern, "fold": "range"}) == "97.00 to 99.15 | 98.2 to 99.0"
    with pytest.raises(ValueError, match="nothing in the output"):
        renew.parse("", {"pattern": pattern})


def test_a_wrong_quote_and_an_untagged_number_are_noticed():
    page = "## Speed\n\n| a | <!--fig:run.a-->1.0 | 2.0<!--/--> |\n\nIt takes 3.5 ms.\n"
    known = {"run.a": "1.0 | 2.5"}
    assert [quote.text for quote in renew.quotes(page)] == ["1.0 | 2.0"]
    assert "<!--fig:run.a-->1.0 | 2.5<!--/-->" in renew.rewrite(page, known)
    assert renew.expected(known, "run.a", 2) == "2.5"
    assert renew.untagged(page, None, []) == ["It takes 3.5 ms."]
    assert renew.untagged(page, ["Size"], []) == []
    assert renew.untagged(page, ["Speed"], [r"3\.5 ms"]) == []


def test_a_renewed_value_is_stored_in_its_own_run():
    text = '[runs.a]\ncommit = "x"\ndate = "y"\n\n[runs.a.figures]\nv = { value = "1", what = "" }\n\n'
    text += text.replace("runs.a", "runs.b")
    stored = renew.stored(text, "b", {"v": "2"})
    assert stored.count('value = "1"') == stored.count('value = "2"') == 1
    assert stored.index('value = "1"') < stored.index('value = "2"')
    assert stored.count('commit = "x"') == 1
