"""A mode whose frequency and damping follow its amplitude, against an independent integrator and differences."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy
from scipy.integrate import solve_ivp

import sysid
from sysid.structure.amplitude import FittedLaw, LawForm, motion

RATE = 200.0
OMEGA, RATIO, SIZE = 2 * np.pi * 4.0, 0.012, 1.3


def load(n=800):
    t = np.arange(n) / RATE
    return 3.0 * np.sin(2 * np.pi * 3.7 * t) + 2.0 * np.sin(2 * np.pi * 1.1 * t + 0.4)


def numbers(fall, rise):
    return np.array([np.log(OMEGA), np.log(RATIO), np.log(SIZE), fall, rise])


def of_level(form, fall, rise, q, v):
    """Frequency and damping where the level is that of the acceleration at the frequency itself."""

    def at(level):
        return OMEGA * (1 - fall * (level / form.level) ** form.of_frequency)

    def off(level):
        return level - SIZE * at(level) * math.hypot(at(level) * q, v)

    most = 2 * SIZE * OMEGA * math.hypot(OMEGA * q, v)
    level = scipy.optimize.brentq(off, 0.0, most, xtol=1e-13) if most else 0.0
    return at(level), RATIO + rise * (level / form.level) ** form.of_damping


def by_runge_kutta(form, fall, rise, u, rate, initial, steps=32):
    """Relative accelerations under a load that is linear between samples, by steps of fourth order within each."""
    h = 1 / (rate * steps)

    def slope(load, q, v):
        w, zeta = of_level(form, fall, rise, q, v)
        return v, -2 * zeta * w * v - w**2 * q - load

    (q, v), found = initial, []
    for now, then in zip(u, [*u[1:], u[-1]], strict=True):
        found.append(slope(0.0, q, v)[1])
        for k in range(steps):
            first, middle, last = (now + (then - now) * (k + part) / steps for part in (0, 0.5, 1))
            q1, v1 = slope(first, q, v)
            q2, v2 = slope(middle, q + h / 2 * q1, v + h / 2 * v1)
            q3, v3 = slope(middle, q + h / 2 * q2, v + h / 2 * v2)
            q4, v4 = slope(last, q + h * q3, v + h * v3)
            q, v = q + h / 6 * (q1 + 2 * q2 + 2 * q3 + q4), v + h / 6 * (v1 + 2 * v2 + 2 * v3 + v4)
    return np.array(found)


@pytest.mark.parametrize(
    ("form", "fall", "rise"),
    [
        (LawForm(0.5, 1.0, 20.0), 0.03, 0.01),
        (LawForm(1.0, 0.5, 20.0), -0.02, 0.004),
        (LawForm(2.0, 2.0, 80.0), 0.05, 0.002),
        (LawForm(2.0, 1.0, 40.0), 0.3, 0.02),
    ],
)
def test_the_motion_is_that_of_an_independent_integrator(form, fall, rise):
    """Of fourth order, of strong laws too, whose level is that of a frequency which it lowers by itself."""
    rate, u, initial = RATE / 4, load()[::4], (2e-3, 0.03)  # twelve steps a period
    expected = by_runge_kutta(form, fall, rise, u.tolist(), rate, initial)
    halved, errors = np.interp(np.arange(2 * u.size - 1) / 2, np.arange(u.size), u), []
    for times, steps in ((1, u), (2, halved)):
        found = motion(form, steps, 1 / (rate * times), numbers(fall, rise), np.array(initial))[0][0, ::times]
        errors.append(np.linalg.norm(found - expected) / np.linalg.norm(expected))
    assert errors[0] < 1e-3 and errors[1] < errors[0] / 9


@pytest.mark.parametrize("form", [LawForm(0.5, -1.0, 20.0), LawForm(1.0, 2.0, 20.0)])
def test_derivatives_are_those_of_differences(form):
    u, values = np.stack([load(300), np.roll(load(300), 7)]), numbers(0.03, 0.002)
    gamma, initial = np.array([1.1, 0.4]), np.array([2e-3, 0.03])
    exact, _ = motion(form, gamma @ u, 1 / RATE, values, initial, u)
    x = np.concatenate([initial, gamma, values])

    def at(x):
        return motion(form, x[2:4] @ u, 1 / RATE, x[4:], x[:2])[0][0]

    assert np.allclose(exact[0], at(x), rtol=1e-12)
    for k in range(x.size):
        h = 1e-4 * max(abs(x[k]), 1e-3)
        far, near = (at(x + m * h * np.eye(x.size)[k]) - at(x - m * h * np.eye(x.size)[k]) for m in (2, 1))
        difference = (8 * near - far) / (12 * h)
        assert np.abs(exact[1 + k] - difference).max() < 1e-5 * np.abs(difference).max()


def test_a_mode_that_hardens_without_bound_moves_on_in_finite_numbers():
    """As a fit may try: each level raises the frequency, which raises the level."""
    u = np.stack([load(300), np.roll(load(300), 7)])
    rows = motion(LawForm(2.0, 1.0, 1.0), np.array([1.1, 0.4]) @ u, 1 / RATE, numbers(-0.5, -0.01), np.zeros(2), u)[0]
    assert np.all(np.isfinite(rows))


def law(fall=0.03, rise=0.01):
    return FittedLaw(
        4.0, 0.012, 0, LawForm(0.5, 1.0, 20.0), np.array([fall, rise]), (0.1, 20.0), 1e-8 * np.eye(4), 99.0
    )


@pytest.fixture(scope="module")
def linear():
    k = 900.0
    K = k * np.array([[2.0, -1, -1], [-1, 1, 0], [-1, 0, 1]])
    M = np.diag([2.0, 2.0, 0.0])
    first = sysid.Structure(M, K, [0.012, 0.01], n_base=1)
    factor = (4.0 / first.natural_frequencies[0]) ** 2
    return sysid.Structure(M, factor * K, [0.012, 0.01], n_base=1)


def test_without_any_change_a_law_moves_as_the_linear_mode(linear):
    u = load()[None]
    plain, followed = linear.simulate(u, RATE), linear.with_laws([law(0.0, 0.0)]).simulate(u, RATE)
    assert np.linalg.norm(followed - plain) < 2e-3 * np.linalg.norm(plain - u)
    assert np.linalg.norm(linear.with_laws([law()]).simulate(u, RATE) - plain) > 0.05 * np.linalg.norm(plain - u)


def test_at_a_level_the_mode_has_the_frequency_and_damping_of_the_law(linear):
    there = linear.with_laws([law()]).at_level(5.0)
    frequency, ratio = law().at(5.0)
    assert frequency == pytest.approx(4.0 * (1 - 0.03 * np.sqrt(0.25)), rel=1e-9)
    assert ratio == pytest.approx(0.012 + 0.01 * 0.25, rel=1e-9)
    assert there.natural_frequencies[0] == pytest.approx(frequency, rel=1e-9)
    assert there.damping_ratios[0] == pytest.approx(ratio, rel=1e-9)
    assert there.natural_frequencies[1] == pytest.approx(linear.natural_frequencies[1], rel=1e-9)
    assert np.array_equal(there.mass, linear.mass)
    assert np.allclose(there.participation, linear.participation)
    assert there.laws == ()


def test_a_law_of_a_mode_that_is_gone_is_refused(linear):
    with pytest.raises(sysid.InputError, match="no mode near 7 Hz"):
        linear.with_laws([replace(law(), frequency=7.0)])


def test_two_laws_of_one_mode_are_refused(linear):
    with pytest.raises(sysid.InputError, match="one mode"):
        linear.with_laws([law(), law(0.01)])


@pytest.mark.parametrize(("per_period", "within"), [(4.0, 2e-3), (2.7, 8e-3)])
def test_few_samples_a_period_are_enough_for_a_simulation(linear, per_period, within):
    rate, followed = 4.0 * per_period, linear.with_laws([law()])
    t = np.arange(round(12 * rate)) / rate

    def base(t):
        return 2.0 * np.sin(np.pi * t / 12) ** 2 * np.sin(2 * np.pi * 4.0 * t + 0.3)

    phi, gamma, form = linear.mode_shapes, linear.participation[:, 0], law().form
    omega, ratios = 2 * np.pi * linear.natural_frequencies, linear.damping_ratios
    size = abs(phi[0, 0])

    def slope(at, y):
        (q, v), w, zeta = y.reshape(2, 2), omega.copy(), ratios.copy()
        for _ in range(8):
            level = size * w[0] * np.hypot(w[0] * q[0], v[0]) / form.level
            w[0] = omega[0] * (1 - 0.03 * np.sqrt(level))
        zeta[0] += 0.01 * level
        return np.concatenate([v, -2 * zeta * w * v - w**2 * q - gamma * base(at)])

    moved = solve_ivp(slope, (0, t[-1]), np.zeros(4), method="DOP853", t_eval=t, rtol=1e-9, atol=1e-12)
    expected = np.array([phi @ slope(at, y)[2:] for at, y in zip(t, moved.y.T, strict=True)]).T
    found = followed.simulate(base(t)[None], rate) - base(t)
    assert np.linalg.norm(found - expected) < within * np.linalg.norm(expected)


def test_a_stored_structure_keeps_its_laws(linear):
    again = sysid.Structure.from_tree(linear.with_laws([law()]).to_tree())
    (found,) = again.laws
    assert found.at(3.0) == law().at(3.0)
    assert found.levels == law().levels
    assert np.array_equal(found.covariance, law().covariance)


def test_deviations_are_those_of_draws():
    rng = np.random.default_rng(0)
    covariance = np.diag([1e-4, 1e-3, 2e-3, 1e-3]) ** 2
    one = FittedLaw(4.0, 0.012, 0, LawForm(0.5, 1.0, 20.0), np.array([0.03, 0.01]), (0.1, 20.0), covariance, True)
    draws = rng.multivariate_normal(np.concatenate([np.log([4.0, 0.012]), one.values]), covariance, 4000)
    seen = np.exp(draws[:, 0]) * (1 - draws[:, 2] * np.sqrt(5.0 / 20.0))
    assert one.deviations_at(5.0)[0] == pytest.approx(seen.std(), rel=0.05)


@pytest.mark.parametrize(
    "wrong", [{"modes": []}, {"modes": [0]}, {"modes": [1, 1]}, {"exponents": (0.7, 1.0)}, {"exponents": "best"}]
)
def test_a_law_that_is_none_is_refused(wrong):
    with pytest.raises(sysid.InputError, match="AmplitudeLaw"):
        sysid.AmplitudeLaw(**wrong)
