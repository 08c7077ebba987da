"""A page of pictures and figures: one HTML file without scripts, its pictures beside it or inside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Final

from handsim.files.outputs import atomic_write

_STYLE: Final = """
:root { color-scheme: light dark; --ink: #23272f; --soft: #5b6270; --paper: #ffffff; --card: #f4f5f7;
  --line: #d9dde3; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6e8ec; --soft: #a3abb8; --paper: #16181c; --card: #f4f5f7; --line: #3a3f48; }
}
body { margin: 0 auto; padding: 2rem 1.2rem 4rem; max-width: 70rem; background: var(--paper);
  color: var(--ink); font: 1rem/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 1.9rem; margin: 0 0 .2rem; } h2 { font-size: 1.3rem; margin: 2.6rem 0 .4rem; }
p { max-width: 46rem; margin: .4rem 0 1rem; } .lead, figcaption, .note { color: var(--soft); }
figure { margin: 1rem 0 1.6rem; }
.card { display: block; background: var(--card); border: 1px solid var(--line); border-radius: .6rem;
  padding: .6rem; }
img { display: block; max-width: 100%; max-height: 44rem; margin: 0 auto; }
div.card img { max-height: none; }
figcaption, .note { font-size: .92rem; margin-top: .4rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .35rem .9rem .35rem 0; border-bottom: 1px solid var(--line); text-align: right; }
th:first-child, td:first-child { text-align: left; padding-right: 2.5rem; }
@media print {
  :root { color-scheme: light; --ink: #23272f; --soft: #5b6270; --paper: #ffffff; --line: #d9dde3; }
  @page { margin: 14mm; }
  body { max-width: none; padding: 0; font-size: .8rem; }
  h2, h2 + p, tr:first-child { break-after: avoid; } figure, tr { break-inside: avoid; }
}
"""


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
    notes: Sequence[str] = field(default_factory=tuple)


def write_page(path: Path, sections: Sequence[Section], *, title: str, lead: str) -> None:
    """Write the page with this title and the lead below it; it loads nothing from the network."""
    body = "\n".join(_section(section) for section in sections)
    page = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
        f'<h1>{escape(title)}</h1>\n<p class="lead">{escape(lead)}</p>\n'
        f"{body}\n</body>\n</html>\n"
    )
    with atomic_write(path) as temporary:
        temporary.write_text(page, "utf-8", errors="replace")  # names of files need not be text


def _section(section: Section) -> str:
    parts = [f"<h2>{escape(section.title)}</h2>", f"<p>{section.text}</p>"]
    for file, caption in section.pictures:
        name, text = escape(file), escape(caption)
        image = f'<img src="{name}" alt="{text}">'
        # Browsers refuse to open a data: URI from a link.
        inside = name.startswith("data:")
        card = f'<div class="card">{image}</div>' if inside else f'<a class="card" href="{name}">{image}</a>'
        parts.append(f"<figure>{card}<figcaption>{text}</figcaption></figure>")
    if section.table:
        header, *rows = section.table
        lines = ["<tr>" + "".join(f"<th>{escape(cell)}</th>" for cell in header) + "</tr>"]
        lines += ["<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows]
        parts.append("<table>\n" + "\n".join(lines) + "\n</table>")
    parts += [f'<p class="note">{escape(note)}</p>' for note in section.notes]
    return "\n".join(parts)
