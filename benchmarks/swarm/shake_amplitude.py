r"""Equivalent-linear prediction of the unseen shake-table event: its first mode at the level its ground asks for.

The first bending mode of the three-storey frame softens, and is damped more, as it moves more. A linear model that was
fitted on one event is therefore off resonance in a stronger one. Three steps correct that mode:

1. *Law.* Once the table of the fitted event (`sine_1p5`) has stopped, floor 3 rings down in mode 1. Frequency and
   damping over short windows of that decay are regressed on the root of the modal amplitude,
   ``f(A) = f0 + c sqrt(A)`` and ``zeta(A) = z0 + cz sqrt(A)``.
2. *Level.* Under the ground record of the unseen event (`sine_2p0`) the modal coordinate ``q'' + 2 zeta w q' + w² q =
   -u_0''`` has the envelope ``A² = q² + (q' / w)²``. The means of f(A) and zeta(A) with weight A² are the equivalent
   frequency and damping; they change the envelope, so this is repeated until they stay.
3. *Prediction.* Mode 1 of the identified structure takes them. Residues and all other modes stay as fitted.

What is used, and what was seen
-------------------------------
The identified structure, the ground and floor 3 of the fitted event, and of the unseen event the ground alone. The
floors of the unseen event serve only to compute the score.

That event is nevertheless not blind to this recipe. Its records, floors included, had been looked at and scored
before, with linear models and with several amplitude-dependent ones, and the stretch bound of 0.50 was known. So the
figure shows that the fitted event holds enough to correct the first mode; it is no independent confirmation of the
method. The exponent 1/2 is a convention. The decay itself would rather have 0.2 to 0.3, and speaks against 1, which
scatters its frequencies nearly three times as much as 1/2; on the unseen event exponents from 0.3 to 0.7 score 0.53 to
0.59, and 1 scores 0.49 to 0.50, below the bound. The other constants are round values for reading a free decay. Others
were tried, to see how much hangs on them, and score 0.53 to 0.60; only a narrow band with short ends gave a law that
does not settle. `ENDS` was lengthened from one cycle, which scores 0.53 to 0.56, because of what `decay_law` notes and
not for the score, but with that score known. The level of the unseen event lies above the loudest window of the decay:
its frequency and damping are an extrapolation of the law.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import signal

import sysid
from benchmarks.problem_modules import load_module
from sysid.files import xsens_dot

FITTED, UNSEEN = "sine_1p5", "sine_2p0"
EXPONENT = 0.5
STILL = 0.1  # of the ground's peak: it moves a little with the frame after the table has stopped
PASS = (0.8, 1.2)  # of the first frequency: wide enough for its drift, far from mode 2 at three times it
ENDS = 1.0  # s left out at both ends of the decay, see `decay_law`
WINDOW, STEP = 2.0, 1.0  # s: some eight cycles a window, half overlap
TOLERANCE = 1e-9


@dataclass(frozen=True)
class Law:
    """Frequency and damping of mode 1 against its amplitude.

    Attributes
    ----------
    frequency, damping : (2,) array
        Value at rest and slope against ``A ** EXPONENT``; Hz and fraction of critical, with A in m.
    """

    frequency: np.ndarray
    damping: np.ndarray

    def at(self, amplitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Frequency (Hz) and damping ratio at modal amplitudes (m)."""
        root = amplitude**EXPONENT
        return self.frequency[0] + self.frequency[1] * root, self.damping[0] + self.damping[1] * root


def unseen_scores_with_amplitude(identification: sysid.Identification, data: Path) -> tuple[np.ndarray, str]:
    """Score the equivalent-linear prediction of the unseen event.

    Parameters
    ----------
    identification : sysid.Identification
        Fitted on `sine_1p5`; the first validation test of its problem is `sine_2p0`.
    data : Path
        The folder that holds both events.

    Returns
    -------
    scores : (n_floors,) array
        ``1 - ‖predicted - measured‖ / ‖measured‖`` of the relative X accelerations, over all lines.
    how : str
        What was done, in a phrase for the benchmark's line.
    """
    structure = identification.structure
    ground_unit, *floor_units = load_module("mini_shake_table").UNITS

    rate, (ground, top) = _records(data / FITTED, (ground_unit, floor_units[-1]))
    residue = structure.mode_shapes[-1, 0] * structure.participation[0, 0]
    law = decay_law(ground, top - ground, rate, structure.natural_frequencies[0], residue)

    rate, (ground,) = _records(data / UNSEEN, (ground_unit,))
    first = (structure.natural_frequencies[0], structure.damping_ratios[0])
    frequency, damping = equivalent_mode(law, ground, rate, first)

    unseen = identification.problem.validation[0]
    predicted = _predict(structure, unseen, frequency, damping)
    error = np.linalg.norm(predicted - unseen.relative, axis=(0, 2))
    how = (
        f"equivalent linear: f1 = {frequency:.3f} Hz, zeta1 = {100 * damping:.2f} % at the level predicted from its "
        "ground motion; law from the free decay of the fitted event"
    )
    return 1 - error / np.linalg.norm(unseen.relative, axis=(0, 2)), how


def decay_law(ground: np.ndarray, top: np.ndarray, rate: float, frequency: float, residue: float) -> Law:
    """Amplitude law of mode 1 from the free decay at the end of a record.

    Parameters
    ----------
    ground, top : (n,) array
        Acceleration of the ground, and of the top floor relative to it, m/s².
    rate : float
        Samples a second.
    frequency : float
        Hz, of mode 1 as fitted: the centre of the band-pass.
    residue : float
        Mode shape at the top times participation; takes the modal coordinate to the floor.

    Returns
    -------
    Law

    Notes
    -----
    The filter settles, and the Hilbert transform wraps round, at both ends of the decay. With less than `ENDS` left
    out, the damping of the loudest window, on which the law's slope hangs, changes with the very sample at which the
    decay is cut. On made-up decays of three modes (damping 0.006, any phase) it is then wrong by up to 0.002 with one
    cycle left out, by less than 0.0006 with a second.
    """
    stopped = np.flatnonzero(np.abs(ground) > STILL * np.abs(ground).max())[-1] + 1
    # Cut before filtering, or the filter would carry the forced motion into the decay.
    band = [factor * frequency for factor in PASS]
    sections = signal.butter(3, band, "bandpass", fs=rate, output="sos")
    analytic = signal.hilbert(signal.sosfiltfilt(sections, top[stopped:]))
    edge = round(ENDS * rate)
    phase = np.unwrap(np.angle(analytic))[edge:-edge]
    envelope = np.abs(analytic)[edge:-edge]

    rows = []
    length, step = round(WINDOW * rate), round(STEP * rate)
    time = np.arange(length) / rate
    for begin in range(0, envelope.size - length + 1, step):
        window = slice(begin, begin + length)
        omega = np.polyfit(time, phase[window], 1)[0]
        rate_of_decay = -np.polyfit(time, np.log(envelope[window]), 1)[0]
        amplitude = envelope[window].mean() / (omega**2 * abs(residue))
        rows.append((amplitude, omega / (2 * np.pi), rate_of_decay / omega))
    amplitudes, frequencies, dampings = np.array(rows).T
    root = amplitudes**EXPONENT
    return Law(*(np.polyfit(root, values, 1)[::-1] for values in (frequencies, dampings)))


def equivalent_mode(law: Law, ground: np.ndarray, rate: float, first: tuple[float, float]) -> tuple[float, float]:
    """Frequency (Hz) and damping ratio of mode 1 at the level that a ground record drives it to.

    Parameters
    ----------
    law : Law
    ground : (n,) array
        m/s².
    rate : float
        Samples a second.
    first : (frequency, damping ratio)
        Where the iteration starts.
    """
    mode = np.array(first)
    for _ in range(100):
        weight = _envelope(ground, rate, *mode) ** 2
        # Weighted by energy: a spectrum, and so the score, is made by the loud part of the record.
        following = np.array([np.average(values, weights=weight) for values in law.at(np.sqrt(weight))])
        done = np.all(np.abs(following - mode) <= TOLERANCE * mode)
        mode = following
        if done:
            return float(mode[0]), float(mode[1])
    raise RuntimeError("the equivalent frequency and damping do not settle within 100 iterations")


def _envelope(ground: np.ndarray, rate: float, frequency: float, damping: float) -> np.ndarray:
    """Envelope of the modal coordinate under a ground record from rest, (n,) m."""
    omega = 2 * np.pi * frequency
    state = np.array([[0.0, 1.0], [-(omega**2), -2 * damping * omega]])
    oscillator = signal.StateSpace(state, [[0.0], [-1.0]], np.eye(2), np.zeros((2, 1)))
    _, motion, _ = signal.lsim(oscillator, ground, np.arange(ground.size) / rate)
    return np.hypot(motion[:, 0], motion[:, 1] / omega)


def _predict(structure: sysid.Structure, test: sysid.Measurement, frequency: float, damping: float) -> np.ndarray:
    """Relative accelerations (runs, n_sensors, n_freq) with another frequency and damping of mode 1."""
    omega = 2 * np.pi * np.r_[frequency, structure.natural_frequencies[1:]][:, None]
    zeta = np.r_[damping, structure.damping_ratios[1:]][:, None]
    line = 2 * np.pi * test.freq
    gain = line**2 / (omega**2 - line**2 + 2j * zeta * omega * line)
    return np.einsum("sk,kd,kf,rdf->rsf", structure.mode_shapes, structure.participation, gain, test.base)


def _records(folder: Path, units: Sequence[str]) -> tuple[float, list[np.ndarray]]:
    """Sample rate, and X acceleration of some units on one clock, offsets removed: only these files are opened."""
    raw = [xsens_dot.read_xsens_dot(folder / f"{unit}.csv") for unit in units]
    time, samples = sysid.resample([(record.time, record.acceleration[0]) for record in raw])
    return 1 / (time[1] - time[0]), [x[0] - x[0].mean() for x in samples]
