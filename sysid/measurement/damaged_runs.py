"""Damaged samples of a test: runs are cut where they last a short time, long clipping is refused, all are told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sysid.errors import InputError
from sysid.measurement.damaged_samples import DamagedSamples, damaged_samples
from sysid.measurement.spectra import TimeRun, of_run
from sysid.measurement.whole import NoiseLevels
from sysid.structure.sensor import Sensor, axes_of_base
from sysid.structure.structure import Array

_MADE_BY = {
    "clipped": "hold its largest value, {value:.4g}: a range that was too small",
    "dropout": "are zero while the other channels move: a gap",
    "held value": "hold one value, {value:.4g}, while the other channels move",
    "spikes": "stand out of those around them, by up to {value:.4g}: spikes",
}
_REMEDIES = {
    "tone": "it stays in these records: take whole records, which fit it, or find its source, such as the mains",
    "equal channels": "it may be so by symmetry; else read the right one, or leave this channel out",
}


@dataclass(frozen=True, eq=False)
class DamagedChannel:
    """Damage of one kind in one channel of a run as it was recorded.

    Attributes
    ----------
    kind : str
        "clipped", "dropout", "held value", "spikes", "tone" or "equal channels".
    run : int
        From 1, of the runs that were given.
    channel : str
    stretches : (k, 2)
        Times of the first and the last sample of each, s.
    count, samples : int
        Samples that are damaged, and of the run.
    value : float
        As in `DamagedSamples`; of a tone Hz.
    other : str
        The channel with the same samples.
    left_out : bool
        True where the run was cut there.
    """

    kind: str
    run: int
    channel: str
    stretches: Array
    count: int
    samples: int
    value: float
    other: str = ""
    left_out: bool = False

    @property
    def is_local(self) -> bool:
        """True of damage in some places, between which a run may be cut."""
        return self.kind not in ("tone", "equal channels")

    def is_refused(self, share: float = 0.01) -> bool:
        """True of clipping that is not left out, of more than this share of a channel's samples.

        Flat tops of so many samples, at 2.6 deviations of a Gaussian record, take 4 % of its rms. All else may be
        sound: channels are equal by symmetry, and stand still where nothing moves them.
        """
        return self.kind == "clipped" and not self.left_out and self.count > share * self.samples

    @property
    def sentence(self) -> str:
        """Channel, place, count and kind in words."""
        if self.kind == "tone":
            return f"{self.channel} hums at {self.value:.5g} Hz all along: a steady tone that no other channel has"
        if self.kind == "equal channels":
            return f"{self.channel} holds the same samples as {self.other}: one record stands in two places"
        first, last = self.stretches[0, 0], self.stretches[-1, 1]
        share = f"{self.count} of {self.samples} samples ({100 * self.count / self.samples:.2g} %)"
        several = f" in {len(self.stretches)} places" if len(self.stretches) > 1 else ""
        made_by = _MADE_BY[self.kind].format(value=self.value)
        return f"{self.channel} is damaged: {share}{several} from {first:.5g} to {last:.5g} s {made_by}"

    @property
    def remedy(self) -> str:
        """What was done about it, or is to be done."""
        if self.left_out:
            return "the run is cut there, and what is damaged left out"
        return _REMEDIES.get(self.kind, "leave this channel out, cut the record there, or record it anew")


@dataclass(frozen=True, eq=False)
class SoundRuns:
    """Runs of a test as they are taken.

    Attributes
    ----------
    runs : list of TimeRun
        Those with short damage are cut in pieces.
    damage : tuple of DamagedChannel
    source : tuple of int
        Of which run, from 0, each is a piece, or all.
    cut : tuple of bool
        Which of the runs that were given are cut.
    """

    runs: list[TimeRun]
    damage: tuple[DamagedChannel, ...]
    source: tuple[int, ...]
    cut: tuple[bool, ...]

    def rests(self, at_rest: Any) -> Any:
        """Which runs begin and end at rest, of those given: pieces do not."""
        if not any(self.cut):
            return at_rest
        each = [at_rest] * len(self.cut) if isinstance(at_rest, bool | np.bool_) else at_rest
        if np.shape(each) != (len(self.cut),):
            return at_rest  # which is refused
        return [False if self.cut[run] else each[run] for run in self.source]

    def levels(self, noise: NoiseLevels | None) -> NoiseLevels | None:
        """Levels of noise of each run, of those of the runs that were given."""
        if noise is None or not any(self.cut):
            return noise
        levels = {name: part for name, part in vars(noise).items() if part is not None}
        by_run = {name for name, part in levels.items() if part.ndim == 2 and len(part) == len(self.cut)}
        return NoiseLevels(**{
            name: part[list(self.source)] if name in by_run else part for name, part in levels.items()
        })  # fmt: skip


def sound_runs(runs: Sequence[TimeRun], rate: float, names: Sequence[str], delays: Array, *, cut: bool) -> SoundRuns:
    """Look for damage in the runs of a test.

    Parameters
    ----------
    runs : sequence of TimeRun
    rate : float
        Hz.
    names : sequence of str
        Of base, sensors and force, in this order.
    delays : (k,)
        s, by which channels are shifted afterwards.
    cut : bool
        Whether a run may be cut where samples are damaged.

    Raises
    ------
    InputError
        More than a hundredth of a channel's samples are clipped, and cannot be left out.
    """
    taken: list[TimeRun] = []
    source: list[int] = []
    cuts: list[bool] = []
    damage = damage_of_runs(runs, rate, names)
    for index, run in enumerate(runs):
        its = [one for one in damage if one.run == index + 1]
        pieces = _pieces(its, rate, run.base.shape[1], delays) if cut else []
        cuts.append(bool(pieces))
        parts = [
            TimeRun(run.base[:, a:b], run.response[:, a:b], None if run.force is None else run.force[:, a:b])
            for a, b in pieces
        ]
        taken += parts or [run]
        source += [index] * max(len(parts), 1)
    told = tuple(replace(one, left_out=one.is_local and cuts[one.run - 1]) for one in damage)
    refused = [one for one in told if one.is_refused()]
    if refused:
        raise InputError(
            "; ".join(f"{one.sentence}{of_run(one.run - 1, len(runs))}; {one.remedy}" for one in refused[:3])
        )
    return SoundRuns(taken, told, tuple(source), tuple(cuts))


def damage_of_runs(runs: Sequence[TimeRun], rate: float, names: Sequence[str]) -> list[DamagedChannel]:
    """Damage of the runs of a test, at `rate` Hz, with the names of base, sensors and force."""
    return [
        _told(one, names, run, number, rate)
        for number, run in enumerate(runs, start=1)
        for one in damaged_samples(np.vstack([run.base, run.outputs]), len(run.base))
    ]


def _told(one: DamagedSamples, names: Sequence[str], run: TimeRun, number: int, rate: float) -> DamagedChannel:
    value = one.value * rate if one.kind == "tone" else one.value
    other = names[int(one.value)] if one.kind == "equal channels" else ""
    samples = run.base.shape[1]
    return DamagedChannel(one.kind, number, names[one.channel], one.stretches / rate, one.count, samples, value, other)


def _pieces(
    damage: Sequence[DamagedChannel], rate: float, samples: int, delays: Array, piece: float = 0.1, kept: float = 0.75
) -> list[tuple[int, int]]:
    """First sample, and that after the last, of pieces between what is damaged; none where too little would be left.

    A `piece` has such a share of the run at least, and four times the samples that it loses where channels are shifted
    by their delays; all together have what is `kept`.
    """
    stretches = [np.round(one.stretches * rate).astype(int) for one in damage if one.is_local]
    if not stretches:
        return []
    at = np.concatenate(stretches)
    bad = np.zeros(samples + 1, dtype=int)
    np.add.at(bad, at[:, 0], 1)
    np.add.at(bad, at[:, 1] + 1, -1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], np.cumsum(bad)[:-1] == 0, [False]]))).reshape(-1, 2)
    lost = 64 * bool(np.any(delays)) + np.ptp(np.append(delays, 0.0)) * rate  # to interpolate, and to shift
    long = edges[edges[:, 1] - edges[:, 0] >= max(piece * samples, 4 * lost)]
    enough = np.sum(long[:, 1] - long[:, 0]) >= kept * samples
    return [(int(a), int(b)) for a, b in long] if enough else []


def names_of_channels(
    sensors: Sequence[Sensor] | None, rigid_body: Array, base_axes: str | Sequence[str] | None
) -> tuple[str, ...]:
    """Names of base, sensors and force, as findings call them."""
    axes = axes_of_base(base_axes, sensors or (), rigid_body)
    return (
        *(f"base {axis}" for axis in axes),
        *(sensor.name for sensor in sensors or ()),
        *(f"sensor {i + 1}" for i in range(len(rigid_body) if sensors is None else 0)),
        *(f"force {axis}" for axis in axes),
    )
