"""Gains as series in the damping ratio, and records whose lines are summed beforehand."""

import numpy as np
import pytest

from sysid.modal_analysis.gain_series import GainSeries, SummedRecord, terms_needed

FREQ = np.concatenate([[0.0], np.geomspace(0.5, 30.0, 80)])
OMEGA = 2 * np.pi * np.array([1.0, 3.0, 3.1, 12.0])
LOW, HIGH = np.array([0.005, 0.004, 0.01, 0.005]), np.array([0.05, 0.04, 0.05, 0.01])


def gains(ratios, shift=0.0):
    """w² / (w_k² - w² + 2 i zeta_k w_k w), written with s = i w + shift."""
    s = shift + 2j * np.pi * FREQ
    return -(s**2) / (OMEGA[:, None] ** 2 + 2 * (ratios * OMEGA)[:, None] * s + s**2)


@pytest.mark.parametrize("shift", [0.0, 0.3])
@pytest.mark.parametrize("tolerance", [1e-6, 1e-9, 1e-12])
def test_the_series_is_as_exact_as_asked_over_the_whole_range(tolerance, shift):
    series = GainSeries(FREQ, OMEGA, LOW, HIGH, shift, tolerance)
    ratios = np.exp(np.log(LOW) + np.linspace(0, 1, 41)[:, None] * np.log(HIGH / LOW))
    made = np.einsum("jnp,njf->pnf", series.polynomials(ratios.T), series.basis)
    expected = np.array([gains(at, shift) for at in ratios])
    assert np.abs(made - expected).max() <= tolerance * np.abs(expected).max()


def test_polynomials_are_chebyshevs():
    series = GainSeries(FREQ, OMEGA, LOW, HIGH)
    u = np.linspace(-1, 1, 7)
    ratios = np.sqrt(LOW * HIGH)[:, None] * np.sqrt(HIGH / LOW)[:, None] ** u
    expected = np.cos(np.arange(series.terms)[:, None] * np.arccos(u))
    np.testing.assert_allclose(series.polynomials(ratios), np.repeat(expected[:, None], 4, axis=1), atol=1e-12)


def test_more_terms_for_a_wider_range_and_for_more_digits():
    # ln(1e8) = 18.42 over asinh(pi / ln 10) = 1.126 is 16.4, over asinh(pi / ln 100) = 0.638 it is 28.9.
    assert (terms_needed(10.0, 1e-8), terms_needed(100.0, 1e-8), terms_needed(10.0, 1e-12)) == (21, 33, 29)


def test_the_range_holds_its_ends_and_nothing_beyond():
    series = GainSeries(FREQ, OMEGA, LOW, HIGH)
    rows = np.array([LOW, HIGH, np.sqrt(LOW * HIGH), np.where(OMEGA > 50, 0.06, LOW), np.full(4, np.nan)])
    np.testing.assert_array_equal(series.holds(rows), [True, True, True, False, False])


@pytest.mark.parametrize("static", [False, True])
@pytest.mark.parametrize("base", ["unit", "weighed", "tied", "any"])
def test_the_square_is_that_of_the_difference_at_all_lines(base, static):
    rng = np.random.default_rng(2)
    runs, channels, d, count, m = 3, 3, 3, 6, OMEGA.size
    u = np.eye(d)[:, :, None] * np.ones(FREQ.size) + 0j
    if base == "any":
        u = rng.normal(size=(runs, d, FREQ.size)) + 1j * rng.normal(size=(runs, d, FREQ.size))
    if base == "tied":  # two directions move together, the third on its own
        u[0, 1] = 0.7 * u[0, 0]
        u[2] *= np.linspace(1, 2, FREQ.size)
    line = rng.uniform(0.5, 2, (runs, FREQ.size)) if base == "weighed" else np.ones((runs, FREQ.size))
    channel = rng.uniform(0.5, 2, channels)
    shapes, loads = rng.normal(size=(count, m, channels)), rng.normal(size=(count, m, d))
    ratios = rng.uniform(LOW, HIGH, (count, m))
    recovery = rng.normal(size=(channels, channels))
    made = np.einsum("cs,pks,pkf,pkd,rdf->prcf", recovery, shapes, np.array([gains(at) for at in ratios]), loads, u)
    if static:
        rigid = rng.normal(size=(count, d, d))
        made = made + np.einsum("cs,psd,rdf->prcf", recovery, rigid, u)
        shapes = np.concatenate([shapes, np.broadcast_to(np.eye(d), (count, d, d))], axis=1)
        loads = np.concatenate([loads, rigid], axis=1)
    record = made[0] * 1.1
    series = GainSeries(FREQ, OMEGA, LOW, HIGH)
    summed = SummedRecord(record, u, channel, line, recovery, series, static=static, beyond=np.zeros((0, *line.shape)))
    weight = channel[:, None] * line[:, None]
    expected = np.sum(np.abs(weight * (made - record)) ** 2, axis=(1, 2, 3))
    squared = summed.squared(shapes, loads, series.polynomials(ratios.T))
    np.testing.assert_allclose(squared, expected, atol=1e-9 * summed.size)
    assert summed.size == pytest.approx(np.sum(np.abs(weight * record) ** 2))
