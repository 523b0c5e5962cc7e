"""Scores of predicted records in time."""

import numpy as np
import pytest

import sysid


def test_scores_of_records_whose_scores_are_known():
    """Sines over whole periods: half the size, a quarter period late, an offset, a channel at rest."""
    phase = 2 * np.pi * np.arange(400) / 40
    sine, cosine = np.sin(phase), np.cos(phase)
    measured = [2 * sine, sine, sine, 0 * sine]
    scores = sysid.time_scores(measured, [sine, cosine, sine + 1, sine])
    np.testing.assert_allclose(scores.error, [0.5, np.sqrt(2), np.sqrt(2), np.nan])
    np.testing.assert_allclose(scores.correlation, [1, 0, 1, np.nan], atol=1e-12)
    np.testing.assert_allclose(scores.measured_peaks, [2, 1, 1, 0])
    np.testing.assert_allclose(scores.predicted_peaks, [1, 1, 2, 1])


@pytest.mark.parametrize(("measured", "predicted"), [([[1.0, 2.0]], [[1.0]]), (np.ones((2, 0)), np.ones((2, 0)))])
def test_shapes_that_cannot_be_compared_are_refused(measured, predicted):
    with pytest.raises(sysid.InputError, match="both must be"):
        sysid.time_scores(measured, predicted)
