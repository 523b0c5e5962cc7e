"""The benchmark's own equations of a superelement, against a closed form and another integrator."""

import importlib
from pathlib import Path

import numpy as np
import pytest
import scipy.integrate

ROOT = Path(__file__).resolve().parents[2]
W, ZETA, GAMMA, MASS, SHAPE = 2 * np.pi * 6.0, 0.02, 1.7, 4.0, 0.6


@pytest.fixture(scope="module")
def superelement():
    """One mode of 6 Hz on a base of one direction, one sensor that moves with it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT))
        exported = importlib.import_module("benchmarks.band.exported")
    mass = np.array([[MASS, GAMMA], [GAMMA, 1.0]])
    return exported.Superelement(mass, np.diag([0.0, 2 * ZETA * W]), np.diag([0.0, W**2]), np.array([[1.0, SHAPE]]), 1)


def test_its_base_drive_is_that_of_one_oscillator(superelement):
    freq = np.linspace(1.0, 12.0, 50)
    w = 2 * np.pi * freq
    g = w**2 / (W**2 - w**2 + 2j * ZETA * W * w)
    motion, force = superelement.driven(freq)
    np.testing.assert_allclose(motion[0, 0], 1 + SHAPE * GAMMA * g, rtol=1e-12)
    np.testing.assert_allclose(force[0, 0], MASS + GAMMA**2 * g, rtol=1e-12)


def test_its_history_in_time_is_that_of_a_runge_kutta_integrator(superelement):
    """Under a swept sine that rises from zero, in steps of a thousandth of a period."""
    base = lambda t: np.sin(2 * np.pi * (3.0 + t) * t) * t  # noqa: E731
    time = np.arange(0.0, 2.0, 1 / 6000)

    def moves(t, y):
        return [y[1], -(W**2) * y[0] - 2 * ZETA * W * y[1] - GAMMA * base(t)]

    q, v = scipy.integrate.solve_ivp(moves, (0.0, 2.0), [0.0, 0.0], "DOP853", time, rtol=1e-10, atol=1e-12).y
    acceleration = -(W**2) * q - 2 * ZETA * W * v - GAMMA * base(time)
    motion, force = superelement.integrated(base(time)[None], time[1])
    np.testing.assert_allclose(motion[0], base(time) + SHAPE * acceleration, atol=1e-5 * np.abs(acceleration).max())
    np.testing.assert_allclose(
        force[0], MASS * base(time) + GAMMA * acceleration, atol=1e-5 * MASS * np.abs(acceleration).max()
    )
