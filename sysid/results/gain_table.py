"""The gain of each sensor as the records show it, for summary, summary.json and report."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sysid.results.answer import Answer
from sysid.structure.thresholds import EXACT


class SensorGain(NamedTuple):
    """Gain of a sensor against the base's, its standard deviation, and what 1 % of it does to M_SS.

    `worth` is in stated deviations of the diagonal entry that moves by most of them; NaN where there is no noise.
    """

    sensor: str
    gain: float
    std: float
    worth: float


def gains_of_sensors(it: Answer) -> tuple[SensorGain, ...]:
    """Gains of the sensors that the records of a fit show; of none where deviations take long or nothing was fitted."""
    if it.quick_uncertainty is None or not it.success or not it.facts.fits_records:
        return ()
    found, names = it.gains, it.measurement.sensor_names
    known = np.isfinite(found.error)
    worth = np.where(np.nan_to_num(found.std) > EXACT, it.gain_worth, np.nan)  # without noise M has no deviation
    return tuple(
        SensorGain(names[i], 1 + float(found.error[i]), float(found.std[i]), float(worth[i]))
        for i in np.flatnonzero(known)
    )
