"""Stabilisation diagram and CMIF against structures whose modes are known."""

import numpy as np
import pytest

import sysid
from sysid import InputError, Measurement, simulate
from sysid.modal_analysis.stabilisation import LEVELS, cmif, relative_frf, stabilisation


def lines(truth, count=60):
    f = truth.natural_frequencies
    return np.geomspace(0.7 * f[0], 1.3 * f[-1], count * truth.n)


def wide(rng, random_structure, n, d):
    """Modes over 1.2 decades, two of them 1 % apart where there is room."""
    f = np.sort(10 ** rng.uniform(0.5, 1.7, n))
    if n > 4:
        f[n // 2] = 1.01 * f[n // 2 - 1]
    return random_structure(rng, n, d, frequencies=np.sort(f))


def oscillator(frequency, ratio, mass=2.0):
    k = mass * (2 * np.pi * frequency) ** 2
    return sysid.Structure(np.diag([mass, 0.0]), k * np.array([[1, -1], [-1, 1]]), [ratio], n_base=1)


def twins(frequency, ratio, push=(2.0, 1.0)):
    """Two oscillators of one frequency and damping, along x and y, that the base pushes with unequal coupling."""
    mass = np.array([2.0, 5.0])
    coupling = np.diag(mass * (np.array(push) - 1))  # H = diag(push) g, as M_S0 adds to M_SS G
    base = np.diag(np.diag(coupling) ** 2 / mass + 1)
    k = np.diag(mass * (2 * np.pi * frequency) ** 2)
    M, K = np.block([[np.diag(mass), coupling], [coupling, base]]), np.block([[k, -k], [-k, k]])
    return sysid.Structure(M, K, [ratio, ratio], n_base=2)


def gain(freq, frequency, ratio):
    """Relative acceleration of one oscillator per unit base acceleration."""
    return freq**2 / (frequency**2 - freq**2 + 2j * ratio * frequency * freq)


def general_runs(truth, freq, runs, rng):
    """A test whose base moves in all directions at once, each by its own amount."""
    d = truth.n_base
    base = rng.normal(size=(runs, d, freq.size)) + 1j * rng.normal(size=(runs, d, freq.size))
    base *= 10.0 ** np.arange(d)[:, None]
    response = np.einsum("sdf,rdf->rsf", truth.transmissibility(freq), base)
    return Measurement(freq, base, response, rigid_body=truth.rigid_body)


@pytest.mark.parametrize(("n", "d"), [(3, 1), (6, 2), (9, 3), (8, 6)])
@pytest.mark.parametrize("seed", range(3))
def test_without_noise_the_stable_poles_hold_every_mode(random_structure, seed, n, d):
    rng = np.random.default_rng([seed, n])
    truth = wide(rng, random_structure, n, d)
    diagram = stabilisation(simulate(truth, lines(truth)))
    top = (diagram.order == diagram.order.max()) & (diagram.stable == 3)
    f, ratio = diagram.frequency[top], diagram.ratio[top]
    for frequency, damping in zip(truth.natural_frequencies, truth.damping_ratios, strict=True):
        nearest = np.argmin(np.abs(f / frequency - 1))
        assert f[nearest] == pytest.approx(frequency, rel=1e-4)
        assert ratio[nearest] == pytest.approx(damping, rel=1e-3)


@pytest.mark.parametrize("seed", range(6))
def test_with_noise_strong_modes_are_stable_columns_and_nothing_else_is(random_structure, seed):
    """A mode is strong where its part of the records is ten times the noise; 1 % noise."""
    rng = np.random.default_rng(seed)
    truth = wide(rng, random_structure, int(rng.integers(4, 9)), int(rng.integers(1, 4)))
    test = simulate(truth, lines(truth), noise=0.01, rng=rng)
    diagram = stabilisation(test)
    f = truth.natural_frequencies
    part = np.linalg.norm(gain(test.freq, f[:, None], truth.damping_ratios[:, None]), axis=1)
    part *= np.linalg.norm(truth.mode_shapes, axis=0) * np.linalg.norm(truth.participation, axis=1)
    strong = part >= 10 * np.sqrt(test.relative.size) * test.response_std.flat[0]
    assert strong.sum() >= 3
    orders = np.unique(diagram.order)[-8:]
    stable = (diagram.stable == 3) & np.isin(diagram.order, orders)
    held = lambda frequency: np.unique(diagram.order[stable & (np.abs(diagram.frequency / frequency - 1) < 0.005)])  # noqa: E731
    assert all(held(frequency).size >= 4 for frequency in f[strong])
    columns = [frequency for frequency in diagram.frequency[stable] if held(frequency).size >= 6]
    assert np.all(np.abs(np.array(columns)[:, None] / f - 1).min(axis=1) < 0.01)


@pytest.mark.parametrize("freq", [np.linspace(0, 20, 300), np.geomspace(0.02, 20, 300), np.linspace(4.9, 5.2, 60)])
def test_poles_map_back_from_any_band(freq):
    diagram = stabilisation(simulate(oscillator(5.0, 0.013), freq))
    stable = diagram.stable == 3
    assert np.unique(diagram.order[stable]).size >= 5
    np.testing.assert_allclose(diagram.frequency[stable][-1], 5.0, rtol=1e-5)
    np.testing.assert_allclose(diagram.ratio[stable][-1], 0.013, rtol=1e-3)


def test_what_is_shown_lies_in_the_band_and_is_stable(random_structure):
    truth = random_structure(np.random.default_rng(3), 5, 2)
    test = simulate(truth, lines(truth), noise=0.05, rng=1)
    diagram = stabilisation(test, max_order=17)
    assert np.all(np.diff(diagram.order) >= 0) and diagram.order.min() >= 2 and diagram.order.max() == 17
    assert np.all((diagram.frequency > 0.9 * test.freq[0]) & (diagram.frequency < 1.1 * test.freq[-1]))
    assert np.all((diagram.ratio > 0) & (diagram.ratio < 0.2))
    assert diagram.frequency.shape == diagram.ratio.shape == diagram.stable.shape == diagram.order.shape


def test_levels_compare_with_the_order_before(random_structure):
    truth = random_structure(np.random.default_rng(5), 5, 2)
    diagram = stabilisation(simulate(truth, lines(truth), noise=0.03, rng=2))
    orders = np.arange(2, diagram.order.max() + 1)  # d = 2: an order has a degree of its own
    for order, frequency, ratio, level in zip(
        diagram.order, diagram.frequency, diagram.ratio, diagram.stable, strict=True
    ):
        before = diagram.order == order - 1
        near = np.abs(diagram.frequency[before] - frequency) < 0.01 * frequency
        damped = near & (np.abs(diagram.ratio[before] - ratio) < 0.05 * ratio)
        assert (level >= 1) == near.any()
        assert (level >= 2) == damped.any()
        assert order in orders and 0 <= level < len(LEVELS)


def test_the_shape_must_agree_for_the_highest_level():
    """Two oscillators whose frequencies and dampings agree within the tolerances, yet move along x and along y."""
    one, other = oscillator(5.0, 0.02), oscillator(5.02, 0.0201)
    freq = np.linspace(3, 8, 400)
    H = np.zeros((2, 2, freq.size), complex)
    H[0, 0], H[1, 1] = (structure.transmissibility(freq)[0, 0] for structure in (one, other))
    diagram = stabilisation(Measurement.from_frf(freq, H, rigid_body=np.eye(2)))
    top = (diagram.order == diagram.order.max()) & (diagram.stable == 3)
    np.testing.assert_allclose(diagram.frequency[top], [5.0, 5.02], rtol=1e-4)
    np.testing.assert_allclose(diagram.ratio[top], [0.02, 0.0201], rtol=1e-2)


def test_a_repeated_pole_is_two_poles_and_two_peaks_at_once():
    truth, freq = twins(5.0, 0.01), np.linspace(3, 8, 501)
    test = simulate(truth, freq)
    values, g = cmif(test), np.abs(gain(freq, 5.0, 0.01))
    np.testing.assert_allclose(values, [2 * g, g], rtol=1e-10)
    peak = freq[np.argmax(values, axis=1)]
    assert peak[0] == peak[1] and peak[0] == pytest.approx(5.0, abs=0.01)
    diagram = stabilisation(test)
    top = (diagram.order == diagram.order.max()) & (np.abs(diagram.frequency - 5.0) < 1e-4)
    assert top.sum() == 2 and np.all(diagram.stable[top] >= 2)


@pytest.mark.parametrize(("n", "d"), [(2, 3), (5, 1), (5, 3)])
def test_the_cmif_holds_the_singular_values_of_the_frf(random_structure, n, d):
    truth = random_structure(np.random.default_rng(n), n, d)
    freq = np.linspace(1, 70, 40)
    values = cmif(simulate(truth, freq))
    assert values.shape == (min(n, d), freq.size)
    for i, line in enumerate(np.moveaxis(truth.relative_acceleration(freq), -1, 0)):
        np.testing.assert_allclose(values[:, i], np.linalg.svd(line)[1], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("runs", [2, 4])
def test_general_runs_that_span_the_directions_give_the_frf(random_structure, runs):
    truth = random_structure(np.random.default_rng(7), 4, 2)
    freq = lines(truth)
    test = general_runs(truth, freq, runs, np.random.default_rng(1))
    np.testing.assert_allclose(relative_frf(test), truth.relative_acceleration(freq), rtol=1e-6, atol=1e-9)
    diagram = stabilisation(test)
    stable = diagram.frequency[(diagram.order == diagram.order.max()) & (diagram.stable == 3)]
    assert np.abs(stable[:, None] / truth.natural_frequencies - 1).min(axis=0).max() < 1e-4


def test_runs_that_do_not_span_the_directions_are_refused(random_structure):
    truth, rng = random_structure(np.random.default_rng(7), 4, 2), np.random.default_rng(2)
    freq = lines(truth)
    one = general_runs(truth, freq, 1, rng)
    for numbers in (stabilisation, cmif):
        with pytest.raises(InputError, match="the one run does not move the base in 2 independent directions"):
            numbers(one)
    double = Measurement(
        freq, np.repeat(one.base, 2, axis=0), np.repeat(one.response, 2, axis=0), rigid_body=one.rigid_body
    )
    with pytest.raises(InputError, match="the 2 runs do not move the base"):
        cmif(double)


def test_orders_that_the_lines_do_not_carry_are_refused(random_structure):
    truth = random_structure(np.random.default_rng(7), 4, 2)
    with pytest.raises(InputError, match="40 lines of 4 sensors carry at most 19 modes"):
        stabilisation(simulate(truth, np.linspace(2, 70, 40)), max_order=20)
    assert stabilisation(simulate(truth, np.linspace(2, 70, 40)), max_order=19).order.max() == 19
    for freq in ([5.0], [0.0, 5.0, 10.0]):
        with pytest.raises(InputError, match="no stabilisation diagram"):
            stabilisation(simulate(truth, freq))
    with pytest.raises(InputError, match="order 1 give no model"):
        stabilisation(simulate(truth, np.linspace(2, 70, 40)), max_order=1)
