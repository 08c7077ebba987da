"""Pages on takes, training sets, gloves and rigs: HTML files without scripts, and the pictures in them."""

from __future__ import annotations

import base64
import colorsys
import importlib.util
import io
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import chdir, contextmanager, nullcontext
from dataclasses import dataclass
from html import escape
from pathlib import Path
from pkgutil import resolve_name
from string import Template
from typing import TYPE_CHECKING, Any, Concatenate, Final, ParamSpec

from handsim._checks import check_type, unexpected
from handsim._process import environment
from handsim._version import full_version
from handsim.files.outputs import check_ending, write_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

# By names, because the packages that make pages lie above this one.
_PAGE_WRITERS: Final = {
    "gloves.takes.take.Take": "track.takes.take_page:write_take_page",
    "train.data.shards.Dataset": "train.reports.dataset_page:write_dataset_page",
    "film.registration.Registration": "film.page:write_film_page",
    "track.gloves.glove_score.LayoutScore": "track.gloves.glove_page:write_glove_page",
    "track.gloves.learned_glove.LearnedGlove": "track.gloves.learned_page:write_learned_page",
    "train.forecast.rig_score.RigScore": "train.forecast.rig_score:write_rig_page",
}
NOTHING: Final = "-"
"""The cell of a table where there is no number."""
_PAGE_TEMPLATE: Final = Path(__file__).parent / "data" / "page.html"


class Paint:
    """The colors of all pictures."""

    INK, SOFT, LINE, BAND, CARD = "#23272f", "#5b6270", "#c3c8d0", "#e0e4e9", "#f4f5f7"
    BLUE, PALE, AMBER, WARM, GREEN, VIOLET = "#3f7396", "#a9c3d4", "#d9a441", "#b8572b", "#5b8c5a", "#7a5ba0"


_PICTURE_SETTINGS: Final[dict[str, Any]] = {
    "font.size": 9.0,
    "text.color": Paint.INK,
    "axes.labelcolor": Paint.SOFT,
    "axes.labelsize": 9.0,
    "axes.titlesize": 9.5,
    "axes.edgecolor": Paint.LINE,
    "axes.facecolor": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": Paint.LINE,
    "ytick.color": Paint.LINE,
    "xtick.labelcolor": Paint.SOFT,
    "ytick.labelcolor": Paint.SOFT,
    "figure.facecolor": Paint.CARD,  # the page's card, which dark pages invert with the figure
    "savefig.facecolor": Paint.CARD,
    "svg.hashsalt": "handsim",  # ids that do not change from one run to the next
}
_DrawArguments = ParamSpec("_DrawArguments")


def write_page(path: str | Path, thing: Any) -> None:
    """Write the page on a thing: one HTML file with its pictures inside, complete or not at all.

    Args:
        path: The page, an .html file; the tables of a take (.csv) lie beside it.
        thing: A take, a training set, or what `register_camera`, `learn_glove`, `score_glove` or `score_rig`
            returned; pages show angles in [deg] and distances in [mm].

    Raises:
        ArgumentError: It is something else, or the page's name does not end in .html.
        OSError: A file cannot be written.
    """
    check_type("path", path, (str, os.PathLike), "the path of an .html file")
    check_ending(Path(path), ".html", option="path")
    kinds = (f"{kind.__module__}.{kind.__qualname__}" for kind in type(thing).__mro__)
    target = next((_PAGE_WRITERS[kind] for kind in kinds if kind in _PAGE_WRITERS), None)
    if target is None:
        things = "a Take, a Dataset, a Registration, a LearnedGlove, or a score of a glove or a rig"
        raise unexpected("thing", thing, things)
    resolve_name(target)(Path(path), thing)


def coordinates(point: Iterable[float], separator: str = " ") -> str:
    """A point with two decimals."""
    return separator.join(f"{round(float(one), 2) + 0.0:.2f}" for one in point)


def joint_words(name: str) -> str:
    """The name of a joint angle in words, without its digit, such as "PIP flexion"."""
    return name.split("_", 1)[1].replace("_", " ")


@dataclass(frozen=True, slots=True)
class Section:
    """One heading with the text, pictures and table below it."""

    title: str
    text: str
    """HTML."""
    pictures: Sequence[tuple[str, str]] = ()
    """File beside the page, or the picture itself as a `data:` URI, and caption."""
    table: Sequence[Sequence[str]] = ()
    """Rows of cells, the header first."""
    notes: Sequence[str] = ()


def write_sections(path: Path, sections: Sequence[Section], *, title: str, lead: str) -> None:
    """Write a page of sections, with a title and the lead below it; it loads nothing from the network."""
    words = {"title": escape(title), "lead": escape(lead), "version": f"handsim {full_version()}"}
    body = "\n".join(_section_html(section) for section in sections)
    write_text(path, Template(_PAGE_TEMPLATE.read_text("utf-8")).substitute(words, body=body))


def html_list(sentences: Sequence[str], kind: str = "ol") -> str:
    """Sentences as an HTML list."""
    return f"<{kind}>{''.join(f'<li>{escape(one)}</li>' for one in sentences)}</{kind}>"


def _section_html(section: Section) -> str:
    """The HTML of a section."""
    parts = [f"<h2>{escape(section.title)}</h2>", f"<p>{section.text}</p>"]
    for file, caption in section.pictures:
        name, text = escape(file), escape(caption)
        image = f'<img src="{name}" alt="{text}">'
        # Browsers refuse to open a data: URI from a link.
        inside = name.startswith("data:")
        card = f'<div class="card">{image}</div>' if inside else f'<a class="card" href="{name}">{image}</a>'
        parts.append(f"<figure>{card}<figcaption>{text}</figcaption></figure>")
    if section.table:
        rows = [
            f"<tr>{''.join(f'<{tag}>{escape(cell)}</{tag}>' for cell in row)}</tr>"
            for row, tag in zip(section.table, ["th"] + ["td"] * (len(section.table) - 1), strict=True)
        ]
        parts.append("<table>\n" + "\n".join(rows) + "\n</table>")
    parts += [f'<p class="note">{escape(note)}</p>' for note in section.notes]
    return "\n".join(parts)


@contextmanager
def own_figures(settings: dict[str, Any]) -> Iterator[type[Figure]]:
    """The class of figures; within the block their settings are matplotlib's defaults and these.

    matplotlib is imported here. pyplot, which needs a backend, is not used.
    """
    _import_matplotlib()
    from matplotlib import rc_context, rcParamsDefault
    from matplotlib.figure import Figure

    usual: dict[Any, Any] = {name: value for name, value in rcParamsDefault.items() if name != "backend"}
    with rc_context(usual | settings):
        yield Figure


def _import_matplotlib() -> None:
    """Import matplotlib; if the user's backend or settings file prevents that, import it without them."""
    try:
        importlib.import_module("matplotlib")
    except (ValueError, OSError):
        for name in [name for name in sys.modules if name.startswith("matplotlib.")]:
            del sys.modules[name]  # a package that is half imported cannot be imported again
        found = importlib.util.find_spec("matplotlib")
        usual = Path(str(found and found.origin)).with_name("mpl-data")
        # A file in the current folder is read before the one that the variable names.
        here = chdir(usual) if Path("matplotlibrc").exists() else nullcontext()
        with environment(MPLBACKEND="", MATPLOTLIBRC=str(usual)), here:
            importlib.import_module("matplotlib")


def picture(
    size: tuple[float, float],
    draw: Callable[Concatenate[Figure, _DrawArguments], None],
    *args: _DrawArguments.args,
    **options: _DrawArguments.kwargs,
) -> str:
    """A figure of this size [inch], drawn by a function, as SVG in a `data:` URI.

    The same numbers give the same bytes.
    """
    drawn = io.BytesIO()
    with own_figures(_PICTURE_SETTINGS) as new_figure:
        figure = new_figure(figsize=size, layout="constrained")
        draw(figure, *args, **options)
        figure.savefig(drawn, format="svg", metadata={"Date": None, "Creator": None})
    return "data:image/svg+xml;base64," + base64.b64encode(drawn.getvalue()).decode()


def color_scale(worst: float, best: float) -> ScalarMappable:
    """Colors for numbers from the worst to the best; `to_rgba` gives the color of one."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    colors = [Paint.WARM, Paint.AMBER, Paint.PALE, Paint.BLUE]
    scale = LinearSegmentedColormap.from_list("scale", colors if worst < best else colors[::-1])
    return ScalarMappable(Normalize(min(worst, best), max(worst, best)), scale)


def distinct_colors(count: int) -> list[tuple[float, float, float]]:
    """Different colors (sRGB in [0, 1]); hues follow the order, and neighbors differ in brightness."""
    return [colorsys.hsv_to_rgb(0.92 * one / count, 1.0, 0.9 if one % 2 else 0.6) for one in range(count)]


def color_bar(figure: Figure, colors: ScalarMappable, label: str, **place: Any) -> Axes:
    """Draw the bar that explains colors, without an outline."""
    bar = figure.colorbar(colors, **place)
    bar.set_label(label)
    bar.outline.set_visible(False)
    return bar.ax


def annotate(
    panel: Axes, text: str, point: tuple[float, float], shift: tuple[float, float], **style: Any
) -> None:
    """Write beside a point of a panel, shifted by some [points]."""
    panel.annotate(text, point, shift, textcoords="offset points", **style)
