"""Laws by which modes follow their amplitude, fitted to whole records with all else: exponents by likelihood."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from sysid.errors import InputError, Stop
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.law_spectra import LawMotions
from sysid.modal_analysis.least_squares import half_inverse, unit_diagonal
from sysid.modal_analysis.misfit import at_lines, left_of
from sysid.modal_analysis.modal_fit import Modes, modes_within
from sysid.modal_analysis.modal_model import ModeLaw, Parameters
from sysid.modal_analysis.model_order import least_worth, peaks_of, with_peaks
from sysid.modal_analysis.record_fit import ROUGH, TRIAL, WHOLE, Limits, RecordFit, as_one, refitted, rough_levels
from sysid.modal_analysis.residues import line_correlation
from sysid.structure.amplitude import MOST_DAMPED, OF_DAMPING, OF_FREQUENCY, AmplitudeLaw, FittedLaw, LawForm
from sysid.structure.structure import Array
from sysid.structure.thresholds import ROUND_OFF, beyond_chance


def with_laws(
    fit: RecordFit, stated: AmplitudeLaw, *, monitor: FitMonitor, much: float = 0.1,
    noise: float = 0.03, tries: tuple[float, ...] = (0.0, 0.03), probe: bool = False,
) -> RecordFit:  # fmt: skip
    """The fit with laws of the stated modes, numbered from 1 by frequency within the lines; `left_out` are the others.

    Laws come mode by mode, each of exponents of its own. One that the likelihood takes stands in the fit as the next is
    tried; one that it does not is left out of it. "auto" goes on from the first mode where that has a law.

    Where the linear model misses more than `noise` may, what it misses passes for noise of the base, which then
    explains any law: squares are fitted, the base as recorded, and noise comes back at the end, where laws leave less
    than `much` and no more with it. Laws begin at these falls of the frequency at the highest level. A `probe` ends
    where the first law leaves `much`.

    Raises
    ------
    InputError
        Where there is no such mode.
    """
    best = fit
    try:
        with monitor.at_work():
            monitor.keep_instead(fit)
            for best in _stages(fit, stated, monitor, much, noise, tries):
                if probe and left_of(best) > much:
                    break
    except (Stop, KeyboardInterrupt):
        return replace(best, stopped=True)
    return best


def _stages(
    fit: RecordFit, stated: AmplitudeLaw, monitor: FitMonitor, much: float, noise: float, tries: tuple[float, ...]
) -> Iterator[RecordFit]:
    """The fit with laws that are likelier than none, from stage to stage; the fit itself as long as there are none."""
    whole = fit.model.whole
    plain = left_of(fit) > noise or whole.plain
    varying = None if plain else whole.varying
    linear = replace(fit, test=replace(fit.test, whole=replace(whole, plain=plain, varying=varying)))
    if plain:
        monitor.doing = "least squares"
        linear = refitted(linear, linear.parameters, monitor=monitor)
        while np.any(flat := _without_peak(linear)):  # what it explains a law is to explain
            linear = refitted(linear, linear.parameters.at(~flat), monitor=monitor)
    modes, best = _modes_of(linear, stated), linear
    if fit.parameters.coupling is not None:  # dampers may couple modes, or what changes passes for it
        best = refitted(linear, replace(linear.parameters, coupling=None), limits=ROUGH, monitor=monitor)
    limits = ROUGH if plain else WHOLE  # squares of what a model misses fall slowly at last, by what tells no exponent
    left_out, hidden = list[FittedLaw](), False  # a first law, by what other modes change, which squares are judged by
    for omega in linear.parameters.modes.omega[modes]:
        found, others = best, bool(best.parameters.laws)
        for found in _with_law_of(best, omega, stated.exponents, tries, limits, monitor):
            found = _judged(found, [best if others else linear])
            if found.parameters.laws[-1].likelier and not hidden:
                yield replace(found, left_out=tuple(left_out))
            elif stated.modes == "auto" and others and not found.parameters.laws[-1].likelier:
                break  # no exponents make a law of what gains nothing with the first
        if others and not best.settled:  # a law's many steps gain by all else too
            found = _judged(found, [max(best, _without(found, -1, limits, monitor), key=lambda one: one.likelihood)])
        law = fitted_laws(found)[-1]
        hidden |= (hides := plain and not (others or law.is_certain) and found.schwarz > linear.schwarz)
        if law.is_certain or hides:
            best = found
        else:
            left_out.append(law)
            yield replace(best if others and not hidden else fit, left_out=tuple(left_out))
        none_left = not np.any(_without_law(best))  # where others became one with a mode that has a law
        if none_left or (stated.modes == "auto" and not best.parameters.laws):
            break
    if plain and best.parameters.laws:
        best = _with_hidden_modes(best, monitor)
        if left_of(best) < much:
            monitor.doing, most = "noise of all channels", 1.1 * left_of(best)
            noisy = _with_noise(best, _with_equivalents(best), ROUGH, monitor)
            if left_of(noisy) < most:  # else noise of the base takes what laws miss: asked again at the end
                noisy = refitted(noisy, _with_equivalents(noisy), limits=WHOLE, monitor=monitor)
            if left_of(noisy) < most:
                best, linear = noisy, _with_noise(noisy, linear.parameters, TRIAL, monitor)
                if not fit.model.whole.plain:  # what it explains by noise of the base may have taken many steps
                    linear = max(linear, fit, key=lambda one: one.likelihood)
    if plain or len(best.parameters.laws) > 1:
        best, gone = _holding(best, linear, limits if best.model.whole.plain else WHOLE, monitor)
        left_out += gone
    yield replace(best if best.parameters.laws else fit, left_out=tuple(left_out))


def _with_hidden_modes(fit: RecordFit, monitor: FitMonitor, reach: float = 0.2) -> RecordFit:
    """The fit with further modes that what a linear model missed had hidden, farther from all than laws move modes."""
    while True:
        omega = fit.parameters.modes.omega
        peaks = peaks_of(fit, least_worth(fit.model))
        peaks = [one for one in peaks if np.min(np.abs(np.log(omega / one.omega))) > reach]
        more = with_peaks(fit, peaks[:1], None, monitor)
        if more is None or not _is_likelier(more, fit, more.model.unknowns - fit.model.unknowns):
            return refitted(fit, _with_equivalents(fit), limits=TRIAL, monitor=monitor)
        fit = more


def _with_noise(fit: RecordFit, p: Parameters, limits: Limits, monitor: FitMonitor) -> RecordFit:
    """The fit from these parameters in place of squares with noise of all channels."""
    noisy = replace(fit, test=replace(fit.test, whole=replace(fit.model.whole, plain=False)))
    return refitted(replace(noisy, levels=rough_levels(noisy.model_of(p), p)), p, limits=limits, monitor=monitor)


def _with_law_of(
    best: RecordFit, omega: float, exponents: tuple[float, float] | Literal["auto"], tries: tuple[float, ...],
    limits: Limits, monitor: FitMonitor,
) -> Iterator[RecordFit]:  # fmt: skip
    """The fit with a law of one more mode, of this frequency, likelier from one to the next."""
    monitor.doing = which = f"a law of amplitude near {omega / (2 * np.pi):.3g} Hz"
    before = best.parameters.laws[-1].form[:2] if best.parameters.laws else (OF_FREQUENCY[0], OF_DAMPING[0])
    first = before if exponents == "auto" else exponents
    started: list[RecordFit] = []
    for begun in _beginnings(best, omega, monitor):
        for falls in ((), tries)[not best.parameters.laws :]:  # without falls as the first law, where there is one
            started.append(_started(*begun, first, falls, limits, monitor))
        if max(one.schwarz for one in started) > best.schwarz:
            break
    best = _without_doubles(max(started, key=lambda one: one.schwarz), limits, monitor)
    yield best
    alone = best.parameters.laws[-1].level_of is None  # what follows another changes by the same cause
    for number, each in enumerate((OF_FREQUENCY, OF_DAMPING) if exponents == "auto" and alone else ()):
        for exponent in (one for one in each if one != first[number]):
            monitor.doing = f"{which}, exponent {exponent:g} {LawForm._fields[number].replace('_', ' ')}"
            found = refitted(best, _with_exponent(best, number, exponent), limits=limits, monitor=monitor)
            best = max(best, found, key=lambda one: one.likelihood)
        best = _without_doubles(best, limits, monitor)
        yield best


def _without_peak(fit: RecordFit) -> NDArray[np.bool_]:
    """True of modes in the lines that are damped too much to show in them, (m,); of none where all are."""
    modes = fit.parameters.modes
    damped = (modes.ratios > MOST_DAMPED) & (modes.omega < 2 * np.pi * fit.test.freq[-1])
    return damped & ~np.all(damped)


def _without_doubles(fit: RecordFit, limits: Limits, monitor: FitMonitor) -> RecordFit:
    """The fit without modes of the shape of the last that has a law, where they stood for what the law explains."""
    number = fit.parameters.laws[-1].mode
    for k in np.flatnonzero(_without_law(fit) & _like(fit.parameters.modes, number))[::-1]:
        fewer = refitted(fit, fit.parameters.at(np.arange(fit.model.m) != k), limits=limits, monitor=monitor)
        fit = fit if _is_likelier(fit, fewer, fit.model.unknowns - fewer.model.unknowns) else fewer
    return fit


def _judged(fit: RecordFit, others: Sequence[RecordFit]) -> RecordFit:
    """The fit, whose last laws are told to be likelier than the fits without each of them, or not, beyond chance."""
    p, first = fit.parameters, len(fit.parameters.laws) - len(others)
    laws = list(p.laws[:first])
    for law, without in zip(p.laws[first:], others, strict=True):
        laws.append(law._replace(likelier=_is_likelier(fit, without, law.form.size)))
    return replace(fit, parameters=replace(p, laws=tuple(laws)))


def _is_likelier(fit: RecordFit, without: RecordFit, freedom: int) -> bool:
    """True of a fit that is likelier than one without so many of its numbers, beyond chance.

    Squares take the base as exact, and what its noise does at a few lines near a peak passes for what a law does: there
    the gain must also be beyond its scatter from line to line (Vuong, Econometrica 57 (1989) 307-333).
    """
    gained = 2 * (fit.likelihood - without.likelihood) / _shared(fit)
    likelier = gained > beyond_chance(freedom, len(OF_FREQUENCY) + len(OF_DAMPING))
    if likelier and fit.model.whole.plain:
        each = _of_lines(fit) - _of_lines(without)
        likelier = float(np.sum(each) ** 2 / np.sum(each**2)) > beyond_chance(1)
    return bool(likelier)


def _holding(
    best: RecordFit, linear: RecordFit, limits: Limits, monitor: FitMonitor
) -> tuple[RecordFit, list[FittedLaw]]:
    """The fit with those of its laws that hold beside the others, each against the fit without it alone; the others."""
    gone: list[FittedLaw] = []
    while count := len(best.parameters.laws):
        monitor.doing = "laws of amplitude, each left out"
        others = [linear] if count == 1 else [_without(best, k, limits, monitor) for k in range(count)]
        best = _judged(best, others)
        laws = fitted_laws(best)
        doubtful = [k for k in range(count) if not laws[k].is_certain]
        if not doubtful:
            break
        gone.append(laws[doubtful[-1]])
        best = others[doubtful[-1]]
    return best, gone


def _without(fit: RecordFit, number: int, limits: Limits, monitor: FitMonitor) -> RecordFit:
    """The fit without one of its laws, from what its mode is at the mean of the runs."""
    p = _with_equivalents(fit)
    law, followed = p.laws[number], np.arange(fit.model.m) == p.laws[number].mode
    by = np.where(followed, law.equivalent.mean(axis=0)[:, None], 1.0)
    modes = p.modes._replace(omega=p.modes.omega * by[0], ratios=p.modes.ratios * by[1])
    ends = np.where(followed[:, None], 0.0, p.ends)  # of a mode without a law they are no state
    p = replace(p, modes=modes, ends=ends, laws=tuple(one for one in p.laws if one is not law))
    return refitted(fit, p, limits=limits, monitor=monitor)


def _of_lines(fit: RecordFit) -> Array:
    """Twice the logarithm of the likelihood of each line of squares, (lines,)."""
    found = []
    for chunk in fit.model.chunks(fit.parameters):
        spread = np.sum(np.log(chunk.run.variances(fit.levels)[: fit.model.channels]), axis=0)
        found.append(-2 * (chunk.weighed(fit.levels).power + spread))
    return np.concatenate(found)


def _modes_of(fit: RecordFit, stated: AmplitudeLaw) -> list[int]:
    """Numbers of the modes that are to have a law among those of a fit; of several that are one mode, the first."""
    modes, found = fit.parameters.modes, list[int]()
    inside = modes_within(modes.omega, 2 * np.pi * fit.test.freq[[0, -1]], np.zeros(0))
    for k in np.argsort(modes.omega, kind="stable").tolist():
        if inside[k] and not np.any(_like(modes, k)[found]):
            found.append(k)
    numbers = range(1, len(found) + 1) if stated.modes == "auto" else stated.modes
    if max(numbers, default=1) > len(found):
        raise InputError(
            f"AmplitudeLaw: mode {max(numbers, default=1)} is to follow its amplitude, and the records show "
            f"{len(found)} modes within their lines: state the number of one of these"
        )
    return [found[number - 1] for number in numbers]


def _like(modes: Modes, k: int, assurance: float = 0.9, reach: float = 0.2) -> NDArray[np.bool_]:
    """True of modes that may be mode k at other levels, (m,), itself too: of its shape, within what a law may move.

    A linear fit shows a mode that changes once for each level, or twice near one frequency. The reach is wider than
    that of the check of stretches (`ObservedPoles`): here the likelihood has the last word, there none has.
    """
    near = np.abs(np.log(modes.omega / modes.omega[k])) < reach
    if len(modes.phi) == 1:  # all are of one shape
        return np.arange(near.size) == k
    size = np.sum(modes.phi**2, axis=0)
    return near & ((modes.phi.T @ modes.phi[:, k]) ** 2 >= assurance * size * size[k])


def _beginnings(fit: RecordFit, omega: float, monitor: FitMonitor) -> list[tuple[RecordFit, int]]:
    """Fits to which a law of the mode nearest to a frequency is added, and its number there.

    Where it shows at several levels, first with all these as one mode.
    """
    p, free = fit.parameters, _without_law(fit)
    k = int(np.argmin(np.where(free, np.abs(p.modes.omega - omega), np.inf)))
    like = free & _like(p.modes, k)
    if np.count_nonzero(like) == 1:
        return [(fit, k)]
    once = refitted(fit, as_one(fit, like, k), limits=ROUGH, monitor=monitor)
    return [(once, int(np.count_nonzero(~like[:k]))), (fit, k)]


def _without_law(fit: RecordFit) -> NDArray[np.bool_]:
    """True of modes that have no law yet, (m,)."""
    return ~np.isin(np.arange(fit.model.m), [law.mode for law in fit.parameters.laws])


def _started(
    fit: RecordFit, mode: int, exponents: tuple[float, float], tries: tuple[float, ...], limits: Limits,
    monitor: FitMonitor,
) -> RecordFit:  # fmt: skip
    """A law more of these exponents, from the first of some falls of the frequency that settles, else the likeliest.

    Without falls, one that follows the level of the first law, and changes as that does.
    """
    p, found, followed = fit.parameters, [], np.arange(fit.model.m) == mode
    ends = np.where(followed[:, None], 0.0, p.ends)  # of a mode with a law they are its first state
    ones = np.ones((fit.test.n_runs, 2))
    if tries:
        law = ModeLaw(mode, int(np.argmax(np.abs(p.modes.phi[:, mode]))), LawForm(*exponents, 1.0), np.zeros(2), ones)
        law = _of_highest_level(law, _in_runs(fit, replace(p, ends=ends), law)[0])
    else:
        law = p.laws[0]._replace(mode=mode, equivalent=ones, likelier=False, level_of=p.laws[0].followed)
    for values in [np.array([fall, 0.0]) for fall in tries] or [law.values, 0 * law.values]:
        law = law._replace(values=values)
        modes = p.modes._replace(omega=p.modes.omega * np.where(followed, 1 + values[0] / 2, 1.0))
        begun = replace(p, modes=modes, ends=ends, laws=(*p.laws, law))
        found.append(refitted(fit, begun, limits=ROUGH, monitor=monitor))
        if found[-1].settled and (tries or found[-1].likelihood > fit.likelihood):
            break
    best = max(found, key=lambda one: one.likelihood)
    return refitted(best, _with_equivalents(best), limits=limits, monitor=monitor)


def _with_exponent(fit: RecordFit, number: int, exponent: float) -> Parameters:
    """The parameters with another exponent of the last law, by its number in the form, for what it said at two levels.

    One is exceeded most of the time, one hardly ever: from other values damping may be zero at all low levels, where
    no step shows.
    """
    p = _with_equivalents(fit)
    law, omega, ratios = p.laws[-1], p.modes.omega.copy(), p.modes.ratios.copy()
    unit = np.quantile(np.concatenate(_in_runs(fit, p, law)[0]), (0.3, 0.95)) / law.form.level
    values, pole = law.values.copy(), [1.0, 1.0]
    before, after = unit ** law.form[number], unit**exponent
    values[number] *= (before[1] - before[0]) / (after[1] - after[0])
    beside = law.values[number] * before[1] - values[number] * after[1]  # what is left is of any level
    pole[number] = max(1 + beside / ratios[law.mode], 0.1) if number else 1 - beside
    values[0] /= pole[0]
    omega[law.mode] *= pole[0]
    ratios[law.mode] *= pole[1]
    form = law.form._replace(**{LawForm._fields[number]: exponent})
    law = law._replace(form=form, values=values, equivalent=law.equivalent / pole)
    return replace(p, modes=p.modes._replace(omega=omega, ratios=ratios), laws=(*p.laws[:-1], law))


def _shared(fit: RecordFit) -> float:
    """Factor of variances for what a fit leaves beyond its noise, and what neighbouring lines of it share."""
    white = at_lines(fit, lambda chunk: chunk.deviations(fit.levels)[0] * chunk.error)
    return max(fit.reduced, 1.0) * line_correlation(white.swapaxes(0, 1), fit.model.unknowns)


def _with_equivalents(fit: RecordFit) -> Parameters:
    """The parameters with the linear mode of each run that is nearest to what its law does there.

    Frequency and damping are means over the time, weighed by the square of the mode's own motion. Numbers of a law are
    those at the highest level of the records from here on.
    """
    p, laws = fit.parameters, []
    for law in p.laws:
        omega, ratio = float(p.modes.omega[law.mode]), float(p.modes.ratios[law.mode])
        A = ca.SX.sym("A")
        both = law.form.at(A, ca.SX(omega), ca.SX(ratio), ca.SX(ca.DM(law.values)))
        function = ca.Function("both", [A], [ca.horzcat(*both) / np.array([[omega, ratio]])])
        levels, motions = _in_runs(fit, p, law)
        equivalent = []
        for level, motion in zip(levels, motions, strict=True):
            values = np.asarray(function.map(level.size)(level[None]).full()).reshape(2, -1, order="F")
            equivalent.append(values @ motion**2 / (motion @ motion))
        laws.append(_of_highest_level(law._replace(equivalent=np.maximum(equivalent, 0.1)), levels))
    return replace(p, laws=tuple(laws))


def _in_runs(fit: RecordFit, p: Parameters, law: ModeLaw) -> tuple[list[Array], list[Array]]:
    """Level that a law follows, m/s², and restoring acceleration of its mode, at all samples of each run."""
    motions = fit.model.law_motions or LawMotions(fit.test)
    runs = [motions.in_run(p, run, law) for run in range(fit.test.n_runs)]
    return [level for level, _ in runs], [motion for _, motion in runs]


def _of_highest_level(law: ModeLaw, levels: Sequence[Array]) -> ModeLaw:
    """The same law with its numbers at the highest of these levels."""
    highest = float(max(level.max() for level in levels))
    values = law.values * (highest / law.form.level) ** np.array(law.form[:2])
    return law._replace(form=law.form._replace(level=highest), values=values)


def fitted_laws(fit: RecordFit) -> tuple[FittedLaw, ...]:
    """The laws of a fit, with the covariance of frequency, damping and law, as wide as what is left says."""
    model, index, p, found = fit.model, fit.model.index, fit.parameters, []
    if not p.laws:
        return ()
    N, size = unit_diagonal(fit.normal[: model.n_fit, : model.n_fit])
    half = half_inverse(N, ROUND_OFF)
    covariance = half @ half.T / np.outer(size, size) / 2 * _shared(fit)
    first = model.of_laws.start
    for law in p.laws:
        at = [index.log_omega.start + law.mode, index.log_ratios.start + law.mode, *range(first, first + law.form.size)]
        first += law.form.size
        pole = float(p.modes.omega[law.mode] / (2 * np.pi)), float(p.modes.ratios[law.mode])
        other = 0.0 if law.level_of is None else float(p.modes.omega[law.level_of] / (2 * np.pi))
        level, cov = np.concatenate(_in_runs(fit, p, law)[0]), covariance[np.ix_(at, at)]
        levels = float(np.quantile(level, 0.05)), float(level.max())
        found.append(FittedLaw(*pole, law.sensor, law.form, law.values, levels, cov, law.likelier, followed=other))
    return tuple(found)
