"""Intervals of an uncertainty: their ends by closed form, and what they refuse."""

import dataclasses

import numpy as np
import pytest
import scipy.stats

import sysid
from sysid import FullMass, InputError, Problem, SpectralStiffness
from sysid.assessment.uncertainty import uncertainty


@pytest.fixture
def u(random_structure):
    truth = random_structure(np.random.default_rng(19), 3, 2)
    test = sysid.simulate(truth, np.linspace(2, 66, 90), noise=0.03, force=True, rng=1)
    stiffness = SpectralStiffness(truth.natural_frequencies, max_frequency=500.0)
    return uncertainty(Problem(test, mass=FullMass(), stiffness=stiffness).prepared, truth, None)


def test_ends_are_those_of_the_normal_law_of_an_entry_or_of_its_logarithm(u):
    z = scipy.stats.norm.ppf(0.95)
    off = u.interval("stiffness", 0.9)
    K, s = u.structure.stiffness[:3, :3], u.stiffness
    np.testing.assert_allclose(off[1, 0, 1], K[0, 1] + z * s[0, 1])
    np.testing.assert_allclose(np.log(off[:, 2, 2] / K[2, 2]), [-z * s[2, 2] / K[2, 2], z * s[2, 2] / K[2, 2]])
    f = u.interval("natural_frequencies", 0.9)
    np.testing.assert_allclose(np.sqrt(f[0] * f[1]), u.structure.natural_frequencies)
    p, e = u.interval("participation", 0.9), u.interval("effective_masses", 0.9)
    crossing = (p[0] < 0) & (p[1] > 0)
    squares = np.sort(p**2, axis=0)
    for i in range(2):
        np.testing.assert_allclose(e[1, :, i, i], squares[1, :, i])
        np.testing.assert_allclose(e[0, :, i, i], np.where(crossing[:, i], 0, squares[0, :, i]))
    assert u.interval("mode_shapes").shape == (2, 3, 3) and np.all(u.interval("mass")[0][np.eye(3, dtype=bool)] > 0)


def test_what_is_hardly_known_stays_positive(u):
    vague = dataclasses.replace(u, mass=1e6 * u.mass)
    low, high = vague.interval("mass")
    own = np.eye(3, dtype=bool)
    assert np.all(low[own] >= 0) and np.all(high[own] > 1e3 * u.structure.mass[:3, :3][own])


def test_an_unknown_name_and_a_level_that_is_none_are_refused(u):
    with pytest.raises(InputError, match="no uncertainty of 'masses'"):
        u.interval("masses")
    with pytest.raises(InputError, match="level = 95"):
        u.interval("mass", 95)


def test_its_text_says_whether_masses_are_known(u):
    assert "masses known" in repr(u)
