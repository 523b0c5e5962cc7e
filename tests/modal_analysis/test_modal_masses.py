"""Modal masses by a base force: a wrong sign is named, and a right one is accused of none."""

import dataclasses

import numpy as np
import pytest

import sysid
from benchmarks.modal.random_structures import random_structure
from sysid.modal_analysis.modal_fit import Modes, weigh


def _test(seed, lowest, highest):
    truth = random_structure(seed, n=5, d=2)
    freq = np.linspace(lowest, highest, 120) * truth.natural_frequencies[-1]
    modes = Modes(truth.mode_shapes, truth.participation, 2 * np.pi * truth.natural_frequencies, truth.damping_ratios)
    return sysid.simulate(truth, freq, noise=0.02, force=True, rng=seed), modes, truth


@pytest.mark.parametrize("seed", [1, 5, 12, 39])
def test_a_right_force_is_not_accused_though_all_modes_lie_below_the_lines(seed):
    # Motion and force of such modes are nearly those of the base: free masses cancel each other, of any sign.
    test, modes, _ = _test(seed, 3.0, 6.0)
    masses, _ = weigh(test, modes)
    assert np.all(masses > 0)


@pytest.mark.parametrize("seed", [1, 5, 12, 39])
def test_a_force_of_the_wrong_sign_is_named(seed):
    test, modes, truth = _test(seed, 0.1, 1.3)
    masses, rigid = weigh(test, modes)
    moved = np.linalg.norm(modes.gamma, axis=1) > 0.2 * np.linalg.norm(modes.gamma)
    np.testing.assert_allclose(masses[moved], 1.0, rtol=0.1)  # participations are those of unit modal masses
    np.testing.assert_allclose(np.diag(rigid), np.diag(truth.rigid_body_mass), rtol=0.1)
    with pytest.raises(sysid.InputError, match="negative masses: check its sign"):
        weigh(dataclasses.replace(test, force=-test.force), modes)
