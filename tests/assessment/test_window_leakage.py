"""What blocks under Hann's window leak from line to line moves damping in all channels at once, and no frequency."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import sysid
from sysid.assessment.information import information, leakage_moves, spectra_of
from sysid.modal_analysis.misfit import noise_records
from sysid.modal_analysis.modal_fit import Index, Modes
from sysid.modal_analysis.response import gains

N, BLOCKS, DRAWS = 512, 40, 300
LINES = np.arange(26, 103)
FREQ = LINES / N  # of a sample rate of 1 Hz
OMEGA, ZETA = 2 * np.pi * 0.1, 0.03  # three lines in a half-power width
SHAPE = np.array([1.0, 0.6, -0.4])


def simulated_functions() -> np.ndarray:
    """H1 of steady motion under white noise, (draws, sensors, lines), by sums over all lines of the whole record."""
    rng, every = np.random.default_rng(0), np.maximum(np.fft.rfftfreq(BLOCKS * N), 1e-9)
    H = SHAPE[:, None] * gains(every, np.array([OMEGA]), np.array([ZETA]))
    window, found = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(N) / N), []
    for _ in range(DRAWS):
        x = rng.standard_normal(BLOCKS * N)
        y = np.fft.irfft(H * np.fft.rfft(x), axis=1)
        X, Y = (np.fft.rfft(window * one.reshape(-1, BLOCKS, N), axis=2)[..., LINES] for one in (x, y))
        found.append(np.mean(Y * X.conj(), axis=1) / np.mean(np.abs(X) ** 2, axis=1))
    return np.array(found)


def deviations_by_simulation() -> np.ndarray:
    """Of log w and log zeta, where all sensors weigh alike and their shapes are free, to first order."""
    H1 = simulated_functions()
    errors, w = H1 - H1.mean(axis=0), 2 * np.pi * FREQ
    D = OMEGA**2 - w**2 + 2j * ZETA * OMEGA * w
    slopes = -((w / D) ** 2) * np.array([2 * OMEGA**2 + 2j * ZETA * OMEGA * w, 2j * ZETA * OMEGA * w])
    J = np.concatenate([np.eye(3)[:, None] * (w**2 / D)[:, None], SHAPE[:, None, None] * slopes.T], axis=2)
    rows = [np.concatenate([one.real, one.imag], axis=-2) for one in (J, errors[..., None])]
    step = np.linalg.lstsq(rows[0].reshape(-1, 5), rows[1].reshape(DRAWS, -1).T, rcond=None)[0]
    return step[3:].std(axis=1)


def test_deviations_by_leakage_are_those_of_simulated_functions_whatever_the_number_of_channels() -> None:
    structure = sysid.Structure(
        np.diag([1.0, 1.0]), OMEGA**2 * np.array([[1.0, -1.0], [-1.0, 1.0]]), [ZETA], n_base=1,
        recovery=SHAPE[:, None], rigid_body=np.ones((3, 1)),
    )  # fmt: skip
    given = sysid.Measurement.from_frf(
        FREQ, structure.transmissibility(FREQ)[:, 0], rigid_body=np.ones((3, 1)), base_axes="x", response_std=0.01,
        window="hann", averages=BLOCKS,
    )  # fmt: skip
    test = replace(given, window="taken off")
    modes = Modes(structure.mode_shapes, structure.participation, np.array([OMEGA]), np.array([ZETA]))
    index, records = Index(3, 1, 1), noise_records(test, structure, 5)
    A = information(modes, index, [record.grams(spectra_of(test, modes)) for record in records])
    free = np.r_[0:3, index.log_omega.start, index.log_ratios.start]  # the participation scales the mode
    normals = np.zeros((index.size, 5))
    normals[free] = np.linalg.cholesky(np.linalg.inv(A[np.ix_(free, free)]) / 2)
    moved = np.sqrt(np.sum(leakage_moves(test, structure, modes, index, records, normals) ** 2, axis=1))[free[3:]]
    simulated = deviations_by_simulation()
    assert abs(moved[1] / simulated[1] - 1) < 0.15  # a deviation of 300 draws is off by 4 %; peaks of three lines
    assert simulated[0] < 0.1 * simulated[1] and moved[0] < 0.1 * moved[1]
    for other in (given, replace(test, averaged=True)):
        assert leakage_moves(other, structure, modes, index, records, normals).size == 0
