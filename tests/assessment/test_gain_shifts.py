"""Shifts of the masses by an error of a sensor's gain: against fits of records that were read too large."""

import dataclasses

import numpy as np
import pytest

import sysid
from sysid import ChainStiffness, FullMass, LumpedMass, Measurement, Problem, Structure, simulate
from sysid.assessment.checks.gains import GainErrors, rests_on

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")
STEP = 2e-4  # of a gain
K = 5000.0 * np.array([[2.0, -1, 0, -1], [-1, 2, -1, 0], [0, -1, 1, 0], [-1, 0, 0, 1]])
TRUTH, ON_TABLE = (Structure(np.diag([4.0, 3.0, 5.0, base]), K, [0.01, 0.015, 0.02], n_base=1) for base in (0.0, 2.0))
MODELS = {
    "full": {"mass": FullMass()},
    "lumped": {"mass": LumpedMass()},
    "chain": {"mass": LumpedMass(12.0), "stiffness": ChainStiffness(1e3, 2e4)},
}


@pytest.fixture(scope="module")
def spectra():
    f = TRUTH.natural_frequencies
    return simulate(TRUTH, np.geomspace(0.5 * f[0], 1.3 * f[-1], 200), noise=0.003, force=True, rng=3)


def identified(test, mass, stiffness=None):
    """Where the stiffness has a form of its own from one guess alone, which is quick."""
    if stiffness is None:
        return sysid.identify(Problem(test, mass=mass), rng=0)
    return sysid.identify(Problem(test, mass=mass, stiffness=stiffness), strategy=sysid.Continuation(starts=1), rng=0)


def assert_shift(found, sensor):
    """`found(sensor, error)` identifies from records of which one is read too large."""
    more, less = (np.diag(found(sensor, error).structure.mass)[:3] for error in (STEP, -STEP))
    expected = np.abs(more - less) / (2 * STEP)
    np.testing.assert_allclose(found(sensor, 0.0).uncertainty.mass_by_gain[sensor], expected, rtol=0.02, atol=0.02)


def misread(test, sensor, error):
    response = test.response.copy()
    response[:, sensor] *= 1 + error
    return dataclasses.replace(test, response=response)


@pytest.mark.parametrize("models", MODELS.values(), ids=MODELS)
def test_of_lines(spectra, models):
    assert_shift(lambda sensor, error: identified(misread(spectra, sensor, error), **models), 1)


def test_of_lines_whose_noise_no_weights_share(spectra):
    """The shift of a fit by an error is the weights' matter, whatever the noise is."""
    times = np.random.default_rng(5).uniform(0.3, 3.0, spectra.response.shape)
    uneven = dataclasses.replace(spectra, response_std=0.01 * times)
    assert_shift(lambda sensor, error: identified(misread(uneven, sensor, error), FullMass()), 1)


def test_of_lines_beside_a_stated_entry(spectra):
    """The statement is where the records alone lead, so that no second order of the adjustment counts."""
    known, std = np.full((2, 3, 3), np.nan)
    known[0, 0], std[0, 0] = identified(spectra, FullMass()).structure.mass[0, 0], 0.02
    mass = FullMass(known=known, known_std=std)
    assert_shift(lambda sensor, error: identified(misread(spectra, sensor, error), mass), 0)


@pytest.mark.parametrize(("name", "truth"), [("full", ON_TABLE), ("chain", TRUTH)], ids=["full", "chain"])
def test_of_whole_records(name, truth):
    """Steady state under a sum of cosines that are no lines of the record."""
    rng, rate = np.random.default_rng(0), 60.0
    freq = np.linspace(1.0, 12.0, 173)
    waves = (rng.normal(size=freq.size) + 1j * rng.normal(size=freq.size))[:, None] * np.exp(
        2j * np.pi * np.outer(freq, np.arange(1200) / rate)
    )
    H = np.concatenate([np.ones((1, freq.size)), truth.transmissibility(freq)[:, 0], truth.base_force(freq)[0]])
    clean = (H @ waves).real
    noisy = clean + 0.01 * np.std(clean, axis=1)[:, None] * rng.normal(size=clean.shape)

    def found(sensor, error):
        gain = 1 + error * (np.arange(5) == 1 + sensor)
        base, response, force = np.split(noisy * gain[:, None], [1, 4])
        test = Measurement.from_time([(base, response, force)], rate, rigid_body=truth.rigid_body, band=(1.5, 11.0))
        return identified(test, **MODELS[name])

    assert_shift(found, 1)


class TestGainNotShown:
    @pytest.fixture
    def told(self, spectra):
        def told(error, std, worth):
            errors = GainErrors(np.array(error), np.array(std), np.zeros(3), 1000, np.zeros(3))
            return list(rests_on(spectra, errors, np.array(worth)))

        return told

    def test_names_gains_that_masses_rest_on_and_no_others(self, told):
        """1.2 % and 1.96 deviations of 0.5 % are 2.18 %: 4.36 of M_SS's deviations at 2 a per cent, but 2.18 at 1."""
        (one,) = told([0.012, 0.012, 0.0], [0.005, 0.005, 0.005], [2.0, 1.0, 2.9])
        assert (one.kind, one.severity, one.channel) == ("gain not shown", "note", "sensor 1")
        assert one.numbers == pytest.approx({"gain": 1.012, "deviations": 4.36}, rel=1e-4)

    def test_nothing_where_the_records_show_the_gains_well(self, told):
        assert told([0.0, 0.001, -0.001], [1e-3] * 3, [9.0] * 3) == []

    def test_a_gain_that_no_record_shows_counts_as_two_per_cent_off(self, told):
        (one,) = told([np.nan, np.nan, 0.0], [np.nan, np.nan, 1e-3], [1.7, 1.6, 0.0])  # by chance 3.29 deviations
        assert one.channel == "sensor 1" and one.numbers["deviations"] == pytest.approx(3.4)


def test_gains_are_in_summary_and_figures(spectra):
    result = identified(spectra, FullMass())
    told = result.to_dict()["gains"]
    np.testing.assert_allclose([one["gain"] for one in told], 1 + result.gains.error)
    np.testing.assert_allclose([one["std"] for one in told], result.gains.std)
    each = result.uncertainty.mass_by_gain / np.diag(result.uncertainty.mass)
    np.testing.assert_allclose([one["deviations_per_percent"] for one in told], each.max(axis=1) / 100)
    row = next(line for line in result.summary().splitlines() if line.lstrip().startswith("sensor 2"))
    assert row.split()[2] == f"{told[1]['gain']:.4f}"
