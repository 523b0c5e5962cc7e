"""Curves and mode shapes of a page: numbers for its script, and SVG for paper and browsers without it, drawn alike."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.plot.panels import lines_of, run_names
from sysid.plot.plots import stick_model
from sysid.report.html import escaped
from sysid.report.opening import NoiseLevel
from sysid.results.identification import Identification
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import LIKELY

# Words and unit, where runs are of unit base motion or not, and all base directions are translations or not.
_ACCELERATIONS = {
    (True, True): ("transmissibility", "–"), (True, False): ("transmissibility", "per unit base motion"),
    (False, True): ("spectrum of acceleration", "m/s², scaled as given"),
    (False, False): ("spectrum of acceleration", "m/s², scaled as given"),
}  # fmt: skip
_FORCES = {
    (True, True): ("apparent mass", "kg"), (True, False): ("force or moment", "per unit base motion"),
    (False, True): ("spectrum of force", "N, scaled as given"),
    (False, False): ("force or moment", "N or N m, scaled as given"),
}  # fmt: skip
_WIDTH, _LEFT, _RIGHT = 360, 48, 8  # pixels
_TITLE, _HEIGHTS, _BELOW = 18, (86, 46, 68), 30  # pixels above each panel, of each, and below the last
_APART, _ABOVE = 34.0, 16.0  # pixels between ticks at least: of frequencies, and of an axis upwards
_LOWEST, _HIGHEST = -270.0, 90.0  # degrees: the step of a resonance, 0 to -180, is not cut
_FINE = 2  # steps of a curve in a pixel
_MODE_WIDTH, _MODE_HEIGHT = 210, 260  # pixels
_ANGLE = np.deg2rad(30.0)  # about the vertical, from which a mode shape is seen


def curves(it: Identification, test: Measurement, level: NoiseLevel) -> str:
    """Element of the responses and the base force of a test: of all, without the script; with it one, to be chosen.

    `level` is the noise of the test.
    """
    channels, runs = list(_channels(it, test, level)), run_names(test)
    lines = [lines_of(test, run) for run in range(test.n_runs)]
    each = [[channel.at(run, at) for run, (at, _) in enumerate(lines)] for channel in channels]
    content = {
        "freq": [_packed(test.freq[at]) for at, _ in lines],
        "gaps": [gaps.tolist() for _, gaps in lines],
        "runs": runs,
        "channels": list(map(_channel_content, each)),
    }
    drawn = "".join(
        curve_sheet(f"{one.name}, {name}" if len(runs) > 1 else one.name, test.freq[at], one, gaps)
        for of_channel in each
        for one, name, (at, gaps) in zip(of_channel, runs, lines, strict=True)
    )
    words = "Measured and identified spectra, their difference and the noise"
    still = f'{_legend(channels, level.at_most)}<div class="sheets">{drawn}</div>'
    return _element("curves", content, words, still)


def _legend(channels: Sequence[ChannelSpectra], at_most: bool) -> str:
    """Legend of the lines that are drawn."""
    keys = {"measured": "measured", "identified": "identified", "left": "their difference"}
    if any(channel.noise is not None for channel in channels):
        keys["noise"] = f"noise{' at most, by the quietest lines' * at_most} (standard deviation)"
    if any(channel.band is not None for channel in channels):
        keys["band"] = "half of the 95 % interval of the identified"
    marks = "".join(f'<span class="key {kind}">{words}</span>' for kind, words in keys.items())
    if any(channel.recorded is not None for channel in channels):
        marks += '<span class="key recorded" hidden>as recorded</span>'  # until it is asked for
    return f'<p class="legend">{marks}</p>'


def mode_shape_view(it: Identification) -> str:
    """Element of the mode shapes in space; nothing where the sensors have no positions."""
    try:
        model = stick_model(it.measurement)
    except InputError:
        return ""
    content = _modes(it, *model)
    return _element("modes", content, "Mode shapes, with the base at rest", _mode_stills(content))


def _modes(it: Identification, points: Array, motion: Array, sticks: Sequence[tuple[int, int]]) -> dict[str, Any]:
    shapes = []
    for k in range(it.structure.n):
        shape = motion @ it.structure.mode_shapes[:, k]
        # The largest motion is a share of the structure's size.
        shape *= 0.18 * np.ptp(points, axis=0).max() / np.abs(shape).max()
        shapes.append(shape.round(6).tolist())
    names = [
        f"mode {k}: {f:.4g} Hz" + f", damping {100 * ratio:.3g} %" * bool(np.isfinite(ratio))
        for k, (f, ratio) in enumerate(zip(it.structure.natural_frequencies, it.identified_ratios, strict=True), 1)
    ]
    return {"points": points.round(6).tolist(), "sticks": sticks, "shapes": shapes, "names": names}


def _mode_stills(content: dict[str, Any]) -> str:
    points, shapes = np.array(content["points"]), np.array(content["shapes"])
    points = points - (points.min(axis=0) + points.max(axis=0)) / 2
    size = room_of_modes(points, shapes)
    drawn = (
        mode_still(name, points, shape, content["sticks"], size, first=k == 0)
        for k, (name, shape) in enumerate(zip(content["names"], shapes, strict=True))
    )
    return f'<div class="shapes">{"".join(drawn)}</div>'


def _channels(it: Identification, test: Measurement, level: NoiseLevel) -> Iterator[ChannelSpectra]:
    """Spectra of the sensors and the base force of a test."""
    kind = test.has_unit_runs, bool(test.translational.all())
    u, given = it.quick_uncertainty, it.records.measurement
    raw = given.response if test is it.measurement and given.is_whole else None  # with transients, were they taken off
    moved = test.predict(it.structure) + np.einsum("sd,rdf->rsf", test.rigid_body, test.base)
    std = None if u is None else u.transmissibility(test.freq)
    measured = test.sensor_names, _ACCELERATIONS[kind], test.rigid_body, test.response
    yield from _spectra(test, *measured, moved, level.response, std, raw)
    if test.force is not None:
        std = None if u is None else u.base_force(test.freq)
        names = tuple(f"base force {axis}" for axis in test.base_axes or ())
        measured = names, _FORCES[kind], np.eye(test.n_base), test.force
        yield from _spectra(test, *measured, test.predict_force(it.structure), level.force, std)


def _spectra(
    test: Measurement, names: Sequence[str], words: tuple[str, str], moves: Array, measured: ComplexArray,
    identified: ComplexArray, noise: Array | None, std: Array | None, recorded: ComplexArray | None = None,
) -> Iterator[ChannelSpectra]:  # fmt: skip
    """Spectra of records (runs, channels, n_freq) whose channels move by `moves` (channels, d) with the base."""
    # Errors of different directions may add up whatever their phases: the sum is never too small.
    band = None if std is None else np.asarray(LIKELY * np.einsum("cdf,rdf->rcf", std, np.abs(test.base)))
    for i, name in enumerate(names):
        turn = _against_base(test, moves[i])
        yield ChannelSpectra(
            name, *words, turn * measured[:, i], turn * identified[:, i], _levels(noise, i, test),
            _levels(band, i, test), None if recorded is None else np.abs(recorded[:, i]),
        )  # fmt: skip


def _channel_content(runs: list[ChannelSpectra]) -> dict[str, Any]:
    """Data of a channel for the script, by its runs."""
    first, of = runs[0], lambda name: [getattr(run, name) for run in runs]
    found: dict[str, Any] = {"name": first.name, "words": first.words, "unit": first.unit}
    for name in ("measured", "identified"):
        found[name] = [[_sizes(np.abs(record)), _steps(2 * degrees(record))] for record in of(name)]
    # Differences are noise: a coarse step will do.
    found["left"] = [_sizes(np.abs(run.measured - run.identified), 1e-2) for run in runs]
    for name in ("noise", "band", "recorded"):
        if getattr(first, name) is not None:
            found[name] = [_sizes(record[:1] if np.ptp(record) == 0 else record) for record in of(name)]
    return found


def _against_base(test: Measurement, moves: Array) -> ComplexArray:
    """Factor that turns the phases of each run to those against one base direction, (runs, n_freq).

    That which moves the channel most with it, by `moves`, (d,): a sensor's row of G.
    """
    share = np.linalg.norm(test.base, axis=-1) * (np.abs(moves) if np.any(moves) else 1.0)
    base = test.base[np.arange(test.n_runs), np.argmax(share, axis=1)]
    size = np.abs(base)
    return np.asarray(np.divide(base.conj(), size, out=np.ones_like(base), where=size > 0))


def _levels(values: NDArray[Any] | None, channel: int, test: Measurement) -> Array | None:
    """Levels of one channel in all runs, (runs, n_freq); None where they are not known."""
    if values is None or not np.all(np.isfinite(values[:, channel])):
        return None
    return np.broadcast_to(values[:, channel], (test.n_runs, test.freq.size))


def _packed(numbers: ArrayLike) -> str:
    """Single-precision numbers in base 64: a third of what their digits take."""
    return base64.b64encode(np.asarray(numbers, "<f4").tobytes()).decode("ascii")


def _sizes(values: Array, step: float = 1.8e-3) -> tuple[float, float, str]:
    """Sizes within half a `step` of their logarithm: the least of them, the step and whole steps above it from 1 on.

    0 is zero, and what is 10⁻³⁰ of the largest or less.
    """
    kept = values > 1e-30 * values.max(initial=0.0)
    least = float(values.min(where=kept, initial=np.inf)) if np.any(kept) else 1.0
    above = np.log(np.divide(values, least, out=np.ones_like(values), where=kept)) / step
    return float(f"{least:.7g}"), step, _steps(np.where(kept, 1 + above, 0.0))


def _steps(values: Array) -> str:
    """Whole numbers in base 64, each as its difference from the one before.

    A difference d is 2 d, or -2 d - 1 below zero, in groups of seven bits, the lowest first; the eighth bit of a byte
    says that another group follows (LEB128).
    """
    moves = np.diff(np.rint(values).astype(np.int64), prepend=0)
    whole = np.where(moves < 0, -2 * moves - 1, 2 * moves)
    groups = whole[:, None] >> (7 * np.arange(5))  # 32 bits and more
    follows = groups[:, 1:] > 0
    bytes_ = (groups & 127).astype(np.uint8)
    bytes_[:, :-1] |= np.where(follows, 128, 0).astype(np.uint8)
    used = np.column_stack([np.ones(len(groups), bool), follows])
    return base64.b64encode(bytes_[used].tobytes()).decode("ascii")


def _element(kind: str, content: dict[str, Any], words: str, still: str) -> str:
    data = json.dumps(content, ensure_ascii=False, separators=(",", ":")).replace("<", "\\u003c")
    return (
        f'<figure class="{kind}" aria-label="{escaped(words)}">{still}<script type="application/json">{data}</script>'
        "</figure>"
    )


class ChannelSpectra(NamedTuple):
    """Spectra of one channel in `unit`, each (runs, n_freq), or (n_freq,) of one run; None what is not known.

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
        """At some lines of one run alone, (lines,)."""
        of_run: Any = lambda part: part[run][lines] if isinstance(part, np.ndarray) else part  # noqa: E731
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


def curve_sheet(name: str, freq: Array, channel: ChannelSpectra, gaps: ArrayLike = ()) -> str:
    """One channel in one run: magnitude, phase, and what is left of it beside its noise.

    No curve is joined at `gaps`, lines before which others were left out.
    """
    logarithmic = bool(freq[0] > 0 and freq[-1] > 8 * freq[0])
    across = _Axis(freq[0], freq[-1], _LEFT, _WIDTH - _RIGHT, logarithmic)
    panels, ups, bottom = _panels(channel), [], 0
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


def _panels(channel: ChannelSpectra) -> tuple[_Panel, ...]:
    measured, identified = channel.measured, channel.identified
    left, beside = {"left": np.abs(measured - identified)}, "difference"
    if channel.noise is not None:
        left["noise"], beside = channel.noise, "difference and noise"
    if channel.band is not None:
        left["band"] = channel.band
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

    Parts of the `name` stand below each other, with a comma between them. `points` (p, 3) are about their middle, the
    base first, and move by `shape`; `size` is pixels of a unit of length. The `first` of a page shows the structure at
    rest, the others show it again.
    """
    rest, moved = (_seen(where, size) for where in (points, points + shape))
    places = [[f"{x:.1f} {y:.1f}" for x, y in where] for where in (rest, moved)]
    joined = ["".join(f"M{at[i]}L{at[j]}" for i, j in sticks) for at in places]
    still, dots = ("".join(f"M{one}h0" for one in at[1:]) for at in places)
    at_rest = f'<g id="rest"><path class="rest" d="{joined[0]}"/><path class="places" d="{still}"/></g>'
    lines = at_rest if first else '<use href="#rest"/>'
    lines += f'<path class="identified" d="{joined[1]}"/><path class="dots" d="{dots}"/>'
    x, y = rest[0]
    base = f'<rect class="base" x="{x - 22:.1f}" y="{y - 3:.1f}" width="44" height="6"/>'
    base += f'<text x="{x + 26:.1f}" y="{y + 5:.1f}">base</text>'
    words = "".join(
        f'<text{kind} x="{_MODE_WIDTH / 2:g}" y="{13 + 14 * at}" text-anchor="middle">{escaped(part)}</text>'
        for at, (part, kind) in enumerate(zip(name.split(", "), (' class="title"', "", ""), strict=False))
    )
    return _svg(name, _MODE_WIDTH, _MODE_HEIGHT, lines + base + words)


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
