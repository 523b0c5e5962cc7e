"""Measured records of a shake table: the first mode follows its amplitude; each event predicted from the other."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import sysid
from benchmarks.line import Line, above
from benchmarks.problem_modules import load_module
from benchmarks.swarm.shake_table import ABSENT, EVENTS, records_folder, score_of


def lines(reduced: bool) -> Iterator[Line]:
    """Both events each way; reduced: the first predicts the second by a stated law, without a linear model beside."""
    data = records_folder()
    if data is None:
        yield ABSENT
        return
    event = load_module("mini_shake_table").event
    tests = {name: event(data / name, "records") for name in EVENTS}
    own, names = [], EVENTS[:1] if reduced else EVENTS
    for name in names:
        law = sysid.AmplitudeLaw([1], (0.5, 0.5)) if reduced else sysid.AmplitudeLaw()
        result = sysid.identify(sysid.Problem(tests[name], amplitude=law), rng=0)
        other = next(one for one in EVENTS if one != name)
        own.append(float(np.mean(score_of(result.predict(tests[name]), tests[name].relative))))
        unseen = score_of(result.predict(tests[other]), tests[other].relative)
        scores = " / ".join(f"{one:.3f}" for one in unseen)
        if not reduced:
            linear = sysid.identify(sysid.Problem(tests[name]), rng=0)
            beside = float(np.mean(score_of(linear.predict(tests[other]), tests[other].relative)))
            scores += f"; linear {beside:.3f}"
        yield above(f"fitted on {name}: mean score of {other}, never fitted ({scores})", float(np.mean(unseen)), 0.6)
    each = " and ".join(f"{one:.3f}" for one in own)
    yield above(f"mean score of the fitted event, relative X ({each})", float(np.mean(own)), 0.8)
