"""Lines of whole records before any fit: which tell the modes, whether they do, rough weights, and poles by these.

Noise of the base makes errors largest at the peaks. Weights need no modes: the motion of a sensor over that of the
base, smoothed over some lines, is what passes the noise of the base on.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sysid.errors import InputError, refuse
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.record_fit import RecordFit
from sysid.modal_analysis.vector_fitting import find_poles
from sysid.structure.structure import Array
from sysid.structure.thresholds import ROUND_OFF

_BESIDE = 3  # lines about that of a sine that is cut within a cycle, with most of its power


def decimated_lines(test: Measurement, a_width: int = 6, ratio: float = 0.005) -> NDArray[np.bool_]:
    """Lines that tell the modes where there are many, the last too, (n_freq,).

    So many in a half-power width of a mode of this damping ratio; all of them where that would not save a third.
    """
    keep, ends = np.zeros(test.freq.size, bool), f"{test.freq[0]:g} to {test.freq[-1]:g} Hz"
    refuse((keep.size < 5, f"lines from {ends} ({keep.size}) are too few to tell any mode: add lines, or records"))
    for mask in test.own_lines:
        lines = np.flatnonzero(mask)
        step = np.gradient(test.freq[lines]) / test.freq[lines] * a_width / (2 * ratio)
        at = np.floor(np.cumsum(np.minimum(step, 1.0)))
        keep[lines[np.append(np.flatnonzero(np.diff(at, prepend=-1.0) > 0), -1)]] = True
    return keep if 3 * np.count_nonzero(keep) < 2 * keep.size else np.ones_like(keep)


def at_some_lines(test: Measurement) -> Measurement | None:
    """The test at `decimated_lines`; None where these are all."""
    keep = decimated_lines(test)
    return None if np.all(keep) else test.at(keep)


def rough_deviations(test: Measurement) -> Array:
    """Noise that each line of a response may hold where all channels have the same share of it, up to one factor.

    (runs, n_sensors, n_freq); the largest share of a direction's noise where there are several.
    """
    power = lambda record: np.abs(record) ** 2  # noqa: E731
    mean = lambda record: np.mean(power(record), axis=(0, 2))  # noqa: E731
    base, response = _smooth(power(test.base)), _smooth(power(test.response))
    base = np.sum(base, axis=1, keepdims=True)
    gain = response / np.where(base > 0, base, np.inf)
    of_response = mean(test.response)[:, None]
    return np.sqrt(of_response + gain * np.sum(mean(test.base)))


def _smooth(power: Array, width: int = 5) -> Array:
    """Means over so many neighbouring lines; fewer at the ends."""
    kernel = np.ones(width)
    count = np.convolve(np.ones(power.shape[-1]), kernel, mode="same")
    flat = power.reshape(-1, power.shape[-1])
    return np.array([np.convolve(row, kernel, mode="same") / count for row in flat]).reshape(power.shape)


def steady_sine(test: Measurement) -> str | None:
    """Lack of whole records of a steady sine, in a sentence; None where the base moves at more than one frequency."""
    found = _sines(test)
    if found is None:
        return None
    at = ", ".join(f"{f:.4g}" for f in sorted(set(found)))
    return (
        f"the base moves in a steady sine at {at} Hz, and its other lines hold next to nothing: such records tell the "
        "response at these frequencies alone, and neither modes nor damping; record from before the motion begins "
        "until it has died away, or move the base at all frequencies of interest (random motion, sweep, stepped sines)"
    )


def at_sines_alone(test: Measurement, omega: Array, ratios: Array) -> bool:
    """True where the base moves in steady sines, and no other line or mode, rad/s, away from them tells anything.

    Modes within half their width of another are none: two that cancel each other fit noise beside the sine.
    """
    found = _sines(test)
    apart = np.abs(np.log(omega / omega[:, None])) + np.diag(np.full(omega.size, np.inf))
    f = omega[np.all(apart > ratios, axis=0)] / (2 * np.pi)
    if found is None or _sines(test, share=1 - ROUND_OFF) is not None:  # at other lines the base does not move
        return found is not None
    spacing = np.max(np.diff(test.freq))
    inside = (f > test.freq[0]) & (f < test.freq[-1])
    return not np.any(inside & np.all([np.abs(f - sine) > _BESIDE * spacing for sine in found], axis=0))


def refuse_sines(fit: RecordFit, test: Measurement) -> None:
    """Refuse modes of records of a steady sine where no other line shows them."""
    sentence, modes = steady_sine(test), fit.parameters.modes
    if sentence is not None and (not fit.settled or at_sines_alone(test, modes.omega, modes.ratios)):
        raise InputError(sentence)


def _sines(test: Measurement, share: float = 0.9, few: float = 0.1) -> list[float] | None:
    """Frequency of the steady sine of each run, Hz; None where the base moves at more than one.

    The largest line and those beside it hold this `share` of the power; they must be `few`, a share of all.
    """
    found = []
    for base, lines in zip(test.base, test.own_lines, strict=True):
        freq, power = test.freq[lines], np.sum(np.abs(base[:, lines]) ** 2, axis=0)
        peak = int(np.argmax(power))
        near = power[max(peak - _BESIDE, 0) : peak + _BESIDE + 1]
        if near.sum() < share * power.sum() or near.size > few * power.size:
            return None
        found.append(float(freq[peak]))
    return found


def at_few_lines(test: Measurement, share: float = 0.5, few: float = 0.01) -> bool:
    """True where in a run so `few` of the lines, a share of all, hold this `share` of the base's power or more."""
    runs = zip(test.base, test.own_lines, strict=True)
    powers = [np.sort(np.sum(np.abs(base[:, lines]) ** 2, axis=0)) for base, lines in runs]
    return any(one[-max(int(few * one.size), 1) :].sum() >= share * one.sum() for one in powers)


def poles_of_test(test: Measurement) -> tuple[Array, Array]:
    """Poles of a test of any kind, rad/s and ratios, (m,) each: of whole records roughly, beside their transients.

    Raises
    ------
    InputError
        As `find_poles` does.
    """
    if test.is_whole:
        test = test.at(decimated_lines(test))
        test = replace(test, response_std=rough_deviations(test))
    found = find_poles(test)
    return found.omega, found.ratios
