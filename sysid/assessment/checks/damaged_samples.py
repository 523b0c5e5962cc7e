"""Damaged samples of the records of a test: what was left out, and what was not."""

from __future__ import annotations

from collections.abc import Iterator
from typing import cast

from sysid.assessment.checks.context import Context, of_tests
from sysid.finding import MOST_OF_A_KIND, Finding, Kind, Severity
from sysid.measurement.damaged_runs import DamagedChannel
from sysid.measurement.measurement import Measurement


def damaged_channels(context: Context) -> Iterator[Finding]:
    """Samples are clipped, missing, held or spikes, a channel hums, or two are equal: left out, or to be mended."""
    problem = context.problem
    yield from of_tests([list(_of_test(one.given)) for one in problem.modal[problem.first_test - 1 :]])


def _of_test(test: Measurement) -> Iterator[Finding]:
    """One finding of each kind in each channel, the most samples first."""
    told: dict[str, int] = {}
    for one in sorted(test.damage, key=lambda one: -one.count):
        told[one.kind] = told.get(one.kind, 0) + 1
        if told[one.kind] <= MOST_OF_A_KIND:
            yield _finding(one)


def _finding(one: DamagedChannel) -> Finding:
    """What was left out speaks against nothing."""
    numbers = {
        "count": float(one.count), "samples": float(one.samples), "value": one.value,
        "first": float(one.stretches[0, 0]), "last": float(one.stretches[-1, 1]),
    }  # fmt: skip
    severity = Severity.NOTE if one.left_out else Severity.CAUTION
    return Finding(cast("Kind", one.kind), severity, one.sentence, one.remedy, one.run, one.channel, numbers)
