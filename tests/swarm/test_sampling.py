import numpy as np
import pytest
from scipy.stats import qmc

from sysid.swarm.box import latin_hypercube


@pytest.mark.parametrize(("count", "size"), [(7, 3), (1, 1)])
def test_points_are_those_of_scipy(count, size):
    points = latin_hypercube(count, size, np.random.default_rng(5))
    assert np.array_equal(points, qmc.LatinHypercube(size, rng=5).random(count))


def test_no_direction_has_no_entries():
    assert latin_hypercube(40, 0, np.random.default_rng(5)).shape == (40, 0)
