"""Damaged samples of a test: runs are cut where they last a short time, long ones are refused, all are told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sysid.errors import InputError
from sysid.measurement.damaged_samples import DamagedSamples, damaged_samples
from sysid.measurement.spectra import TimeRun, of_run
from sysid.measurement.whole import NoiseLevels
from sysid.structure.sensor import Sensor, axes_of_base
from sysid.structure.structure import Array

_LONG = 0.01  # of a channel's samples: at 2.6 deviations of a Gaussian record flat tops take off 4 % of its rms
_PIECE = 0.1  # of a run, that a piece of it holds at least
_KEPT = 0.75  # of a run, that its pieces hold at least together

_MADE_BY = {
    "clipped": "hold its largest value, {value:.4g}: a range that was too small",
    "dropout": "are zero while the other channels move: a gap",
    "held value": "hold one value, {value:.4g}, while the other channels move",
    "spikes": "stand out of those around them, by up to {value:.4g}: spikes",
}
REMEDY = "leave this channel out, cut the record there, or record it anew"


@dataclass(frozen=True, eq=False)
class DamagedChannel:
    """Damage of one kind in one channel of a run as it was recorded.

    Attributes
    ----------
    kind : str
        "clipped", "dropout", "held value", "spikes" or "tone".
    run : int
        From 1, of the runs that were given.
    channel : str
    stretches : (k, 2)
        Times of the first and the last sample of each, s.
    count, samples : int
        Samples that are damaged, and of the run.
    value : float
        As in `DamagedSamples`; of a tone Hz.
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
    left_out: bool = False

    @property
    def sentence(self) -> str:
        """Channel, place, count and kind in words."""
        if self.kind == "tone":
            return f"{self.channel} hums at {self.value:.5g} Hz all along: a steady tone that no other channel has"
        first, last = self.stretches[0, 0], self.stretches[-1, 1]
        share = f"{self.count} of {self.samples} samples ({100 * self.count / self.samples:.2g} %)"
        several = f" in {len(self.stretches)} places" if len(self.stretches) > 1 else ""
        made_by = _MADE_BY[self.kind].format(value=self.value)
        return f"{self.channel} is damaged: {share}{several} from {first:.5g} to {last:.5g} s {made_by}"

    def to_tree(self) -> dict[str, Any]:
        """Give the fields by their names; `from_tree` takes them back."""
        return dict(vars(self))

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> DamagedChannel:
        """Give what a tree of `to_tree` stands for."""
        return cls(**tree)


@dataclass(frozen=True, eq=False)
class SoundRuns:
    """Runs of a test as they are taken.

    Attributes
    ----------
    runs : list of TimeRun
        Those with short damage are cut in pieces.
    damage : tuple of DamagedChannel
    source : tuple of int
        Of which run, from 0, each is a piece.
    """

    runs: list[TimeRun]
    damage: tuple[DamagedChannel, ...]
    source: tuple[int, ...]

    def rests(self, at_rest: Any) -> Any:
        """Which runs begin and end at rest, of those given: pieces do not."""
        if isinstance(at_rest, bool | np.bool_):
            at_rest = [bool(at_rest)] * len(set(self.source))
        if len(self.source) == len(set(self.source)) or np.shape(at_rest) != (len(set(self.source)),):
            return at_rest
        return [at_rest[run] if self.source.count(run) == 1 else False for run in self.source]

    def levels(self, noise: NoiseLevels | None) -> NoiseLevels | None:
        """Levels of noise of each run, of those of the runs that were given."""
        if noise is None or noise.base.ndim == 1 or len(noise.base) != len(set(self.source)):
            return noise
        rows = {name: part[list(self.source)] for name, part in vars(noise).items() if part is not None}
        return NoiseLevels(**rows)


def sound_runs(runs: Sequence[TimeRun], rate: float, names: Sequence[str], *, cut: bool) -> SoundRuns:
    """Look for damage in the runs of a test.

    Parameters
    ----------
    runs : sequence of TimeRun
    rate : float
        Hz.
    names : sequence of str
        Of base, sensors and force, in this order.
    cut : bool
        Whether a run may be cut where samples are damaged.

    Raises
    ------
    InputError
        Two channels are equal; damage of more than a hundredth of a channel's samples cannot be left out.
    """
    taken: list[TimeRun] = []
    told: list[DamagedChannel] = []
    source: list[int] = []
    for index, run in enumerate(runs):
        records = np.vstack([run.base, run.outputs])
        found = damaged_samples(records, len(run.base))
        where = of_run(index, len(runs))
        _refuse_equal(found, names, where)
        pieces = _pieces(found, records.shape[1]) if cut else []
        damage = [_told(one, names, index, rate, records.shape[1], bool(pieces)) for one in found]
        long = [one for one in damage if one.count > _LONG * one.samples and not one.left_out and one.kind != "tone"]
        if long:
            raise InputError("; ".join(f"the record{where} of {one.sentence}: {REMEDY}" for one in long[:3]))
        parts = [
            TimeRun(run.base[:, a:b], run.response[:, a:b], None if run.force is None else run.force[:, a:b])
            for a, b in pieces
        ]
        taken += parts or [run]
        told += damage
        source += [index] * max(len(parts), 1)
    return SoundRuns(taken, tuple(told), tuple(source))


def _refuse_equal(found: Sequence[DamagedSamples], names: Sequence[str], where: str) -> None:
    """Refuse channels that hold the same samples."""
    pairs = [(names[int(one.value)], names[one.channel]) for one in found if one.kind == "equal channels"]
    if pairs:
        words = "; ".join(f"{a} and {b} hold the same samples{where}" for a, b in pairs[:3])
        raise InputError(
            f"{words}: one record stands in two places; read the right one, or leave it out"
        )


def _told(one: DamagedSamples, names: Sequence[str], run: int, rate: float, samples: int, cut: bool) -> DamagedChannel:
    tone = one.kind == "tone"
    value = one.value * rate if tone else one.value
    return DamagedChannel(
        one.kind, run + 1, names[one.channel], one.stretches / rate, one.count, samples, value, cut and not tone
    )


def _pieces(found: Sequence[DamagedSamples], samples: int) -> list[tuple[int, int]]:
    """First sample, and that after the last, of pieces between what is damaged; none where too little would be left."""
    stretches = [one.stretches for one in found if one.kind not in ("tone", "equal channels")]
    if not stretches:
        return []
    at = np.concatenate(stretches)
    bad = np.zeros(samples + 1, dtype=int)
    np.add.at(bad, at[:, 0], 1)
    np.add.at(bad, at[:, 1] + 1, -1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], np.cumsum(bad)[:-1] == 0, [False]]))).reshape(-1, 2)
    kept = edges[edges[:, 1] - edges[:, 0] >= _PIECE * samples]
    enough = np.sum(kept[:, 1] - kept[:, 0]) >= _KEPT * samples
    return [(int(a), int(b)) for a, b in kept] if enough else []


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
