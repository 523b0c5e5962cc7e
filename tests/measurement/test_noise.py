"""Weights of a fit: 1/std where noise is a channel's times a line's, else the nearest such product; levels at rest."""

import numpy as np
import pytest

import sysid
from sysid.measurement.whole import separable

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


def test_a_deviation_of_zero_among_others_is_no_statement():
    """As of a function that is zero at one line: else that line alone would weigh as much as all others."""
    std = np.broadcast_to([[0.5], [500.0], [0.0]], SHAPE).copy()
    std[0, 1, 3] = 0.0  # of the others of its channel; a channel without any takes those of the record
    test = sysid.Measurement(
        np.arange(1.0, 8.0), np.ones((2, 1, 7)), np.ones(SHAPE), rigid_body=np.ones((3, 1)), response_std=std
    )
    np.testing.assert_array_equal(test.response_std, np.broadcast_to([[0.5], [500.0], [0.5]], SHAPE))


class TestNoiseFromRest:
    def test_levels_are_those_of_the_noise_beside_offset_and_drift(self):
        rng, rate, n = np.random.default_rng(5), 100.0, 20_000
        true = np.array([0.02, 0.03, 0.01, 5.0])  # two sensors, base, force
        noise = true[:, None] * rng.standard_normal((4, n)) + np.linspace(1.0, 1.5, n)
        runs = [(noise[2:3, a:b], noise[:2, a:b], noise[3:, a:b]) for a, b in ((0, 12_000), (12_000, n))]
        levels = sysid.Measurement.noise_from_rest(runs, rate)
        found = np.concatenate([levels.response, levels.base, levels.force])
        np.testing.assert_allclose(found, true, rtol=4 / np.sqrt(2 * n))

    def test_coloured_noise_has_the_level_of_the_band(self):
        rng, rate, n = np.random.default_rng(6), 100.0, 50_000
        white = rng.standard_normal((2, n + 1))
        rising = white[:, 1:] - white[:, :-1]  # its spectrum is 2 |sin(pi f / rate)| times the white one's
        low, high = 10.0, 12.0
        levels = sysid.Measurement.noise_from_rest([(rising[:1], rising[1:], None)], rate, band=(low, high))
        f = np.linspace(low, high, 1001)
        wanted = np.sqrt(np.mean(4 * np.sin(np.pi * f / rate) ** 2))
        np.testing.assert_allclose([levels.base[0], levels.response[0]], wanted, rtol=4 / np.sqrt(2 * n * 0.04))

    def test_a_stretch_that_is_too_short_is_refused(self):
        rest = np.random.default_rng(7).standard_normal((1, 60))
        with pytest.raises(sysid.InputError, match="has 28 lines in the band, too few for a level"):
            sysid.Measurement.noise_from_rest([(rest, rest, None)], 10.0)


def recorded():
    base, response, force = (np.random.default_rng(n).standard_normal((n, 40)) for n in (1, 2, 1))
    return [(base, response, force)]


class TestStatedLevels:
    def test_one_number_stands_for_all_channels_of_a_kind(self):
        noise = sysid.NoiseLevels(0.02, 0.01, 3.0)
        test = sysid.Measurement.from_time(recorded(), 10.0, rigid_body=[[1.0], [1.0]], noise=noise)
        np.testing.assert_array_equal(test.whole.noise.outputs, [0.02, 0.02, 3.0])

    @pytest.mark.parametrize(
        ("noise", "told"),
        [
            (
                sysid.NoiseLevels([0.1, 0.2, 0.3], 0.01, 1.0),
                r"noise of the response has shape \(3,\): one number, \(2,\)",
            ),
            (sysid.NoiseLevels(0.1, [[0.01], [0.02]], 1.0), r"noise of the base has shape \(2, 1\)"),
            (sysid.NoiseLevels(0.1, 0.01), "states no level of the force"),
        ],
    )
    def test_levels_of_other_channels_are_refused(self, noise, told):
        with pytest.raises(sysid.InputError, match=told):
            sysid.Measurement.from_time(recorded(), 10.0, rigid_body=[[1.0], [1.0]], noise=noise)
