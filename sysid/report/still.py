"""Curves and mode shapes as SVG, for paper and for browsers that run no script; the page's script draws alike."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.report.html import escaped
from sysid.structure.structure import Array, ComplexArray

_WIDTH, _LEFT, _RIGHT = 360, 48, 8  # pixels
_TITLE, _HEIGHTS, _BELOW = 18, (86, 46, 68), 30  # pixels above each panel, of each, and below the last
_APART, _ABOVE = 34.0, 16.0  # pixels between ticks at least: of frequencies, and of an axis upwards
_LOWEST, _HIGHEST = -270.0, 90.0  # degrees: the step of a resonance, 0 to -180, is not cut
_TITLED = ' class="title"'
_FINE = 2  # steps of a curve in a pixel
_AT_REST = "rest"
_MODE_WIDTH, _MODE_HEIGHT = 210, 260  # pixels
_ANGLE = np.deg2rad(30.0)  # about the vertical, from which a mode shape is seen


class ChannelSpectra(NamedTuple):
    """Spectra of one channel in all runs, each (runs, n_freq), in `unit`; None what is not known.

    `noise` is a standard deviation, `band` half of the 95 % interval of `identified`, `recorded` the magnitude with
    transients.
    """

    name: str
    words: str
    unit: str
    measured: ComplexArray
    identified: ComplexArray
    noise: Array | None
    band: Array | None
    recorded: Array | None = None

    def at(self, run: int, lines: NDArray[np.bool_]) -> ChannelSpectra:
        """At some lines of one run alone, (1, lines)."""
        of_run: Any = lambda part: part[[run]][:, lines] if isinstance(part, np.ndarray) else part  # noqa: E731
        return ChannelSpectra(*map(of_run, self))


class _Axis(NamedTuple):
    """An axis from `low` to `high`, seen at pixels `start` to `end`."""

    low: float
    high: float
    start: float
    end: float
    log: bool

    def __call__(self, values: ArrayLike) -> Array:
        """Pixels of values, not beyond the ends; NaN for what a logarithmic axis cannot show."""
        seen, ends = np.asarray(values, float), np.array([self.low, self.high])
        if self.log:
            seen, ends = np.log(np.where(seen > 0, seen, np.nan)), np.log(ends)
        share = np.clip((seen - ends[0]) / (ends[1] - ends[0]), 0.0, 1.0)
        return np.asarray(self.start + share * (self.end - self.start))

    def ticks(self, wide: float) -> list[float]:
        """Round numbers that stand `wide` pixels apart at least."""
        room = abs(self.end - self.start) / wide
        if self.log and self.high >= 10 * self.low:
            return _log_ticks(self.low, self.high, room)
        power = 10.0 ** np.floor(np.log10((self.high - self.low) / room))
        step = next(k * power for k in (1, 2, 5, 10) if k * power * room >= self.high - self.low)
        first, last = np.ceil(self.low / step - 1e-9), np.floor(self.high / step + 1e-9)
        return [float(f"{k * step:.6g}") for k in np.arange(first, last + 1)]


class _Panel(NamedTuple):
    """Title and curves of a panel, (n_freq,) each, and how many decades its axis shows at most; 0 for phases."""

    title: str
    curves: dict[str, Array]
    decades: int


def curve_sheet(name: str, freq: Array, channel: ChannelSpectra, run: int, gaps: ArrayLike = ()) -> str:
    """One channel in one run: magnitude, phase, and what is left of it beside its noise.

    No curve is joined at `gaps`, lines before which others were left out.
    """
    logarithmic = bool(freq[0] > 0 and freq[-1] > 8 * freq[0])
    across = _Axis(freq[0], freq[-1], _LEFT, _WIDTH - _RIGHT, logarithmic)
    panels, ups, bottom = _panels(channel, run), [], 0
    for panel, height in zip(panels, _HEIGHTS, strict=True):
        top = bottom + _TITLE
        bottom = top + height
        ups.append(_upward(panel, bottom, top))
    lines = [line for panel, up in zip(panels, ups, strict=True) for line in _lines(panel, up)]
    paths = iter(_paths(across(freq), lines, gaps))
    drawn = [
        _drawn(panel, across, up, {kind: next(paths) for kind in panel.curves})
        for panel, up in zip(panels, ups, strict=True)
    ]
    ticks = across.ticks(_APART)
    places = zip(across(ticks).tolist(), ticks, strict=True)
    numbers = (f'<text x="{x:.1f}" y="{bottom + 14}">{value:g}</text>' for x, value in places)
    drawn.append(f'<g text-anchor="middle">{"".join(numbers)}</g>')
    drawn.append(f'<text x="{_WIDTH - _RIGHT}" y="{bottom + 27}" text-anchor="end">frequency [Hz]</text>')
    image = _svg(f"{name}: measured and identified {channel.words}", _WIDTH, bottom + _BELOW, "".join(drawn))
    return f'<div class="sheet"><p>{escaped(name)}</p>{image}</div>'


def _panels(channel: ChannelSpectra, run: int) -> tuple[_Panel, ...]:
    measured, identified = channel.measured[run], channel.identified[run]
    left, beside = {"left": np.abs(measured - identified)}, "difference"
    if channel.noise is not None:
        left["noise"], beside = channel.noise[run], "difference and noise"
    if channel.band is not None:
        left["band"] = channel.band[run]
    size = {"measured": np.abs(measured), "identified": np.abs(identified)}
    return (
        _Panel(f"{channel.words} [{channel.unit}]", size, 5),
        _Panel("phase [°]", {"measured": degrees(measured), "identified": degrees(identified)}, 0),
        _Panel(f"{beside} [{channel.unit}]", left, 4),
    )


def degrees(spectrum: ComplexArray) -> Array:
    """Phase from -270 to 90 degrees."""
    return np.asarray((np.angle(spectrum, deg=True) - _HIGHEST) % 360.0 + _LOWEST)


def mode_still(
    name: str, points: Array, shape: Array, sticks: Sequence[tuple[int, int]], size: float, first: bool
) -> str:
    """One mode shape with the base, which stands still, over the structure at rest.

    Parameters
    ----------
    name : str
        Parts that stand below each other, with a comma between them.
    points, shape : ndarray, shape (p, 3)
        Where the points are about their middle, the base first; and how far they move.
    sticks : sequence of (int, int)
        Pairs of points.
    size : float
        Pixels of a unit of length.
    first : bool
        Of those of a page: the others show its structure at rest again.
    """
    rest, moved = (_seen(where, size) for where in (points, points + shape))
    joined = [_joined(where, sticks) for where in (rest, moved)]
    still, dots = ("".join(f"M{_pair(point)}h0" for point in where[1:]) for where in (rest, moved))
    at_rest = f'<g id="{_AT_REST}"><path class="rest" d="{joined[0]}"/><path class="places" d="{still}"/></g>'
    shown = at_rest if first else f'<use href="#{_AT_REST}"/>'
    lines = f'{shown}<path class="identified" d="{joined[1]}"/>'
    dots = f'<path class="dots" d="{dots}"/>'
    x, y = rest[0]
    base = f'<rect class="base" x="{x - 22:.1f}" y="{y - 3:.1f}" width="44" height="6"/>'
    base += f'<text x="{x + 26:.1f}" y="{y + 5:.1f}">base</text>'
    words = "".join(
        f'<text{_TITLED * (at == 0)} x="{_MODE_WIDTH / 2:g}" y="{13 + 14 * at}" text-anchor="middle">'
        f"{escaped(part)}</text>"
        for at, part in enumerate(name.split(", "))
    )
    return _svg(name, _MODE_WIDTH, _MODE_HEIGHT, lines + dots + base + words)


def _joined(where: Array, sticks: Sequence[tuple[int, int]]) -> str:
    """The sticks between points (p, 2), as a path."""
    return "".join(f"M{_pair(where[i])}L{_pair(where[j])}" for i, j in sticks)


def room_of_modes(points: Array, shapes: Array) -> float:
    """Pixels of a unit of length at which all mode shapes (modes, p, 3) about `points` (p, 3) fit in their pictures."""
    reach = np.abs(points) + np.abs(shapes)
    wide, high = float(np.hypot(reach[..., 0], reach[..., 1]).max()), float(reach[..., 2].max())
    return min((_MODE_WIDTH - 40) / (2 * wide or 1.0), (_MODE_HEIGHT - 60) / (1.9 * high + 0.6 * wide or 1.0))


def _seen(points: Array, size: float) -> Array:
    """Projection of points as seen slightly from above: pixels to the right and down, (p, 2)."""
    (x, y, z), c, s = points.T, np.cos(_ANGLE), np.sin(_ANGLE)
    right, down = c * x - s * y, 0.3 * (s * x + c * y) - 0.95 * z
    return np.column_stack([_MODE_WIDTH / 2 + size * right, (_MODE_HEIGHT + 30) / 2 + size * down])


def _pair(point: Array) -> str:
    return f"{point[0]:.1f} {point[1]:.1f}"


def _svg(title: str, width: int, height: int, content: str) -> str:
    return (
        f'<svg role="img" aria-label="{escaped(title)}" viewBox="0 0 {width} {height}" width="{width}" '
        f'height="{height}">{content}</svg>'
    )


def _drawn(panel: _Panel, across: _Axis, up: _Axis, paths: dict[str, str]) -> str:
    """Title, grid and curves of a panel, the curves as `paths`."""
    parts = [f'<text class="title" x="{_LEFT}" y="{up.end - 5:g}">{escaped(panel.title)}</text>']
    ticks = up.ticks(_ABOVE) if panel.decades else [-180.0, -90.0, 0.0]
    at = up(ticks).tolist()
    grid = [f"M{across.start} {y:.1f}H{across.end}" for y in at]
    grid += [f"M{x:.1f} {up.start}V{up.end}" for x in across(across.ticks(_APART)).tolist()]
    parts.append(f'<path class="grid" d="{"".join(grid)}"/>')
    numbers = (f'<text x="{_LEFT - 5}" y="{y + 4:.1f}">{value:g}</text>' for value, y in zip(ticks, at, strict=True))
    parts.append(f'<g text-anchor="end">{"".join(numbers)}</g>')
    drawn = "".join(f'<path class="{kind}" d="{path}"/>' for kind, path in paths.items())
    parts.append(f'<g transform="scale({1 / _FINE:g})">{drawn}</g>')
    if not any(paths.values()):
        right, down = (across.start + across.end) / 2, (up.start + up.end) / 2
        parts.append(f'<text x="{right:g}" y="{down:g}" text-anchor="middle">0 at all lines</text>')
    return "".join(parts)


def _upward(panel: _Panel, bottom: float, top: float, margin: float = 1.3) -> _Axis:
    """Axis of phases; or the logarithmic one of all curves but intervals, which may leave it."""
    if not panel.decades:
        return _Axis(_LOWEST, _HIGHEST, bottom, top, False)
    values = np.concatenate([np.ravel(curve) for kind, curve in panel.curves.items() if kind != "band"])
    values = values[np.isfinite(values) & (values > 0)]
    high = float(values.max(initial=0.0)) or 1.0
    low = max(float(values.min(initial=high)), high / 10.0**panel.decades)
    return _Axis(low / margin, high * margin, bottom, top, True)


def _log_ticks(low: float, high: float, room: float) -> list[float]:
    """Powers of ten, with double and fivefold, or threefold, as there is `room`; some left out where there is not."""
    decades = np.log10(high / low)
    factors = next((some for some in ((1, 2, 5), (1, 3)) if len(some) * decades <= room), (1,))
    every = int(np.ceil(decades / room))
    powers = np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    numbers = (float(f"{k}e{int(power)}") for power in powers if power % every == 0 for k in factors)
    return [value for value in numbers if low <= value <= high]


def _lines(panel: _Panel, up: _Axis) -> Iterator[tuple[Array, float, int]]:
    """Curves of a panel in pixels, (n_freq,), NaN where there is none; the jump that interrupts each; steps a column.

    In each column the lowest and the highest point are drawn.
    """
    jump = np.inf if panel.decades else abs(up.start - up.end) / 2
    for kind, values in panel.curves.items():
        seen = np.where((values < up.low) | (values > up.high), np.nan, values) if kind == "band" else values
        # Of a difference, which is noise, the least and the largest in four steps are drawn.
        yield up(seen), jump, 4 if kind == "left" else 1


def _paths(x: Array, lines: Sequence[tuple[Array, float, int]], gaps: ArrayLike, rounds: int = 3) -> list[str]:
    """Curves over the same `x` (n_freq,) as paths in steps of part of a pixel, interrupted at `gaps`.

    All are thinned at once, as a page has hundreds; in each round they lose points that they do not need, and stay
    within a step of where they were.
    """
    y, jumps, wide = (np.array(part) for part in zip(*lines, strict=True))
    seen, wide = np.isfinite(y), wide[:, None]
    first = np.column_stack([
        np.ones(len(y), bool),
        ~seen[:, :-1] | (np.abs(np.diff(y)) > jumps[:, None]) | np.isin(np.arange(1, x.size), gaps),
    ])  # fmt: skip
    piece = np.cumsum(first).reshape(y.shape)
    columns = (wide * np.rint(_FINE * x / wide))[seen].astype(int)
    at, of = _extremes(columns, np.rint(_FINE * y[seen]).astype(int), piece[seen])
    for kept_of in (_ends_of_levels, *[_bends] * rounds):
        kept = kept_of(at, of)
        at, of = at[kept], of[kept]
    line_of = np.searchsorted(piece[:, -1], of)
    return _as_paths(at, np.flatnonzero(np.diff(of, prepend=-1)), line_of, len(y))


def _extremes(
    x: NDArray[np.intp], y: NDArray[np.intp], piece: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The lowest and the highest point over each place, in their order, (points, 2), and the pieces they belong to."""
    if not x.size:
        return np.zeros((0, 2), int), piece
    starts = np.flatnonzero((np.diff(x, prepend=-1) != 0) | (np.diff(piece, prepend=-1) != 0))
    low, high = np.minimum.reduceat(y, starts), np.maximum.reduceat(y, starts)
    rising = np.abs(y[starts] - low) <= np.abs(y[starts] - high)
    at, of = np.repeat(np.column_stack([x, y])[starts], 2, axis=0), np.repeat(piece[starts], 2)
    at[::2, 1], at[1::2, 1] = np.where(rising, low, high), np.where(rising, high, low)
    other = np.concatenate([[True], np.any(np.diff(at, axis=0) != 0, axis=1) | (np.diff(of) != 0)])
    return at[other], of[other]


def _ends_of_levels(at: NDArray[np.intp], piece: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Which points of curves (points, 2) to keep: all but those between two that are as high."""
    kept, level = np.ones(len(at), bool), (np.diff(at[:, 1]) == 0) & (np.diff(piece) == 0)
    kept[1:-1] = ~(level[1:] & level[:-1])
    return kept


def _bends(at: NDArray[np.intp], piece: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Which points of curves (points, 2) to keep: all but every other one within a step of the neighbours' line.

    Peaks stay: the neighbours of a point that is left out are kept.
    """
    kept = np.ones(len(at), bool)
    before, this, after = at[:-2:2], at[1:-1:2], at[2::2]
    (wide, high), (x, y) = (after - before).T, (this - before).T
    kept[1:-1:2] = (np.abs(y * wide - high * x) > wide) | (piece[:-2:2] != piece[2::2])
    return kept


def _as_paths(at: NDArray[np.intp], starts: NDArray[np.intp], line_of: NDArray[np.intp], count: int) -> list[str]:
    """The pieces of points (points, 2), each from one of `starts` to the next, joined to the path of their line."""
    moves, ends = np.diff(at, axis=0).ravel().tolist(), [*starts[1:].tolist(), len(at)]
    paths = [""] * count
    for start, end in zip(starts.tolist(), ends, strict=True):
        steps = moves[2 * start : 2 * end - 2]
        # a sign separates numbers as a space does
        drawn = "l" + " ".join(map(str, steps)).replace(" -", "-") if steps else "h1"
        paths[line_of[start]] += f"M{at[start, 0]} {at[start, 1]}{drawn}"
    return paths
