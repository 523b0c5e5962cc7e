"""Noise drawn anew: the problem with the records that a structure would have given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.measurement.whole import NoiseLevels
from sysid.modal_analysis.misfit import inflation_of, misfits_of, noise_records
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.problem.prepared import Prepared
from sysid.problem.stated import StatedProblem
from sysid.problem.terms import FurtherTest, Prior
from sysid.structure.structure import Array, ComplexArray, Structure


def drawn(problem: Prepared, x: Array, random: np.random.SeedSequence) -> StatedProblem:
    """The problem with records simulated from the structure of `x` in the place of the measured ones.

    Their noise has the stated standard deviations, raised as the linear uncertainty is where the misfit is larger, else
    the size of the misfit that `x` leaves; values known to some accuracy are drawn too (parametric bootstrap: B. Efron
    and R. Tibshirani, An Introduction to the Bootstrap, 1993). With pseudo-values for records, as under Huber's loss,
    it is the noise under which squares scatter as that loss does: larger than that of the records by 1 / sqrt(0.95)
    without outliers, and by more with them, and so are the residuals of the draws.

    Raises
    ------
    InputError
        See `check_drawable`.
    """
    check_drawable(problem.stated)
    formulation, rng = problem.formulation, np.random.default_rng(random)
    tests = iter(formulation.further_tests)
    priors = iter(formulation.priors)
    residuals = []
    for given in problem.stated.residuals:
        if isinstance(given, FurtherTest):
            term = next(tests)
            structure = term.matrices.structure(x, term.test)
            again = replace(given, measurement=_again(term.test, structure, problem.n_variables, rng))
        else:
            _, value, std = given.column("Prior")
            at = value + std * next(priors).numbers(x)
            again = replace(given, value=at + std * rng.standard_normal(at.size))
        residuals.append(again)
    structure, modal = problem.structure(x), problem.modal[0]
    if modal.noise is None:
        test = _again(modal.records, structure, problem.n_variables, rng)
    else:
        test = _whole_again(modal, modal.noise, structure, rng)
    return replace(problem.stated, measurement=test, residuals=residuals, loss="squares", validation=(), reference=None)


def check_drawable(problem: StatedProblem) -> None:
    """Refuse a problem with something fitted whose noise nobody knows: a misfit or residuals of the user's own."""
    without_noise = [given for given in problem.residuals if not isinstance(given, FurtherTest | Prior)]
    if without_noise or problem.misfit is not None:
        raise InputError(
            "draws of noise need records, and values known to some accuracy (Prior): what noise the misfit or the "
            "residuals have that this problem states for itself is not known"
        )


def _again(test: Measurement, structure: Structure, unknowns: int, rng: np.random.Generator) -> Measurement:
    """The test with the records that the structure makes, and noise of the same size."""
    inflation = inflation_of(test, noise_records(test, structure, unknowns), unknowns)
    more = inflation if np.isfinite(inflation) else 1.0
    response, *force = [_noise(more * std, rng) - misfit for misfit, std in misfits_of(test, structure, unknowns)]
    other = replace(test, response=test.response + response)
    return other if test.force is None else replace(other, force=test.force + force[0])


def _whole_again(
    modal: ModalEstimate, noise: NoiseLevels, structure: Structure, rng: np.random.Generator
) -> Measurement:
    """Whole records that the structure makes with the same transients, and noise of the same levels in all channels."""
    test, at_rest = modal.given, modal.records

    def drawn(record: ComplexArray, levels: Array) -> ComplexArray:
        std = np.sqrt(modal.density)[:, None, None] * levels[..., None]
        return np.where(test.own_lines[:, None], _noise(np.broadcast_to(std, record.shape), rng), 0.0)

    response = test.response - (at_rest.relative - at_rest.predict(structure)) + drawn(test.response, noise.response)
    force = None
    if test.force is not None and at_rest.force is not None and noise.force is not None:
        force = test.force - (at_rest.force - at_rest.predict_force(structure)) + drawn(test.force, noise.force)
    return replace(test, base=test.base + drawn(test.base, noise.base), response=response, force=force)


def _noise(std: Array, rng: np.random.Generator) -> ComplexArray:
    """Circular complex noise, ``E|e|² = std²``."""
    real, imaginary = rng.standard_normal((2, *std.shape))
    noise: ComplexArray = std * (real + 1j * imaginary) / np.sqrt(2)
    return noise
