"""Limits of round-off and of chance, against SciPy's laws and matrices whose rank is known."""

import numpy as np
import pytest
from scipy.stats import chi2, norm, rayleigh

from sysid.structure.thresholds import (
    CANDIDATES,
    COVERAGE,
    FALSE_ALARM,
    LIKELY,
    beyond_chance,
    largest_modulus,
    most_deviations,
    round_off,
)


@pytest.mark.parametrize("size", [3, 40, 300])
def test_round_off_parts_zero_singular_values_from_others(size):
    rng = np.random.default_rng(size)
    left, right = (np.linalg.qr(rng.standard_normal((size, size)))[0] for _ in range(2))
    values = np.where(np.arange(size) < size - 1, np.geomspace(1, 1e-6, size), 0.0)
    found = np.linalg.svd((left * values) @ right.T, compute_uv=False)
    assert np.count_nonzero(found > round_off(size) * found[0]) == size - 1


@pytest.mark.parametrize("at_once", [1, 30, CANDIDATES])
@pytest.mark.parametrize("freedom", [1, 2, 7, 60, 5000])
def test_sums_of_squares_pass_the_limit_at_the_rate_of_false_alarms_shared_by_all(freedom, at_once):
    assert at_once * chi2.sf(beyond_chance(freedom, at_once), freedom) == pytest.approx(FALSE_ALARM, rel=1e-6)


def test_nothing_summed_is_no_more_than_chance():
    assert beyond_chance(0, 5) == 0.0


@pytest.mark.parametrize("at_once", [1, 12, CANDIDATES])
def test_a_number_of_noise_is_off_so_far_at_the_same_rate(at_once):
    assert 2 * at_once * norm.sf(most_deviations(at_once)) == pytest.approx(FALSE_ALARM, rel=1e-6)
    assert at_once * rayleigh.sf(np.sqrt(2) * largest_modulus(at_once)) == pytest.approx(FALSE_ALARM, rel=1e-6)


def test_likely_deviations_hold_the_coverage_of_intervals():
    assert norm.cdf(LIKELY) - norm.cdf(-LIKELY) == pytest.approx(COVERAGE, rel=1e-12)
