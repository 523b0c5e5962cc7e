"""A page from pieces: text, tables, pictures, one script of its own; nothing from elsewhere."""

from __future__ import annotations

import base64
import hashlib
import html
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sysid.errors import shown_plainly
from sysid.plot.canvas import heat_map, to_png
from sysid.structure.thresholds import ROUND_OFF

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sysid.structure.structure import Array


class Cell(NamedTuple):
    """A cell of a table, with smaller lines below its value."""

    value: object
    below: tuple[str, ...] = ()


def escaped(value: object) -> str:
    """Escape anything for use inside an element or a quoted attribute; control characters are spelled out."""
    return html.escape(shown_plainly(str(value)), quote=True)


def prose(value: object) -> str:
    """Escape a sentence; an option of a command, such as --leave-out, is not broken over two lines."""
    return re.sub(r"--[a-z][a-z-]*", r'<span class="option">\g<0></span>', escaped(value))


def number(value: float | None, digits: int = 4) -> str:
    """Write a number with so many significant digits, up to a million without power of ten; a dash for none."""
    if value is None or not np.isfinite(value):
        return "–"
    return f"{float(f'{value + 0.0:.{digits}g}'):.{max(digits, 6)}g}"  # a zero has no sign


def aligned(value: float | None) -> str:
    """Write a number of a column with three significant digits, zeros at its end too: 1.00 below 0.896."""
    digits = number(value, 3)
    whole = "e" in digits or (len(digits) > 3 and "." not in digits)
    return digits if whole or digits in ("–", "0") else f"{value:#.3g}".removesuffix(".")


def paragraph(value: object, kind: str = "") -> str:
    """Set a paragraph of plain text."""
    return f"<p{_class(kind)}>{prose(value)}</p>"


def sentence(words: str) -> str:
    """Begin with a capital, end with a stop; a first word with digits or capitals, as of a channel, stays as it is."""
    first = words.partition(" ")[0]
    capital = words[:1].upper() if first.islower() and not set("_0123456789") & set(first) else words[:1]
    return capital + words[1:] + ("" if words.endswith((".", "!", "?")) else ".")


def bullets(sentences: Iterable[object]) -> str:
    """Set a list of plain sentences; nothing where there are none."""
    items = "".join(f"<li>{prose(s)}</li>" for s in sentences)
    return f"<ul>{items}</ul>" if items else ""


def table(
    head: Sequence[object],
    rows: Iterable[Sequence[object]],
    caption: object = "",
    *,
    words: bool = False,
    label: str = "",
) -> str:
    """Set a table in a box that scrolls: numbers to the right, or words to the left; nothing without rows.

    Cells are plain, or a `Cell`; `label` stands in grey before the caption.
    """
    kind = _class("words" if words else "wide" if len(head) > 11 else "")  # of many columns: printed smaller
    names = "".join(f'<th scope="col">{escaped(cell)}</th>' for cell in head)
    body = "".join("<tr>" + "".join(f"<td>{_cell(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    top = f"<thead><tr>{names}</tr></thead>" if any(head) else ""
    if not body:
        return ""
    return f'<figure class="scroll">{_caption(caption, label)}<table{kind}>{top}<tbody>{body}</tbody></table></figure>'


def matrix(
    values: Array,
    rows: Sequence[object],
    columns: Sequence[object],
    caption: object,
    *,
    below: Sequence[Sequence[tuple[str, ...]]] = (),
    label: str = "",
) -> str:
    """Set a matrix with named rows and columns, four significant digits; what is round-off beside the largest is 0.

    `below` holds smaller lines for each entry, or nothing.
    """
    values = np.where(np.abs(values) > ROUND_OFF * np.abs(values).max(), values, 0.0)
    lines = [
        [Cell(number(v), lower) for v, lower in zip(line, under, strict=True)]
        for line, under in zip(values, below or no_lines(values.shape), strict=True)
    ]
    parts, count = [], len(columns)
    # Ten columns stand beside each other, on paper too.
    for block in np.array_split(np.arange(count), max(1, -(-count // 10))):
        first, last = block[0], block[-1] + 1
        cells = [[name, *line[first:last]] for name, line in zip(rows, lines, strict=True)]
        which = f"; columns {first + 1} to {last} of {count}" * (block.size < count)
        parts.append(table(["", *columns[first:last]], cells, f"{caption}{which}", label=label))
    return "".join(parts)


def no_lines(shape: tuple[int, ...]) -> list[list[tuple[str, ...]]]:
    """Nothing below any entry of a matrix of this shape, for `matrix`."""
    return [[()] * shape[1] for _ in range(shape[0])]


def picture(figure: Figure, alt: object, caption: object = "", *, label: str = "", right: float = 0.15) -> str:
    """Embed a figure as PNG; shown at 92 pixels an inch, so that it is sharp on paper and on dense screens.

    Its margins are fixed, the `right` one in inches: to find them by drawing takes as long as the picture.
    """
    width, height = map(float, figure.get_size_inches())
    figure.set_layout_engine(None)
    figure.subplots_adjust(left=0.75 / width, right=1 - right / width, bottom=1.0 / height, top=1 - 0.35 / height)
    image = _image(to_png(figure, dpi=130, colours=64), f'width="{round(92 * width)}" alt="{escaped(alt)}"')
    return f'<figure class="scroll">{image}{_caption(caption, label)}</figure>'


def heat_maps(maps: Mapping[str, Array], colours: str, low: float, caption: object = "", *, label: str = "") -> str:
    """Matrices beside each other, each under its name, an entry a square whose colour tells it from `low` to 1."""
    drawn = ""
    for name, values in maps.items():
        image = _image(heat_map(values, colours, low), f'alt="{escaped(name)}, as colours"')
        drawn += f"<figure>{_caption(name, '')}{image}</figure>"
    bar = _image(heat_map(np.linspace(low, 1.0, 65)[None], colours, low), 'class="bar" alt=""')
    scale = f"<figcaption>{number(low)} {bar} 1</figcaption>"
    return f'{_caption(caption, label)}<div class="maps">{drawn}</div>{scale}'


def _image(png: bytes, attributes: str) -> str:
    return f'<img {attributes} src="data:image/png;base64,{base64.b64encode(png).decode("ascii")}">'


def page(title: object, head: str, sections: Iterable[tuple[str, str]]) -> str:
    """Join the sections, (heading, content), to a page with links to each; empty ones are left out.

    Nothing runs in it but its own script, as the page says to the browser.
    """
    style, script = (files("sysid.report").joinpath(name).read_text("utf-8") for name in ("page.css", "curves.js"))
    kept = [(name, content) for name, content in sections if content]
    links = " ".join(f'<a href="#s{i}">{escaped(name)}</a>' for i, (name, _) in enumerate(kept))
    body = "\n".join(
        f'<section><h2 id="s{i}">{escaped(name)}</h2>\n{content}\n</section>' for i, (name, content) in enumerate(kept)
    )
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta http-equiv="Content-Security-Policy" '
        f"content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'\">\n"
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escaped(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n"
        f"<h1>{escaped(title)}</h1>\n{head}\n<nav>{links}</nav>\n{body}\n<script>{script}</script>\n"
        "</body>\n</html>\n"
    )


def _cell(cell: object) -> str:
    if not isinstance(cell, Cell):
        return escaped(cell)
    return escaped(cell.value) + "".join(f"<small>{escaped(line)}</small>" for line in cell.below)


def _caption(words: object, label: str) -> str:
    mark = f'<span class="mark">{escaped(label)}</span>' if label else ""
    return f"<figcaption>{mark}{escaped(words)}</figcaption>" if words or label else ""


def _class(kind: str) -> str:
    return f' class="{kind}"' if kind else ""
