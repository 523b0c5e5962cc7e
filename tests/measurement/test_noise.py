"""Weights of a fit: 1/std where noise is a channel's times a line's, and the nearest such product elsewhere."""

import numpy as np
import pytest

from sysid.measurement.noise import separable

SHAPE = (2, 3, 7)


def product(std):
    channel, line = separable(np.broadcast_to(std, SHAPE), SHAPE)
    assert channel.shape == (3,)
    assert line.shape == (2, 7)
    return channel[:, None] * line[:, None]


@pytest.mark.parametrize("std", [None, np.zeros(SHAPE)])
def test_nothing_stated_weighs_all_alike(std):
    channel, line = separable(std, SHAPE)
    np.testing.assert_array_equal(channel, np.ones(3))
    np.testing.assert_array_equal(line, np.ones((2, 7)))


@pytest.mark.parametrize("shape", [(), (3, 1), (7,), (2, 1, 1), (2, 1, 7)])
def test_what_separates_is_weighed_by_its_own_deviation(shape):
    """One number, one a channel, a spectrum, one a run, a spectrum a run, and each times one number a channel."""
    rng = np.random.default_rng(0)
    std = 10 ** rng.uniform(-1, 3, shape)
    for given in (std, std * 10 ** rng.uniform(-2, 2, (3, 1))):
        np.testing.assert_allclose(product(given) * np.broadcast_to(given, SHAPE), 1.0, rtol=1e-12)


def test_what_does_not_is_weighed_by_the_nearest_product_in_logarithms():
    rng = np.random.default_rng(1)
    std = np.exp(rng.normal(size=SHAPE))
    runs, channels, lines = np.indices(SHAPE).reshape(3, -1)
    design = np.hstack([np.eye(3)[channels], np.eye(14)[7 * runs + lines]])
    best = design @ np.linalg.lstsq(design, -np.log(std).ravel(), rcond=None)[0]
    np.testing.assert_allclose(np.log(product(std)).ravel(), best, atol=1e-12)


def test_no_sample_weighs_a_million_times_more_than_the_middle_one():
    std = np.ones(SHAPE)
    std[:, 1] = 0.0
    weight = product(std)
    np.testing.assert_allclose(weight[:, 1], 1e6, rtol=1e-9)
    np.testing.assert_allclose(weight[:, [0, 2]], 1.0, rtol=1e-9)
