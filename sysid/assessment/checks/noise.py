"""The noise of whole records: where it is not white, not told, or not all that a fit leaves."""

from __future__ import annotations

from collections.abc import Iterator

from sysid.assessment.checks.context import Context
from sysid.finding import MOST_OF_A_KIND, Finding, Severity
from sysid.measurement.spectra import of_run
from sysid.modal_analysis.modal_estimate import ModalEstimate


def noise_of_records(context: Context) -> Iterator[Finding]:
    """Noise of whole records that is not white or not told, and what a fit leaves beside it."""
    for _, modal, _ in () if context.outcome is None else context.fits:
        yield from noise_findings(modal)


def noise_findings(modal: ModalEstimate) -> Iterator[Finding]:
    """Where the noise of whole records, their transients taken off, is not white, and what the fit leaves beside it."""
    test = modal.records
    axes = test.base_axes or ()
    names = [*test.sensor_names]
    names += [f"force {axis}" for axis in axes] if test.force is not None else []
    names += [f"base {axis}" for axis in axes]
    name = lambda one: names[one.channel] + of_run(one.run, test.n_runs)  # noqa: E731
    for one in modal.varying:
        times = float(one.largest / one.least)
        yield Finding(
            "coloured noise", Severity.NOTE,
            f"the noise of {name(one)} is not white: its level varies smoothly over the lines, {times:.2g} times from "
            "least to largest",
            run=one.run + 1, channel=names[one.channel], numbers={"times": times},
        )  # fmt: skip
    for run, channel in modal.untold:
        yield Finding(
            "noise level", Severity.NOTE,
            f"the records do not tell the noise level of {names[channel]}{of_run(run, test.n_runs)}, as it is small "
            "beside that of other channels or shows as theirs does: the level given is one of many that explain them "
            "as well",
            run=run + 1, channel=names[channel],
        )  # fmt: skip
    source = "intervals are by its scatter" if modal.scatter is not None else "intervals are as if it were white"
    for excess in modal.excess[:MOST_OF_A_KIND]:
        yield Finding(
            "noise left", Severity.NOTE,
            f"what the fit leaves in {name(excess)} is {excess.factor:.2g} times the noise level between "
            f"{excess.low:.3g} and {excess.high:.3g} Hz: the noise there is not white, or the model misses something; "
            f"{source}",
            run=excess.run + 1, channel=names[excess.channel],
            numbers={"times": float(excess.factor), "low": float(excess.low), "high": float(excess.high)},
        )  # fmt: skip
