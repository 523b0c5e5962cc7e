"""Records of channels that are late against the base, brought to its clock."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid.measurement.measurement import Measurement
from sysid.structure.structure import Array


def without_delays(test: Measurement, delays: Array) -> Measurement:
    """The test with each channel earlier by its delay, s: of the sensors, then, where there is one, of the force.

    Spectra of whole records are turned about: a record that begins earlier holds its beginning at its end. `taken` of
    its `WholeRecords` says so, and their model has the samples there for unknowns.
    """
    turn = np.exp(2j * np.pi * delays[:, None] * test.freq)
    force, whole = (None if test.force is None else test.force * turn[-1]), test.whole and test.whole.earlier(delays)
    return replace(test, response=test.response * turn[: test.n_sensors], force=force, whole=whole)
