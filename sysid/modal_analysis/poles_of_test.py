"""Poles of a test of any kind, roughly: those of whole records beside their transients, with rough weights."""

from __future__ import annotations

from dataclasses import replace

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.record_poles import decimated_lines, rough_deviations
from sysid.modal_analysis.vector_fitting import find_poles
from sysid.structure.structure import Array


def poles_of_test(test: Measurement) -> tuple[Array, Array]:
    """Circular frequencies (m,), rad/s, ascending, and damping ratios (m,).

    Raises
    ------
    InputError
        As `find_poles` does.
    """
    if test.whole is not None:
        test = test.at(decimated_lines(test))
        test = replace(test, response_std=rough_deviations(test))
    found = find_poles(test)
    return found.omega, found.ratios
