"""Stated noise in a problem in expressions: against weighted least squares by SciPy and linear regression."""

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import least_squares

import sysid

FREQ = np.linspace(2.0, 20.0, 150)
ONE_START = sysid.Continuation(starts=1)
W = 2 * np.pi * FREQ
MASSES, SPRINGS, DAMPERS = np.array([5.0, 4.0]), np.array([2e4, 1.5e4]), np.array([9.0, 6.0])
STRETCH = np.array([[1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]])


def relative_accelerations(springs):
    """Two floors by direct solves, (2, n_freq) for unit base motion."""
    M = np.diag(MASSES)
    K, C = ((STRETCH.T @ np.diag(values) @ STRETCH)[:2, :2] for values in (springs, DAMPERS))
    w = W[:, None, None]
    return np.linalg.solve(-(w**2) * M + 1j * w * C + K, w**2 * MASSES[:, None] + 0j)[..., 0].T


def complex_noise(rng, std):
    """Of which E|e|² is std²."""
    return std * (rng.normal(size=std.shape) + 1j * rng.normal(size=std.shape)) / np.sqrt(2)


def two_floors(accelerations, **stated):
    """The problem of the two springs; masses and dampers are known."""
    k = sysid.Variable("spring", 2, lower=5e3, upper=8e4)
    K, C = (STRETCH.T @ ca.diag(values) @ STRETCH for values in (k, ca.DM(DAMPERS)))
    test = sysid.Measurement(FREQ, np.ones((1, FREQ.size)), 1.0 + accelerations[None], rigid_body=[[1], [1]], **stated)
    return sysid.Problem(test, mass=np.diag([*MASSES, 0.0]), stiffness=K, damping=C[:2, :2])


def test_a_very_noisy_sensor_counts_by_its_stated_noise():
    """Floor 2 is a thousand times as noisy as floor 1, and the upper half of the lines three times as the lower."""
    std = np.outer([2e-3, 2.0], np.where(FREQ > 11.0, 3.0, 1.0))
    record = relative_accelerations(SPRINGS) + complex_noise(np.random.default_rng(1), std)
    result = sysid.identify(two_floors(record, response_std=std), strategy=ONE_START, rng=0)

    def misfit(scale, weight):
        miss = (weight * (relative_accelerations(scale * SPRINGS) - record)).ravel()
        return np.concatenate([miss.real, miss.imag])

    tight = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    by_noise, unweighted = (
        SPRINGS * least_squares(misfit, np.ones(2), args=(weight,), **tight).x for weight in (1 / std, 1.0)
    )
    np.testing.assert_allclose(result.values["spring"], by_noise, rtol=1e-7)
    assert np.abs(unweighted / by_noise - 1).max() > 1e-4  # so that the two can be told apart
    assert np.abs(by_noise / SPRINGS - 1).max() < 1e-4


MASS, SPRING, DAMPER, BASE_MASS, STD = 5.0, 2e4, 20.0, 3.0, 0.02


def oscillator(noise, *, response_std=STD):
    """One mass on an unknown spring: a = w² m / (k - w² m + i w c)."""
    k = sysid.Variable("spring", lower=5e3, upper=8e4)
    a = W**2 * MASS / (SPRING - W**2 * MASS + 1j * W * DAMPER) + noise
    test = sysid.Measurement(
        FREQ, np.ones((1, FREQ.size)), (1 + a)[None, None], rigid_body=[[1.0]], response_std=response_std
    )
    stiffness = k * ca.DM([[1.0, -1.0], [-1.0, 1.0]])
    return sysid.Problem(test, mass=np.diag([MASS, 0.0]), stiffness=stiffness, damping=ca.DM(DAMPER))


def deviation_of_the_spring(std):
    """Linear regression on da/dk = -w² m / (k - w² m + i w c)², half of E|e|² being in each real part."""
    slope = W**2 * MASS / (SPRING - W**2 * MASS + 1j * W * DAMPER) ** 2
    return std / np.sqrt(2 * np.sum(np.abs(slope) ** 2))


def test_deviations_of_an_unknown_are_those_of_linear_regression():
    record = oscillator(complex_noise(np.random.default_rng(2), np.full(FREQ.size, STD)))
    result = sysid.identify(record, strategy=ONE_START, rng=0)
    uncertain = result.uncertainty
    expected = deviation_of_the_spring(STD)
    assert uncertain.inflation == 1.0
    assert uncertain.variables["spring"] == pytest.approx(expected, rel=2e-3)  # the slope is at the estimate
    assert uncertain.stiffness[0, 0] == pytest.approx(expected, rel=2e-3)
    # w = sqrt(k / m) and zeta = c / (2 sqrt(k m)): half the relative deviation each.
    for name in ("natural_frequencies", "damping_ratios"):
        relative = getattr(uncertain, name) / getattr(result.structure, name)
        assert relative == pytest.approx(0.5 * expected / SPRING, rel=2e-3)
    assert abs(result.values["spring"] - SPRING) < 4 * expected


def test_of_a_mass_that_the_force_is_linear_in_estimate_and_deviation_are_those_of_linear_regression():
    """The mass of the base adds m_0 u to the force and nothing to the accelerations."""
    rng, force_std = np.random.default_rng(3), 0.5
    a = W**2 * MASS / (SPRING - W**2 * MASS + 1j * W * DAMPER)
    u = rng.normal(size=FREQ.size) + 1j * rng.normal(size=FREQ.size)
    noise = complex_noise(rng, np.full(FREQ.size, force_std))
    force = (MASS * (a + 1) + BASE_MASS) * u + noise
    test = sysid.Measurement(
        FREQ, u[None, None], ((1 + a) * u)[None, None], rigid_body=[[1.0]], response_std=STD,
        force=force[None, None], force_std=force_std,
    )  # fmt: skip
    base_mass = sysid.Variable("base mass", lower=0.1, upper=20.0)
    K = SPRING * np.array([[1.0, -1.0], [-1.0, 1.0]])
    problem = sysid.Problem(test, mass=ca.diag(ca.vertcat(MASS, base_mass)), stiffness=K, damping=ca.DM(DAMPER))
    result = sysid.identify(problem, strategy=ONE_START, rng=0)
    size = np.sum(np.abs(u) ** 2)
    assert result.values["base mass"] == pytest.approx(BASE_MASS + np.vdot(u, noise).real / size, rel=1e-8)
    assert result.uncertainty.inflation == 1.0
    assert result.uncertainty.variables["base mass"] == pytest.approx(force_std / np.sqrt(2 * size), rel=1e-6)


@pytest.mark.parametrize("factor", [5.0, 0.2])
def test_noise_above_what_is_stated_raises_the_deviations_and_noise_below_it_does_not(factor):
    noise = complex_noise(np.random.default_rng(4), np.full(FREQ.size, factor * STD))
    uncertain = sysid.identify(oscillator(noise), strategy=ONE_START, rng=0).uncertainty
    # What 300 real numbers say of their own deviation is good to one part in sqrt(600).
    inflation = pytest.approx(5.0, rel=4 / np.sqrt(600)) if factor > 1 else 1.0
    assert uncertain.inflation == inflation
    found = uncertain.variables["spring"] / deviation_of_the_spring(STD)
    assert found == pytest.approx(uncertain.inflation, rel=1e-2)
