"""Damaged samples of the records of a test: what was left out, and what was not."""

from __future__ import annotations

from collections.abc import Iterator
from typing import cast

import numpy as np

from sysid.assessment.checks.context import Context, of_tests
from sysid.finding import MOST_OF_A_KIND, Finding, Kind, Severity
from sysid.measurement.damaged_runs import DamagedChannel, names_of_channels
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.record_fit import RecordFit


def damaged_channels(context: Context) -> Iterator[Finding]:
    """Samples are clipped, missing, held or spikes, hum, or equal channels: left out, fitted, or to be mended."""
    problem = context.problem
    yield from of_tests([[*_of_test(one), *_tones(one)] for one in problem.modal[problem.first_test - 1 :]])


def _tones(modal: ModalEstimate, beyond: float = 6.0) -> Iterator[Finding]:
    """Tones that were fitted beside the modes, and the channels where they are `beyond` their deviations."""
    fit, test = modal.record_fit, modal.given
    whole = None if fit is None else fit.model.whole
    if fit is None or whole is None or not whole.tones:
        return
    names = names_of_channels(test.sensors, test.rigid_body, test.base_axes)[test.n_base :]
    n = np.array(whole.samples)[:, None]
    power = np.sum(np.abs(fit.test.outputs) ** 2, axis=2)
    rms, noise = np.sqrt(2 * power) * whole.spacing[:, None], np.sqrt(fit.levels_of_runs[:, : power.shape[1]])
    for at, tone in enumerate(whole.tones):
        sine = fit.parameters.traces[..., 3 + 2 * at : 5 + 2 * at]
        turns = np.maximum(np.abs(np.sin(np.pi * tone * n / whole.sample_rate)), 1e-11 * n)  # see `of_tone`
        size = np.hypot(*np.moveaxis(sine, 2, 0)) * whole.sample_rate / turns
        times, share = size / (noise * np.sqrt(2 / n)), size / (np.sqrt(2) * rms)
        if np.max(times) > beyond and not _rings(fit, tone):
            run, channel = np.unravel_index(np.argmax(np.where(times > beyond, share, 0.0)), share.shape)
            count = int(np.count_nonzero(np.any(times > beyond, axis=0)))
            others = f", the largest of {count} channels" * (count > 1)
            yield Finding(
                "tone", Severity.NOTE,
                f"{names[channel]} hums at {tone:.5g} Hz all along, by {100 * share[run, channel]:.2g} % of its rms"
                f"{others}: a steady tone beside what the base moves",
                "it is fitted with the modes, as a sine in each channel; find its source, such as the mains or a fan",
                int(run) + 1, names[channel],
                {"value": tone, "size": float(share[run, channel]), "channels": float(count)},
            )  # fmt: skip


def _rings(fit: RecordFit, tone: float) -> bool:
    """True where a mode within a line of a tone decays so slowly that it rings all along the record, as a tone does."""
    modes, line = fit.parameters.modes, float(np.max(fit.model.whole.spacing))
    f = modes.omega / (2 * np.pi)
    return bool(np.any((np.abs(f - tone) < line) & (2 * modes.ratios * f < line)))


def _of_test(modal: ModalEstimate) -> Iterator[Finding]:
    """One finding of each kind in each channel, the most samples first; none of tones that are fitted."""
    told: dict[str, int] = {}
    test, whole = modal.given, modal.given.whole
    for one in sorted(test.damage, key=lambda one: -one.count):
        near = () if whole is None else np.abs(np.subtract(whole.tones, one.value)) < 2 * whole.spacing.max()
        if one.kind == "tone" and np.any(near):
            continue
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
