"""Tables of an answer for screen, page and summary.json: modes, unknowns, noise, gains, masses at the sensors."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sysid.assessment.checks.model_error import LEVEL
from sysid.assessment.checks.stated import sides_of
from sysid.assessment.uncertainty import Uncertainty
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.delays import Delays
from sysid.modal_analysis.residues import independent
from sysid.modal_analysis.response import misfits, of_residual_modes, records_of, residual_share
from sysid.results.answer import Answer
from sysid.structure.structure import Array, ComplexArray, Structure
from sysid.structure.thresholds import EXACT, LIKELY, ROUND_OFF

FREQUENCY, RATIO = "frequency, Hz", "damping ratio"
MANY = 60  # rows beyond which a terminal shows none


class Row(NamedTuple):
    """A scalar unknown; `std` is NaN where no record sees it, `side` the bound on which it rests, empty for none."""

    label: str
    value: float
    std: float
    unit: str
    lower: float
    upper: float
    side: str

    @property
    def on_bound(self) -> str:
        """Words for the bound on which the value rests: "on its lower bound"; nothing elsewhere."""
        return f"on its {self.side} bound" * bool(self.side)


def stated_values(it: Answer) -> list[str]:
    """Sentences on how far each value that was stated as known is missed."""
    return [f"{name} ends {z:+.2g} standard deviations from the value stated as known" for name, z in it.facts.misses]


def unknown_rows(it: Answer) -> list[Row]:
    """A row a scalar unknown that was searched and means something by itself: see `sysid.results.facts`."""
    if it.x is None:
        return []
    u = it.quick_uncertainty
    known = {} if u is None else u.variables
    rows: list[Row] = []
    for unknown in (one for one in it.facts.unknowns if not (one.fixed or one.is_ratio)):
        values = np.ravel(it.values[unknown.name], order="F")
        std = np.ravel(known.get(unknown.name, np.full(unknown.shape, np.nan)), order="F").tolist()
        units = [unknown.unit] * unknown.size
        bounds = unknown.lower.tolist(), unknown.upper.tolist()
        rows += map(
            Row, unknown.labels, values.tolist(), std, units, *bounds, sides_of(unknown.lower, unknown.upper, values)
        )
    return rows


class SensorGain(NamedTuple):
    """Gain of a sensor against the base's, its standard deviation, and what 1 % of it does to M_SS.

    `worth` is in stated deviations of the diagonal entry that moves by most of them; NaN where there is no noise.
    `delay`, s, was taken off; zero where it is on the base's clock. So was `within`, the relative error that is likely
    within stated tolerances.
    """

    sensor: str
    gain: float
    std: float
    worth: float
    delay: float = 0.0
    delay_std: float = 0.0
    within: float = 0.0

    def to_tree(self) -> dict[str, str | float]:
        """Give the fields by their names, but for what it is worth."""
        return {name: value for name, value in self._asdict().items() if name != "worth"}


def gains_of_sensors(it: Answer) -> tuple[SensorGain, ...]:
    """Gains of the sensors that the records of a fit show; of none where deviations take long or nothing was fitted."""
    if it.quick_uncertainty is None or not it.success or not it.facts.fits_records:
        return ()
    found, names = it.gains, it.measurement.sensor_names
    known = np.isfinite(found.error)
    worth = np.where(np.nan_to_num(found.std) > EXACT, it.gain_worth, np.nan)  # without noise M has no deviation
    late, stated = it.modal[0].delays or Delays.none(it.measurement), it.modal[0].calibration
    within = np.zeros(known.size) if stated is None else stated.seen(it.measurement)
    columns = (1 + found.error, found.std, worth, late.values, late.std, within)
    return tuple(SensorGain(names[i], *(float(one[i]) for one in columns)) for i in np.flatnonzero(known))


class ChannelNoise(NamedTuple):
    """Noise of a channel: deviation of a sample, were it white up to half the sample rate, and its share of the record.

    Both of all runs together, `runs` the least and most of single ones; per cent of the rms of the record at the lines.
    Where errors grow with the signal it is the deviation at a line, all lines together, and `signal` is the share of
    the signal that each line's error holds, in per cent.
    """

    channel: str
    level: float
    unit: str
    percent: float
    runs: tuple[float, float]
    signal: float | None = None

    @property
    def level_in_words(self) -> str:
        """The level; of runs that differ, the least and the most."""
        least, most = self.runs
        return f"{self.level:.3g}" if most < LEVEL * least else f"{least:.3g} to {most:.3g}"

    @property
    def signal_in_words(self) -> tuple[str, ...]:
        """The share of the signal, if there is any, as a cell of a row."""
        return () if self.signal is None else (f"{self.signal:.2g}",)


def noise_columns(it: Answer) -> tuple[str, ...]:
    """Heads of the table of the noise, behind that of the channels."""
    if it.modal[0].shares is None:
        return "of a sample", "unit", "at the lines, % of rms"
    return "of a line", "unit", "at the lines, % of rms", "share of signal, %"


def noise_of_channels(it: Answer) -> tuple[ChannelNoise, ...]:
    """Noise of sensors, base and force, of whole records or where it grows with the signal; none for other records.

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
    power_of_runs = np.sum(np.abs(np.concatenate(spectra, axis=1)) ** 2, axis=2)
    power = power_of_runs.sum(axis=0)
    lines = density * test.own_lines.sum(axis=1)  # of each run
    found = np.concatenate([np.broadcast_to(part, (test.n_runs, part.shape[-1])) for part in level], axis=1)
    rms, std = np.sqrt(power / lines.sum()), np.sqrt(lines @ found**2 / lines.sum())
    percent = 100 * std / np.where(rms > 0, rms, np.inf)
    signal: list[float | None] = [None] * percent.size
    if (shares := it.modal[0].shares) is not None:
        n, d = test.n_sensors, test.n_base
        order = [*range(n), *range(shares.shape[1] - d, shares.shape[1]), *range(n, shares.shape[1] - d)]
        held = np.sum(shares[:, order] ** 2 * power_of_runs, axis=0)  # a direction does not move in all runs
        signal = (100 * np.sqrt(held / np.where(power > 0, power, np.inf))).tolist()
    ends = zip(found.min(axis=0).tolist(), found.max(axis=0).tolist(), strict=True)
    return tuple(
        ChannelNoise(name, float(size), unit, float(share), both, of_signal)
        for (name, unit), size, share, both, of_signal in zip(names, std, percent, ends, signal, strict=True)
    )


class DeckMass(NamedTuple):
    """A mass on a sensor, kg, and its standard deviation; NaN where it is `one_of_many` or not computed."""

    name: str
    mass: float
    std: float
    one_of_many: bool


def deck_masses(it: Answer, most: int = 6) -> tuple[DeckMass, ...]:
    """The diagonal of M_SS of a lumped model, where it has at most so many."""
    n = it.structure.n
    if not it.facts.mass_is_lumped or n > most:
        return ()
    masses, std = np.diag(it.structure.mass)[:n], np.diag(it.quick_std("mass"))[:n]
    many = np.isnan(std) & (it.quick_uncertainty is not None)
    return tuple(map(DeckMass, it.degrees_of_freedom, masses.tolist(), std.tolist(), many.tolist()))


def noise_source(it: Answer) -> str:
    """Source of the levels of noise, in words: stated or found."""
    whole = it.records.measurement.whole
    return "as stated" if whole is not None and whole.noise is not None else "found with the fit"


def half_width(std: float, value: float) -> str:
    """Half of the 95 % interval about `value`; "open" where it is not known, 0 where it is round-off."""
    if not np.isfinite(std):
        return "open"
    return f"{LIKELY * std:.2g}" if std > ROUND_OFF * abs(value) else "0"


def as_known(value: float, std: float, digits: int = 5) -> str:
    """A value to two digits of half of its 95 % interval, and to so many digits at least."""
    if value and np.isfinite(std) and std > ROUND_OFF * abs(value):
        first, last = np.floor(np.log10((abs(value), LIKELY * std)))
        digits = max(digits, int(first - last) + 2)
    return f"{value:.{digits}g}"


def known_half_width(std: float, value: float, sign: str) -> str:
    """`half_width` after a sign; empty where it is not known or round-off."""
    width = half_width(std, value)
    return "" if width in ("open", "0") else f"{sign} {width}"


def tilde(many: ArrayLike) -> str:
    """The mark of a value that is one of many."""
    return "~" if np.any(many) else ""


def counted(number: int, what: str) -> str:
    """A number of things: "1 run", "2 runs"."""
    return f"{number} {what}" + "s" * (number != 1)


def mass_percent_std(it: Answer) -> Array:
    """Standard deviations of `Structure.effective_mass_percent`, (n, d); NaN where open or not computed."""
    rigid = np.diag(it.structure.rigid_body_mass)
    return 100 * np.einsum("kii->ki", it.quick_std("effective_masses")) / np.where(rigid > 0, rigid, np.inf)


def is_one_of_many(it: Answer) -> Array:
    """Which effective masses are one choice among many, (n, d) of bool; a common factor changes none of a sum."""
    unit_sum = it.facts.unit_mass and not it.facts.mass_is_free  # nothing in kg beside what is scaled
    known = it.determined or it.hurried or (unit_sum and it.scale_is_open)
    return np.logical_and(np.isnan(mass_percent_std(it)), not known)


def missing_mass(it: Answer) -> list[str]:
    """Sentence on the rigid-body mass in none of the modes, where it is no round-off of a table."""
    missing, many = 100 - it.structure.effective_mass_percent.sum(axis=0), np.any(is_one_of_many(it), axis=0)
    shares = [
        f"{tilde(one)}{share:.3g} % in {axis}"
        for axis, share, one in zip(it.measurement.base_axes or (), missing, many, strict=True)
        if share > 0.5
    ]
    where = "is in none of these modes: it moves with the base, or in modes beyond the lines"
    return [f"of the rigid-body mass, {', '.join(shares)} {where}"] * bool(shares)


class MassOfModes(NamedTuple):
    """Rigid-body mass in a base direction, and the effective masses of all modes together, one of many or known.

    Both in `unit`, kg or kg m².
    """

    axis: str
    rigid_body: float
    in_modes: float
    one_of_many: bool
    unit: str


def masses_of_modes(it: Answer) -> list[MassOfModes]:
    """Rigid-body mass beside that of the modes, a row a base direction."""
    s, axes = it.structure, it.measurement.base_axes
    both = np.diag(s.rigid_body_mass).tolist(), np.einsum("kii->i", s.effective_masses).tolist()
    units = ["kg m²" if axis.startswith("r") else "kg" for axis in axes]
    return list(map(MassOfModes, axes, *both, map(bool, np.any(is_one_of_many(it), axis=0)), units))


class FitOfChannel(NamedTuple):
    """Shares of what a channel recorded: what the fit leaves of it, and what modes beyond the lines add to it."""

    channel: str
    left: float
    beyond: float


def fit_of_channels(it: Answer) -> list[FitOfChannel]:
    """A row a sensor, by its acceleration relative to the base, and a direction of the base force, where measured."""
    test, s = it.fitted.records, it.structure
    names = (*test.sensor_names, *(f"base force {axis}" for axis in test.base_axes))
    parts = [one for one, _ in records_of(test)], [one for one, _ in misfits(test, s)], of_residual_modes(test, s)
    records, left, added = (np.concatenate(part, axis=1) for part in parts)
    shares = share_of_channels(left, records), share_of_channels(added[:, : records.shape[1]], records)
    return [FitOfChannel(name, *map(float, both)) for name, *both in zip(names, *shares, strict=False)]


def residual_modes(it: Answer) -> list[str]:
    """Sentence on what modes beyond the lines add to the response; nothing without them."""
    if not it.structure.residual.count:
        return []
    test = it.fitted.records
    most = max(fit_of_channels(it)[: test.n_sensors], key=lambda one: np.nan_to_num(one.beyond))
    at = f", most at {most.channel}: {100 * most.beyond:.2g} %" * (test.n_sensors > 1)
    return [f"modes beyond the lines add {100 * residual_share(test, it.structure):.2g} % of the response{at}"]


def share_of_channels(part: ComplexArray, records: ComplexArray) -> Array:
    """Norms of a part over those of the records, channel by channel, (channels,); NaN where nothing was recorded."""
    size = np.linalg.norm(records, axis=(0, 2))
    return np.divide(np.linalg.norm(part, axis=(0, 2)), size, out=np.full_like(size, np.nan), where=size > 0)


def beyond_lines(it: Answer, test: Measurement) -> str:
    """Words for lines of a test that are beyond those that were fitted, with its residual apart; else nothing.

    By more than a line's distance, as lines of records of other lengths differ.
    """
    fitted, f = it.measurement.freq, test.freq
    step = max(float(np.median(np.diff(one))) if one.size > 1 else 0.0 for one in (fitted, f))
    beyond = (f < fitted[0] - step) | (f > fitted[-1] + step)
    if not np.any(beyond):
        return ""
    left, measured = test.predict(it.structure) - test.relative, test.relative
    parts = [("within", ~beyond), ("beyond", beyond)] if not np.all(beyond) else []
    norms = [(name, np.linalg.norm(left[..., at]), np.linalg.norm(measured[..., at])) for name, at in parts]
    apart = ", ".join(f"{100 * missed / size:.3g} % {name}" for name, missed, size in norms if size > 0)
    words = f"{np.count_nonzero(beyond)} of its {f.size} lines are beyond those that were fitted"
    return f"; {words} ({fitted[0]:.4g} to {fitted[-1]:.4g} Hz)" + f", and missed by {apart}" * bool(apart)


def runs_can_be_left_out(it: Answer) -> bool:
    """True where there are several runs, and the others excite what free matrices need without some one of them."""
    base = it.measurement.base
    rank = lambda runs: independent(runs).shape[1]  # noqa: E731
    kept = (base[np.arange(len(base)) != run] for run in range(len(base)))
    return len(base) > 1 and (not it.facts.mass_is_free or any(rank(runs) == rank(base) for runs in kept))


def in_columns(rows: Iterable[Sequence[str]], left: Collection[int] = ()) -> list[str]:
    """Lines of a table, every column as wide as its longest cell: to the right, or to the left those of `left`."""
    cells = list(rows)
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    sides = [f"{'<' if k in left or k - len(widths) in left else '>'}{width}" for k, width in enumerate(widths)]
    return ["  ".join(map(format, row, sides)).rstrip() for row in cells]


def quantities(result: Answer) -> dict[str, float]:
    """Frequencies, damping ratios and unknowns that mean something by themselves, by label; none fixed ones.

    Damping ratios are none of them where nothing that is fitted tells of the damping.
    """
    s, values = result.structure, result.values
    free = [v.name for v in result.facts.unknowns if not (v.fixed or v.is_ratio) and v.name in values]
    changes = {name: value for name, (value, _) in changes_by_laws(s).items()}
    return labelled(s.natural_frequencies, result.identified_ratios, {name: values[name] for name in free}) | changes


def linear_deviations(result: Answer, u: Uncertainty) -> dict[str, float]:
    """Standard deviations of `quantities`, by label."""
    of_laws = {name: std for name, (_, std) in changes_by_laws(result.structure).items()}
    return labelled(u.natural_frequencies, u.damping_ratios, u.variables) | of_laws


def changes_by_laws(structure: Structure) -> dict[str, tuple[float, float]]:
    """Relative change of frequency, and change of damping ratio, of modes over the levels of their laws, by label.

    Each with its standard deviation.
    """
    names = "change of frequency with amplitude", "change of damping ratio with amplitude"
    return {
        label(law.mode, name): (value, std)
        for law in structure.laws
        for name, value, std in zip(names, *law.change(), strict=True)
    }


def labelled(frequencies: Array, ratios: Array, unknowns: dict[str, Array]) -> dict[str, float]:
    """All numbers by their names, entries of an unknown from 1, column by column; without ratios that are NaN."""
    by_label = {label(i, FREQUENCY): float(f) for i, f in enumerate(frequencies)}
    by_label |= {label(i, RATIO): float(ratio) for i, ratio in enumerate(ratios) if not np.isnan(ratio)}
    for name, value in unknowns.items():
        entries = np.ravel(value, order="F").tolist()
        by_label |= {name if len(entries) == 1 else f"{name} {i + 1}": entry for i, entry in enumerate(entries)}
    return by_label


def label(mode: int, what: str) -> str:
    """Name of a mode's quantity; modes are counted from 0 here, and from 1 there."""
    return f"mode {mode + 1}: {what}"
