"""A fit of whole records as a tree: what was found, without the records."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_fit import Modes
from sysid.modal_analysis.modal_model import Parameters
from sysid.modal_analysis.record_fit import RecordFit
from sysid.modal_analysis.record_model import TRACES, RecordModel


def to_tree(fit: RecordFit) -> dict[str, Any]:
    """Give what was found as dictionaries, arrays and numbers; `from_tree` takes it back."""
    p, whole = fit.parameters, fit.test.whole
    assert whole is not None
    return {
        "modes": p.modes._asdict(), "rigid": p.rigid, "ends": p.ends, "traces": p.traces, "levels": fit.levels,
        "chi2": fit.chi2, "settled": fit.settled, "stopped": fit.stopped, "varying": whole.varying,
    }  # fmt: skip


def fits_from_tree(tree: dict[str, Any], tests: Iterable[Measurement]) -> list[RecordFit | None]:
    """Give the fit of each test that the tree of a problem holds; None where it holds none."""
    every = list(tests)
    fits = tree.get("fits") or [None] * len(every)  # results of before hold none
    return [None if fit is None else from_tree(fit, test) for fit, test in zip(fits, every, strict=True)]


def from_tree(tree: dict[str, Any], test: Measurement) -> RecordFit:
    """Give the fit of a test that `to_tree` made a tree of, exact to the bit.

    Raises
    ------
    InputError
        Where it is of another test.
    """
    modes = Modes(**tree["modes"])
    whole, varying = test.whole, tree["varying"]
    if whole is None:
        raise InputError("a fit of whole records stands beside a test that has none")
    if varying is not None:
        test = replace(test, whole=replace(whole, varying=np.asarray(varying, bool)))
    p = Parameters(modes, tree["rigid"], tree["ends"], tree["traces"])
    model = RecordModel(test, modes.omega.size)
    n, d, m, c = model.n, model.d, model.m, model.channels
    stored = [*modes, p.rigid, p.ends, p.traces, tree["levels"]]
    wanted: list[tuple[int, ...]] = [
        (n, m), (m, d), (m,), (m,), (d, d), (m, 2 * len(model.moving)), (test.n_runs, c, TRACES),
        (len(model.runs), c + d),
    ]  # fmt: skip
    if [part.shape for part in stored] != wanted or not all(np.all(np.isfinite(part)) for part in stored):
        raise InputError("the stored fit of the whole records is of another test, or holds what is no number")
    return RecordFit(test, p, tree["levels"], tree["chi2"], tree["settled"], tree["stopped"])
