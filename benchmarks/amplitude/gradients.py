"""The gradient of a joint fit of modes, transients and laws of amplitude against differences of fourth order."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import sysid
from benchmarks.amplitude.softening_storeys import LEVELS, Array, recorded, shaken, storeys
from benchmarks.line import Line, above, below
from sysid.modal_analysis.record_model import RecordModel


def lines(reduced: bool) -> Iterator[Line]:
    """Five points within some deviations of the answer, each in five directions; reduced: of records of 10 s, not 60.

    The slope of chi-squared along a step that moves every unknown by a share of its deviation, over the sum of what
    each of them adds to it: terms may cancel down to the round-off of differences.
    """
    rng, seconds = np.random.default_rng(0), 10.0 if reduced else 60.0
    structure = storeys("law", rng, 2)
    bases = np.array([shaken(level, seconds, rng) for level in LEVELS])
    test = recorded(list(zip(bases, structure.under(bases), strict=True)), 0.01, rng)
    result = sysid.identify(sysid.Problem(test, amplitude=sysid.AmplitudeLaw([1], (0.5, 1.0))), rng=0)
    fit = result.prepared.modal[0].record_fit
    assert fit is not None
    model = fit.model
    free = ~model.held

    def step_of(at: Array, size: float) -> Array:
        """A random step that moves each unknown by about so many of its deviations beside which all others stay."""
        slopes = np.diag(model.normal_equations(model.unpack(at), fit.levels).normal)
        return np.where(free, size * rng.standard_normal(at.size) / np.sqrt(np.where(free, slopes, 1.0)), 0.0)

    worst, answer = 0.0, model.pack(fit.parameters)
    for _ in range(5):
        point = answer + step_of(answer, 3.0)
        gradient = -2 * model.gradient(model.unpack(point), fit.levels).gradient
        for _ in range(5):
            step = step_of(point, 1.0)
            near, far = (_difference(model, fit.levels, point, times * step) for times in (0.01, 0.02))
            slope = (8 * near - far) / 0.12
            worst = max(worst, abs(slope - gradient @ step) / np.abs(gradient * step).sum())
    text = "gradient of a fit with a law beside differences of fourth order, five points in five directions"
    yield below(f"{text}: largest difference", float(worst), 1e-6)
    yield above("laws of this fit", len(fit.parameters.laws), 1)


def _difference(model: RecordModel, levels: Array, at: Array, step: Array) -> float:
    """Of chi-squared a step ahead and a step back."""
    ahead, back = (model.chi2(model.unpack(at + sign * step), levels) for sign in (1, -1))
    return ahead - back
