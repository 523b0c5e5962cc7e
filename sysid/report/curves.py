"""Curves and mode shapes that the page's script draws: their numbers, and the elements in which they appear."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.plot.panels import run_names
from sysid.plot.plots import stick_model
from sysid.report.html import text
from sysid.results.identification import Identification
from sysid.results.summary import DEVIATES
from sysid.structure.structure import Array, ComplexArray

_SHOWN = 0.18  # of the structure's size: the largest motion of a mode shape


@cache
def script() -> str:
    """The script of the page."""
    return files("sysid.report").joinpath("curves.js").read_text(encoding="utf-8")


def curves(it: Identification, test: Measurement) -> str:
    """Element of the responses and the base force of a test, one channel and run at a time, both to be chosen."""
    channels = [*_responses(it, test), *_forces(it, test)]
    content = {"freq": _packed(test.freq), "runs": run_names(test), "channels": channels}
    words = "Measured and identified spectra, their difference and the noise"
    return _element("curves", content, words)


def mode_shapes(it: Identification) -> str:
    """Element of the mode shapes in space; nothing where the sensors have no positions."""
    try:
        points, motion, _ = stick_model(it.measurement)
    except InputError:
        return ""
    return _element("modes", _modes(it, points, motion), "Mode shapes, with the base at rest")


def _modes(it: Identification, points: Array, motion: Array) -> dict[str, Any]:
    base = np.zeros((1, 3))  # to which the motion of the base refers
    points = np.vstack([base, points])
    sticks = stick_model(it.measurement, base)[2]
    shapes = []
    for k in range(it.structure.n):
        shape = np.vstack([np.zeros((1, 3)), motion @ it.structure.mode_shapes[:, k]])
        shape *= _SHOWN * np.ptp(points, axis=0).max() / np.abs(shape).max()
        shapes.append(shape.round(6).tolist())
    names = [
        f"mode {k}: {f:.4g} Hz, damping {100 * ratio:.3g} %"
        for k, (f, ratio) in enumerate(
            zip(it.structure.natural_frequencies, it.structure.damping_ratios, strict=True), 1
        )
    ]
    return {"points": points.round(6).tolist(), "sticks": sticks, "shapes": shapes, "names": names}


def _responses(it: Identification, test: Measurement) -> Iterator[dict[str, Any]]:
    own = test.has_unit_runs
    predicted = test.predict(it.structure) + np.einsum("sd,rdf->rsf", test.rigid_body, test.base)
    u = it.quick_uncertainty
    band = None if u is None else _half_widths(u.transmissibility(test.freq), test)
    raw, words = _recorded(it, test), "transmissibility" if own else "acceleration spectrum, m/s² (own scale)"
    for s, name in enumerate(test.sensor_names):
        turn = _against_base(test, test.rigid_body[s])
        channel = _channel(
            name, words, turn * test.response[:, s], turn * predicted[:, s], _of(test.response_std, s), _of(band, s)
        )
        if raw is not None:
            channel["recorded"] = [_packed(np.abs(run)) for run in raw.response[:, s]]
        yield channel


def _forces(it: Identification, test: Measurement) -> Iterator[dict[str, Any]]:
    if test.force is None:
        return
    predicted, u = test.predict_force(it.structure), it.quick_uncertainty
    band = None if u is None else _half_widths(u.base_force(test.freq), test)
    for i, axis in enumerate(test.base_axes or ()):
        words = "apparent mass, kg" if test.has_unit_runs else "force spectrum, N (own scale)"
        if not test.translational.all():
            words = "force or moment of the base"
        yield _channel(
            f"base force {axis}", words, test.force[:, i], predicted[:, i], _of(test.force_std, i), _of(band, i)
        )


def _channel(
    name: str, words: str, measured: ComplexArray, predicted: ComplexArray, std: NDArray[Any] | None,
    band: NDArray[Any] | None,
) -> dict[str, Any]:  # fmt: skip
    """One channel of all runs, (runs, n_freq); its noise and half of the 95 % interval where they are known."""
    found = {"name": name, "words": words, "measured": _complex(measured), "identified": _complex(predicted)}
    for kind, values in (("noise", std), ("band", band)):
        if values is not None and np.all(np.isfinite(values)):
            found[kind] = [_packed(np.broadcast_to(run, measured.shape[-1:])) for run in values]
    return found


def _against_base(test: Measurement, moves: Array) -> ComplexArray:
    """What turns the phases of each run to those against one base direction, (runs, n_freq).

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
    return np.asarray(DEVIATES * np.einsum("cdf,rdf->rcf", std, np.abs(test.base)))


def _recorded(it: Identification, test: Measurement) -> Measurement | None:
    """The records with their transients, where these were taken off."""
    given = it.problem.measurement
    return given if test is it.measurement and given.whole is not None else None


def _of(std: NDArray[Any] | None, channel: int) -> NDArray[Any] | None:
    """Deviations of one channel, those of all runs."""
    return None if std is None else std[:, channel]


def _complex(spectra: ComplexArray) -> list[list[str]]:
    return [[_packed(run.real), _packed(run.imag)] for run in spectra]


def _packed(numbers: ArrayLike) -> str:
    """Single-precision numbers in base 64: a third of what their digits take."""
    return base64.b64encode(np.asarray(numbers, "<f4").tobytes()).decode("ascii")


def _element(kind: str, content: dict[str, Any], words: str) -> str:
    data = json.dumps(content, ensure_ascii=False, separators=(",", ":")).replace("<", "\\u003c")
    missing = f"{words}: this page's script draws them, which this browser does not run; sysid.plot draws them too."
    return (
        f'<figure class="{kind}" aria-label="{text(words)}"><noscript>{text(missing)}</noscript>'
        f'<script type="application/json">{data}</script></figure>'
    )
