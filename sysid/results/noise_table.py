"""The noise of each channel of whole records, for summary, summary.json and report."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sysid.assessment.checks.model_error import LEVEL
from sysid.results.answer import Answer


class ChannelNoise(NamedTuple):
    """Noise of a channel: deviation of a sample, were it white up to half the sample rate, and its share of the record.

    Both of all runs together, `runs` the least and most of single ones; per cent of the rms of the record at the lines.
    """

    channel: str
    level: float
    unit: str
    percent: float
    runs: tuple[float, float]

    @property
    def level_in_words(self) -> str:
        """The level; of runs that differ, the least and the most."""
        least, most = self.runs
        return f"{self.level:.3g}" if most < LEVEL * least else f"{least:.3g} to {most:.3g}"


NOISE_COLUMNS = "of a sample", "unit", "at the lines, % of rms"


def noise_of_channels(it: Answer) -> tuple[ChannelNoise, ...]:
    """Noise of sensors, base and force of whole records; none for other records.

    Per cent are of what the channel records over the lines of the test, noise and all, so that a band makes both alike.
    """
    levels, test, density = it.noise, it.records.measurement, it.modal[0].density
    if levels is None:
        return ()
    axes = test.base_axes or ()
    turns = ["r" in axis for axis in axes]
    names = [(name, "m/s²") for name in test.sensor_names]
    names += [(f"base {axis}", "rad/s²" if turn else "m/s²") for axis, turn in zip(axes, turns, strict=True)]
    spectra, level = [test.response, test.base], [levels.response, levels.base]
    if test.force is not None and levels.force is not None:
        names += [(f"force {axis}", "N m" if turn else "N") for axis, turn in zip(axes, turns, strict=True)]
        spectra, level = [*spectra, test.force], [*level, levels.force]
    power = np.sum(np.abs(np.concatenate(spectra, axis=1)) ** 2, axis=(0, 2))
    lines = density * test.own_lines.sum(axis=1)  # of each run
    found = np.concatenate([np.broadcast_to(part, (test.n_runs, part.shape[-1])) for part in level], axis=1)
    rms, std = np.sqrt(power / lines.sum()), np.sqrt(lines @ found**2 / lines.sum())
    percent = 100 * std / np.where(rms > 0, rms, np.inf)
    ends = zip(found.min(axis=0).tolist(), found.max(axis=0).tolist(), strict=True)
    return tuple(
        ChannelNoise(name, float(size), unit, float(share), both)
        for (name, unit), size, share, both in zip(names, std, percent, ends, strict=True)
    )
