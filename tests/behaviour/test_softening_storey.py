"""The problem of a storey frame that softens, against its truth and beside the linear model."""

import numpy as np

import sysid
from sysid import catalogue


def test_the_law_is_found_and_predicts_an_unseen_run_ten_times_as_closely_as_a_linear_model():
    built = catalogue.build(sysid.Recipe("softening_storey"))
    result = sysid.identify(built, rng=0)
    (law,) = result.structure.laws
    truth = {level: _true(level) for level in (1.0, 5.0, 20.0)}
    for level, expected in truth.items():
        np.testing.assert_array_less(
            np.abs(np.subtract(law.at(level), expected)), 4 * np.array(law.deviations_at(level))
        )
    f = float(result.structure.natural_frequencies[0])
    plain = catalogue.build(sysid.Recipe("softening_storey", parameters={"amplitude": False}))
    linear = sysid.identify(plain, rng=0)
    missed, beside = (one.validation[0].residual(one.structure) for one in (result, linear))  # without transients
    assert 10 * missed < beside
    assert not linear.structure.laws and linear.structure.natural_frequencies[0] < f


def _true(level):
    """Frequency, Hz, and damping ratio at a level, by hand: two masses of 100 kg on springs of 90 kN/m."""
    golden = (np.sqrt(5) - 1) / 2
    at_rest = golden * np.sqrt(9.0e4 / 100.0) / (2 * np.pi)
    return at_rest * (1 - 0.04 * np.sqrt(level / 12.0)), 0.01 + 0.012 * level / 12.0
