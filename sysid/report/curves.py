"""Curves and mode shapes that the page's script draws: their numbers, and the elements in which they appear."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Sequence
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.plot.panels import lines_of, run_names
from sysid.plot.plots import stick_model
from sysid.report.html import escaped
from sysid.report.opening import NoiseLevel
from sysid.report.still import ChannelSpectra, curve_sheet, degrees, mode_still, room_of_modes
from sysid.results.identification import Identification
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import LIKELY

_FINE, _ROUGH = 1.8e-3, 1e-2  # relative steps of sizes, and of differences, which are noise


@cache
def script() -> str:
    """The script of the page."""
    return files("sysid.report").joinpath("curves.js").read_text(encoding="utf-8")


def curves(it: Identification, test: Measurement, level: NoiseLevel) -> str:
    """Element of the responses and the base force of a test: of all, without the script; with it one, to be chosen.

    `level` is the noise of the test.
    """
    channels, runs = [*_responses(it, test, level), *_forces(it, test, level)], run_names(test)
    lines = [lines_of(test, run) for run in range(test.n_runs)]
    each = [[channel.at(run, at) for run, (at, _) in enumerate(lines)] for channel in channels]
    content = {
        "freq": [_packed(test.freq[at]) for at, _ in lines],
        "gaps": [gaps.tolist() for _, gaps in lines],
        "runs": runs,
        "channels": list(map(_channel_content, each)),
    }
    drawn = "".join(
        curve_sheet(f"{one.name}, {name}" if len(runs) > 1 else one.name, test.freq[at], one, 0, gaps)
        for of_channel in each
        for one, name, (at, gaps) in zip(of_channel, runs, lines, strict=True)
    )
    words = "Measured and identified spectra, their difference and the noise"
    return _element(
        "curves",
        content,
        words,
        f'{_legend(channels, at_most=test.response_std is None)}<div class="sheets">{drawn}</div>',
    )


def _legend(channels: Sequence[ChannelSpectra], *, at_most: bool) -> str:
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
        points, motion, _ = stick_model(it.measurement)
    except InputError:
        return ""
    content = _modes(it, points, motion)
    return _element("modes", content, "Mode shapes, with the base at rest", _mode_stills(content))


def _modes(it: Identification, points: Array, motion: Array) -> dict[str, Any]:
    base = np.zeros((1, 3))  # to which the motion of the base refers
    points = np.vstack([base, points])
    sticks = stick_model(it.measurement, base)[2]
    shapes = []
    for k in range(it.structure.n):
        shape = np.vstack([np.zeros((1, 3)), motion @ it.structure.mode_shapes[:, k]])
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


def _responses(it: Identification, test: Measurement, level: NoiseLevel) -> Iterator[ChannelSpectra]:
    unit_runs = test.has_unit_runs
    predicted = test.predict(it.structure) + np.einsum("sd,rdf->rsf", test.rigid_body, test.base)
    u = it.quick_uncertainty
    band = None if u is None else _half_widths(u.transmissibility(test.freq), test)
    given, noise = it.records.measurement, level.response
    raw = given if test is it.measurement and given.is_whole else None  # with transients, where these were taken off
    words, unit = ("transmissibility", "–") if unit_runs else ("spectrum of acceleration", "m/s², scaled as given")
    if unit_runs and not test.translational.all():
        unit = "per unit base motion"
    for s, name in enumerate(test.sensor_names):
        turn = _against_base(test, test.rigid_body[s])
        yield ChannelSpectra(
            name, words, unit, turn * test.response[:, s], turn * predicted[:, s],
            _levels(noise, s, test), _levels(band, s, test),
            None if raw is None else np.abs(raw.response[:, s]),
        )  # fmt: skip


def _forces(it: Identification, test: Measurement, level: NoiseLevel) -> Iterator[ChannelSpectra]:
    if test.force is None:
        return
    predicted, u = test.predict_force(it.structure), it.quick_uncertainty
    band = None if u is None else _half_widths(u.base_force(test.freq), test)
    for i, axis in enumerate(test.base_axes or ()):
        words, unit = ("apparent mass", "kg") if test.has_unit_runs else ("spectrum of force", "N, scaled as given")
        if not test.translational.all():
            words, unit = (
                "force or moment",
                "per unit base motion" if test.has_unit_runs else "N or N m, scaled as given",
            )
        turn = _against_base(test, np.eye(test.n_base)[i])
        yield ChannelSpectra(
            f"base force {axis}", words, unit, turn * test.force[:, i], turn * predicted[:, i],
            _levels(level.force, i, test), _levels(band, i, test),
        )  # fmt: skip


def _channel_content(runs: list[ChannelSpectra]) -> dict[str, Any]:
    """Data of a channel for the script, by its runs."""
    first = runs[0]
    found: dict[str, Any] = {"name": first.name, "words": first.words, "unit": first.unit}
    for name in ("measured", "identified"):
        found[name] = [[_sizes(np.abs(record)), _steps(2 * degrees(record))] for record in _of(runs, name)]
    found["left"] = [_sizes(np.abs(run.measured[0] - run.identified[0]), _ROUGH) for run in runs]
    for name in ("noise", "band", "recorded"):
        if getattr(first, name) is not None:
            every = _of(runs, name)
            found[name] = [_sizes(record[:1] if np.ptp(record) == 0 else record) for record in every]
    return found


def _of(runs: list[ChannelSpectra], name: str) -> list[NDArray[Any]]:
    """One of the spectra of a channel, run by run."""
    return [getattr(run, name)[0] for run in runs]


def _against_base(test: Measurement, moves: Array) -> ComplexArray:
    """Factor that turns the phases of each run to those against one base direction, (runs, n_freq).

    That which moves the channel most with it, by `moves`, (d,): a sensor's row of G.
    """
    share = np.linalg.norm(test.base, axis=-1) * (np.abs(moves) if np.any(moves) else 1.0)
    base = test.base[np.arange(test.n_runs), np.argmax(share, axis=1)]
    size = np.abs(base)
    return np.asarray(np.divide(base.conj(), size, out=np.ones_like(base), where=size > 0))


def _half_widths(std: Array, test: Measurement) -> NDArray[Any]:
    """Half of 95 % intervals of spectra, (runs, channels, n_freq); `std` per unit base motion, (channels, d, n_freq).

    Errors of different directions may add up whatever their phases: the sum is never too small.
    """
    return np.asarray(LIKELY * np.einsum("cdf,rdf->rcf", std, np.abs(test.base)))


def _levels(values: NDArray[Any] | None, channel: int, test: Measurement) -> Array | None:
    """Levels of one channel in all runs, (runs, n_freq); None where they are not known."""
    if values is None or not np.all(np.isfinite(values[:, channel])):
        return None
    return np.broadcast_to(values[:, channel], (test.n_runs, test.freq.size))


def _packed(numbers: ArrayLike) -> str:
    """Single-precision numbers in base 64: a third of what their digits take."""
    return base64.b64encode(np.asarray(numbers, "<f4").tobytes()).decode("ascii")


def _sizes(values: Array, step: float = _FINE) -> tuple[float, float, str]:
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
