"""A page from pieces: text, tables, pictures, one script of its own; nothing from elsewhere."""

from __future__ import annotations

import base64
import hashlib
import html
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sysid.errors import shown_plainly
from sysid.plot.canvas import heat_map, to_png
from sysid.structure.thresholds import ROUND_OFF

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sysid.structure.structure import Array


STYLE = """
:root { color-scheme: light dark; --paper: #fff; --ink: #1f2430; --soft: #5a6472; --line: #dde2e7; --fill: #f1f4f6;
  --link: #0b5c96; --good: #0a7d5a; --warn: #a35f00; --bad: #b3261e; --found: #0068a8; --left: #a34a00;
  --seen: #a0a5ac; }
@media screen and (prefers-color-scheme: dark) { :root { --paper: #14181d; --ink: #e6eaee; --soft: #a9b3be;
  --line: #39424c; --fill: #20272e; --link: #86bfee; --good: #3cc296; --warn: #e5a94b; --bad: #f47f77;
  --found: #62b6f0; --left: #f0995a; --seen: #767f89; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.2rem 1.5rem 4rem; max-width: 1180px; color: var(--ink); background: var(--paper);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", "DejaVu Sans", sans-serif; }
h1 { font-size: 1.5rem; line-height: 1.25; margin: 0 0 .2rem; overflow-wrap: anywhere; }
h2 { font-size: 1.25rem; margin: 2.4rem 0 .6rem; padding-bottom: .25rem; border-bottom: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 1.4rem 0 .4rem; }
p, figcaption { margin: .5rem 0; max-width: 92ch; overflow-wrap: anywhere; text-wrap: pretty; }
ul { margin: .3rem 0; padding-left: 1.3rem; max-width: 92ch; overflow-wrap: anywhere; text-wrap: pretty; }
.pair { display: flex; flex-wrap: wrap; gap: 0 1.5rem; align-items: flex-start; }
.pair figure { flex: 1 1 500px; min-width: 0; }
.mark { border: 1px solid var(--line); border-radius: 3px; padding: 0 .4em; margin-right: .5em; color: var(--soft);
  background: var(--fill); font-size: .8rem; white-space: nowrap; }
td small { display: block; color: var(--soft); font-size: .82em; line-height: 1.25; }
.soft, figcaption { color: var(--soft); font-size: .9rem; }
.verdict { border: 1px solid var(--line); border-left: 6px solid var(--soft); border-radius: 4px; padding: .5rem 1rem;
  margin: .6rem 0; }
.verdict strong { font-size: 1.1rem; }
.verdict p { margin: .25rem 0; }
.good { border-left-color: var(--good); } .warn { border-left-color: var(--warn); }
.bad { border-left-color: var(--bad); }
.good strong { color: var(--good); } .warn strong { color: var(--warn); } .bad strong { color: var(--bad); }
.scroll { overflow-x: auto; margin: .6rem 0 1rem; }
@media screen { .scroll:has(table) { background:
    linear-gradient(to left, var(--paper) 50%, transparent) right / 3rem 100% no-repeat local,
    linear-gradient(to left, rgb(128 138 150 / .45), transparent) right / 1rem 100% no-repeat; }
  .scroll:has(table) figcaption, td:first-child, thead th:first-child { background: var(--paper); }
  .scroll:has(table) figcaption { margin: 0; padding: .5rem 0; }
  td:first-child, thead th:first-child { position: sticky; left: 0; } }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .88rem; }
th, td { padding: .2rem .55rem; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--line); }
thead th { border-bottom: 1.5px solid var(--soft); vertical-align: bottom; font-weight: 600;
  white-space: normal; }
.words td, .words th { text-align: left; white-space: normal; vertical-align: top; }
th:first-child, td:first-child { text-align: left; } td:first-child { font-weight: 500; }
@media screen { td:first-child { white-space: normal; } }
.words td:first-child { white-space: nowrap; }
figure { margin: .8rem 0 1.2rem; break-inside: avoid; }
img { max-width: 100%; height: auto; display: block; background: #fff; }
.maps { display: flex; flex-wrap: wrap; gap: 0 1.5rem; } .maps figure { flex: 0 1 300px; margin: 0; }
.maps img { width: 300px; border: 1px solid var(--line); } .maps img, .bar { image-rendering: pixelated; }
.bar { display: inline-block; width: 160px; height: .8em; vertical-align: middle; }
pre { background: var(--fill); padding: .8rem 1rem; font-size: .82rem; line-height: 1.45; white-space: pre-wrap;
  overflow-wrap: anywhere; }
nav { margin: .8rem 0; font-size: .9rem; }
nav a { color: var(--link); margin-right: 1rem; display: inline-block; }
.controls { display: flex; flex-wrap: wrap; gap: .4rem .9rem; align-items: center; font-size: .9rem; margin: .6rem 0; }
.controls select, .controls button { font: inherit; color: var(--ink); background: var(--fill);
  border: 1px solid var(--soft); border-radius: 4px; padding: .15rem .5rem; max-width: 100%; }
.controls label { max-width: 100%; }
.option { white-space: nowrap; }
.area { touch-action: pan-y; user-select: none; margin-top: .4rem; }
.shapes { display: flex; flex-wrap: wrap; gap: .5rem; } .shapes svg { flex: 0 0 auto; }
.told { min-height: 3em; font-variant-numeric: tabular-nums; font-size: .9rem; }
svg { display: block; max-width: 100%; height: auto; } svg text { fill: var(--soft); font-size: 11px; }
svg .title { fill: var(--ink); font-size: 12px; }
svg path, svg line { fill: none; stroke-width: 1.6; vector-effect: non-scaling-stroke; }
svg .grid { stroke: var(--line); stroke-width: 1; } svg .cursor { stroke: var(--soft); stroke-width: 1; }
svg .zoom { fill: var(--soft); opacity: .2; }
svg .measured { stroke: var(--seen); stroke-width: 3; } svg .identified { stroke: var(--found); }
svg .rest { stroke: var(--soft); opacity: .6; stroke-width: 1; } svg .recorded { stroke: var(--good); }
svg .left { stroke: var(--left); }
svg .noise { stroke: var(--soft); stroke-dasharray: 5 3; } svg .band { stroke: var(--found); stroke-dasharray: 2 3; }
svg .dot { fill: var(--found); } svg .place { fill: var(--seen); } svg .base { fill: var(--soft); }
svg .dots, svg .places { stroke: var(--found); stroke-width: 6; stroke-linecap: round; }
svg .places { stroke: var(--seen); }
.legend { display: flex; flex-wrap: wrap; gap: .3rem .9rem; margin: .6rem 0 0; max-width: none; }
.key { border-top: 3px solid var(--soft); font-size: .85rem; } .key.measured { border-color: var(--seen); }
.key.identified { border-color: var(--found); } .key.left { border-color: var(--left); }
.key.recorded { border-color: var(--good); }
.key.noise { border-top-style: dashed; } .key.band { border-top: 3px dotted var(--found); }
[hidden] { display: none !important; }
.sheets { display: flex; flex-wrap: wrap; gap: 0 1rem; } .sheet { flex: 1 1 330px; max-width: 540px; min-width: 0; }
.sheet p { margin: .6rem 0 0; font-size: .85rem; } .sheet svg { width: 100%; }
@media screen { .drawn .sheets { display: none; } }
@media (max-width: 600px) { body { padding: .8rem .8rem 3rem; font-size: 14px; } th, td { padding: .2rem .4rem; }
  td:first-child { max-width: 9em; } table:has(th:first-child:empty) td:first-child { min-width: 6em; }
  .words td:first-child { white-space: normal; min-width: 8em; max-width: 8em; }
  h1 { font-size: 1.25rem; } .shapes svg { width: calc(50% - .25rem); }
  .shapes svg text { font-size: 13px; } .shapes svg .title { font-size: 14px; } }
@media print { body { max-width: none; padding: 0; font-size: 10pt; }
  nav, .controls, .area, .told { display: none; } .modes, .curves { break-inside: auto; }
  .sheet, .shapes svg { break-inside: avoid; } .shapes, .sheets { display: block; }
  .sheet { display: inline-block; width: 49%; } .sheet p { margin-top: .2rem; }
  .shapes svg { display: inline-block; width: 24%; }
  .shapes, .sheets { orphans: 1; widows: 1; }
  .scroll { overflow: visible; } img { max-width: 100%; max-height: 3.7in; width: auto; }
  .maps { display: block; break-after: avoid; } .maps img { width: 100%; }
  .maps figure { display: inline-block; width: 32%; margin-right: 1%; }
  .pair { flex-wrap: nowrap; break-inside: avoid; } .pair figure { flex-basis: 0; }
  table { font-size: 7.5pt; } .words { font-size: 9pt; } .wide { font-size: 5.5pt; }
  th, td { padding: .05rem .3rem; line-height: 1.3; } td small { line-height: 1.1; } tr { break-inside: avoid; }
  h2, h3, figcaption, .soft, .legend, .sheet p { break-after: avoid; } p, li { break-inside: avoid; }
  h2 + *, h3 + *, .soft + *, .legend + * { break-before: avoid; }
  .soft, figcaption { font-size: 9pt; } }
"""


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
    """Begin with a capital, end with a stop."""
    return words[:1].upper() + words[1:] + ("" if words.endswith((".", "!", "?")) else ".")


def bullets(sentences: Iterable[object]) -> str:
    """Set a list of plain sentences; nothing where there are none."""
    items = "".join(f"<li>{prose(s)}</li>" for s in sentences)
    return f"<ul>{items}</ul>" if items else ""


def beside(*parts: str) -> str:
    """Set figures beside each other where there is room."""
    return f'<div class="pair">{"".join(parts)}</div>'


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


def page(title: object, head: str, sections: Iterable[tuple[str, str]], script: str = "") -> str:
    """Join the sections, (heading, content), to a page with links to each; empty ones are left out.

    Nothing runs in it but `script`, as the page says to the browser.
    """
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
        f"<title>{escaped(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
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
