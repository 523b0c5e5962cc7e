"""Refusals of the swarm, and the sentences it says."""

import numpy as np
import pytest

from sysid.errors import InputError
from sysid.swarm import ParticleSwarm, SwarmSettings

BOUNDS = np.array([[-1.0, 3.0], [0.0, 10.0], [-2.0, -1.0], [5.0, 5.5]])
CENTRE = BOUNDS.mean(axis=1)


@pytest.mark.parametrize(
    ("bounds", "words"),
    [
        ([(0, 1), (2, 1)], r"bounds\[1\] = \(2.0, 1.0\).*exchange"),
        ([(0, np.nan)], r"bounds\[0\].*finite"),
        ([(-np.inf, 1)], r"bounds\[0\].*finite"),
        ([(-1e308, 1e308)], r"bounds\[0\].*finite"),
        ([0, 1], r"shape \(2,\).*\(n_dim, 2\)"),
        ([(0, 1, 2)], r"shape \(1, 3\)"),
        (np.empty((0, 2)), r"shape \(0, 2\)"),
        ("box", "not an array of real numbers"),
        ([(0, 1), (0,)], "not an array of real numbers"),
    ],
)
def test_bounds_that_cannot_be_used_are_refused(bounds, words):
    with pytest.raises(InputError, match=words):
        ParticleSwarm(bounds)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"n_particles": 1}, "n_particles is 1; give 2 or above"),
        ({"n_particles": 2.5}, "n_particles is 2.5; give a whole number"),
        ({"horizon": 0}, "horizon is 0"),
        ({"rng": -1}, "rng is -1"),
        ({"rng": "seed"}, "rng is 'seed'"),
        ({"x0": [0, 0]}, r"x0 has shape \(2,\)"),
        ({"x0": [9, 5, -1.5, 5.2]}, r"x0\[0\] = 9.0 is outside its bounds \[-1.0, 3.0\]"),
        ({"x0": [0, np.nan, -1.5, 5.2]}, r"x0\[1\] = nan is outside"),
        ({"x0": "start"}, "x0 is not an array of real numbers"),
    ],
)
def test_arguments_that_cannot_be_used_are_refused(arguments, words):
    with pytest.raises(InputError, match=words):
        ParticleSwarm(BOUNDS, **arguments)


@pytest.mark.parametrize(
    ("costs", "words"),
    [
        (np.zeros(19), r"shape \(19,\) for 20 rows"),
        (np.zeros((20, 1)), r"shape \(20, 1\) for 20 rows"),
        (0.0, r"shape \(\) for 20 rows"),
        (np.zeros(20, dtype=complex), "complex128; give real numbers"),
        (["low"] * 20, "give real numbers"),
    ],
)
def test_costs_that_cannot_be_used_are_refused_and_change_nothing(costs, words):
    swarm = ParticleSwarm(BOUNDS, rng=0)
    rows = swarm.ask()
    with pytest.raises(InputError, match=words):
        swarm.tell(costs)
    assert swarm.nit == swarm.nfev == 0
    np.testing.assert_array_equal(swarm.ask(), rows)


def test_calls_out_of_order_are_refused():
    swarm = ParticleSwarm(BOUNDS, rng=0)
    with pytest.raises(RuntimeError, match="tell was called before ask"):
        swarm.tell([0.0])
    swarm.ask()
    with pytest.raises(RuntimeError, match="inject was called between ask and tell"):
        swarm.inject(CENTRE, 0.0)


@pytest.mark.parametrize(
    ("constants", "words"),
    [
        ({"max_velocity": 0}, "max_velocity is 0"),
        ({"inertia_b1": -1}, "inertia_b1 = -1: a finite number >= 0"),
        ({"elitist_sigma_end": np.nan}, "elitist_sigma_end = nan"),
        ({"acceleration_lower": 3}, "acceleration_lower = 3 is above"),
        ({"guides": -1}, "guides = -1"),
        ({"guides": 1.5}, "SwarmSettings.guides is 1.5; give a whole number"),
        ({"guide_share": 0.0}, "guide_share is 0.0; give a part of the swarm"),
        ({"guide_share": 1.1}, "guide_share is 1.1; give a part of the swarm"),
    ],
)
def test_constants_that_cannot_be_used_are_refused(constants, words):
    with pytest.raises(InputError, match=words):
        SwarmSettings(**constants)
