"""Fit of the modes of a test, with transients and noise of whole records: the estimate that all else starts from."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from sysid.errors import InputError, Stop
from sysid.measurement.channels import tolerance_of, without_constants, without_delays
from sysid.measurement.measurement import Measurement
from sysid.measurement.whole import SteadyLines
from sysid.modal_analysis.amplitude_fit import fitted_laws, with_laws
from sysid.modal_analysis.calibration import Calibration, calibrated
from sysid.modal_analysis.coupled_modes import coupling_of, with_couplings
from sysid.modal_analysis.delays import Delays
from sysid.modal_analysis.direct_terms import without_window
from sysid.modal_analysis.first_modes import by_the_noise_found, first_modes, near_fit, price_of_delays, rough_fit
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.growing_errors import errors_grow, may_grow, with_profile
from sysid.modal_analysis.misfit import left_of, misses_much, without_transients
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.modal_model import Parameters
from sysid.modal_analysis.model_order import (
    least_worth,
    no_modes,
    peaks_of,
    pruned,
    with_further_modes,
    without_spurious_modes,
    without_weak_modes,
)
from sysid.modal_analysis.record_fit import (
    ROUGH,
    RecordFit,
    at_all_lines,
    on_turned,
    record_modes,
    refitted,
    without,
)
from sysid.modal_analysis.residual_tests import (
    calibration_of,
    delays_left,
    delays_of,
    excess_of,
    gain_errors_of,
    runs_in_motion,
    scatter,
    uneven,
    unidentifiable_levels,
    varying_levels,
    with_varying_levels,
)
from sysid.modal_analysis.residues import Records
from sysid.modal_analysis.rough_poles import (
    at_few_lines,
    at_some_lines,
    decimated_lines,
    refuse_sines,
    steady_sine,
)
from sysid.modal_analysis.spectra_modes import strongest_poles
from sysid.modal_analysis.static_modes import with_poles_above, with_static_modes
from sysid.modal_analysis.vector_fitting import find_poles
from sysid.nlp import one_thread
from sysid.structure.amplitude import AmplitudeLaw
from sysid.structure.structure import Array
from sysid.structure.thresholds import most_deviations


def whole_fit(test: Measurement, delays: Array | None = None, *, monitor: FitMonitor | None = None) -> RecordFit:
    """Modes, transients and noise of whole records, its levels smooth over the lines where they are no constants.

    Delays that were found already, s, are taken off sensors and force, and what the fit finds left of them; None where
    they are not asked for. Where the monitor stops it, the best fit until then, with `stopped` set.

    Raises
    ------
    InputError
        As `find_poles` does, or where the base moved in a steady sine.
    Stop, KeyboardInterrupt
        Where the monitor stops it before there was a fit.
    """

    def fit(test: Measurement, monitor: FitMonitor) -> RecordFit:
        found = _whole_fit(test, monitor) if delays is None else _on_one_clock(test, delays=delays, monitor=monitor)
        return _beside_free_gains(_no_worse_than_squares(found, monitor), monitor)

    if monitor is None:
        return fit(test, monitor=FitMonitor())
    try:
        with monitor.at_work():
            return fit(test, monitor=monitor)
    except (Stop, KeyboardInterrupt):
        best = monitor.best
        if not isinstance(best, RecordFit):
            raise
    refuse_sines(best, test)
    if best.model.whole.taken is not None:
        test = without_delays(test, best.model.whole.taken)
    test = without_constants(test, best.constants)
    # One step leads to the end on all lines, but for what noise makes of the curvature: some lines led close to it.
    return replace(best if best.test.freq.size == test.freq.size else at_all_lines(best, test), stopped=True)


def _no_worse_than_squares(fit: RecordFit, monitor: FitMonitor, worse: float = 1.01) -> RecordFit:
    """The fit; where its model misses much of the records, and more than least squares of them do, these.

    What a model misses passes for noise of the base, by which the modes then explain anything. Least squares begin at
    the modes found, with the motion of the base as recorded, and at poles that are looked for anew, and the better end
    is taken. Runs stated to be at rest that were not are a mistake, which explains what is missed. Where the base moves
    at few lines, as in a sine, squares would be those of these lines alone.
    """
    left, whole = left_of(fit), fit.model.whole
    sound = fit.stopped or whole.noise is not None or not misses_much(left) or at_few_lines(fit.test)
    if sound or (left < 1.0 and not uneven(fit, but=0.03)):  # a tone or a spike is no wrong model
        return fit
    monitor.doing = "least squares"
    plain = replace(fit, test=replace(fit.test, whole=replace(whole, varying=None, plain=True)))
    first = replace(without(fit, np.arange(fit.model.m) >= fit.model.m - fit.static), coupling=None)  # no dampers
    try:
        squares = min((refitted(plain, first, monitor=monitor, static=0), *_anew(plain, monitor)), key=left_of)
    except (Stop, KeyboardInterrupt):
        return replace(fit, stopped=True)
    return squares if left > worse * left_of(squares) and not runs_in_motion(fit) else fit


def _beside_free_gains(fit: RecordFit, monitor: FitMonitor, std: float = 0.05) -> RecordFit:
    """The fit of modes that are found beside free gains of all sensors, where it is likelier; else as it is.

    A wrong gain is one number, for which poles beyond the lines, static modes and dampers stand as far as they can.
    What the gains add is taken off; shapes stay as recorded. A mode below the lines makes constants of its own: it
    gives way to one gain, of a sensor or of the base, or stays, and then gains are not judged.
    """
    test, n = fit.test, fit.model.n
    below = np.any(fit.parameters.modes.omega < 2 * np.pi * test.freq[0])
    stays = fit.stopped or fit.model.whole.plain or np.any(tolerance_of(test)) or np.any(fit.constants)
    try:
        if stays or not (below or np.any(gain_errors_of(fit).certain)):
            return fit
        given = replace(test, gain_std=np.full(n, std), whole=replace(fit.model.whole, varying=None))
        free = _whole_fit(given, monitor)
        gain = replace(left := gain_errors_of(free), error=left.error + std * free.parameters.gains)
        count, apart = np.count_nonzero(gain.certain), gain.error - gain.error[np.argmax(np.abs(gain.certain))]
        several = count == 2 or np.any((gain.certain != 0) & (np.abs(apart) > most_deviations(n) * gain.std))
        worth = free.schwarz + np.sum(free.parameters.gains**2) / 2 - (price := count * np.log(fit.model.numbers) / 2)
        # An axis or a sign makes larger errors; and what free gains do not make likelier, these alone do not either.
        if (below and several) or np.max(np.abs(gain.certain)) > 3 * std or worth <= fit.schwarz:
            return fit
        constants = gain.certain[:, None] * test.rigid_body
        right = without_constants(replace(free.test, gain_std=test.gain_std), constants)
        p = replace(free.parameters, gains=np.zeros(0))
        more = refitted(replace(free, test=right), p, some=at_some_lines(right), monitor=monitor)
        likelier = more.settled and more.schwarz - price > fit.schwarz
        likelier &= not np.any(more.parameters.modes.omega < 2 * np.pi * test.freq[0])
    except (Stop, KeyboardInterrupt):
        return replace(fit, stopped=True)
    except (InputError, np.linalg.LinAlgError):  # the fit at hand is one of gains as they are stated
        return fit
    return more if likelier else fit


def _anew(fit: RecordFit, monitor: FitMonitor) -> list[RecordFit]:
    """The fit of at most as many modes in the lines, at poles that the records need most; none where none stand out."""
    try:
        poles = find_poles(fit.test, monitor=monitor)
    except (InputError, np.linalg.LinAlgError):
        return []
    first, last = 2 * np.pi * fit.test.freq[[0, -1]]
    inside, found = ((w >= first) & (w <= last) for w in (poles.omega, fit.parameters.modes.omega))
    kept = strongest_poles(Records(fit.test), poles, max(1, int(found.sum())), inside)
    anew = record_modes(fit.test, poles.omega[kept], poles.ratios[kept], monitor=monitor)
    return [refitted(anew, anew.parameters, monitor=monitor)]


def _on_one_clock(test: Measurement, *, delays: Array, monitor: FitMonitor, rounds: int = 4) -> RecordFit:
    """The fit without the delays that it finds itself, as long as these make it likelier.

    Those that the first modes show are taken off before any others are looked for, which would stand for them. Modes
    are looked for anew where a channel is newly late. Those that chance explains are put back, unless that is worse.
    """
    delays, first = first_modes(test, delays, monitor)
    constants = np.zeros(test.rigid_body.shape) if first is None else first.constants

    def without(delays: Array) -> Measurement:
        return without_constants(without_delays(test, delays), constants)

    fit = found = _whole_fit(without(delays), monitor, first)
    try:
        for _ in range(rounds):
            # What shares of the signal hold of a delay hides it: then it shows by what the fit gains without it.
            hidden = delays_left(fit, missed=1.0) if fit.model.whole.grows else None
            for left, times in ((hidden, 25.0), (delays_left(fit), 1.0)):
                total = delays if left is None else delays + left
                new = (total != 0) & (delays == 0)
                if left is None or (times > 1 and not np.any(new)):
                    continue
                monitor.doing, turned = "delays", without(total)
                beside = fit.static > 0 or not np.any(new)  # what stands for modes above is not looked for anew
                trial = on_turned(fit, turned, monitor=monitor) if beside else _whole_fit(turned, monitor)
                trial = _with_all_modes(trial, monitor) if beside and np.any(new) else trial
                if trial.schwarz - fit.schwarz >= times * price_of_delays(total, delays, fit):
                    fit, delays = trial, total
                    break
            else:
                break
        certain = delays_of(fit).beyond_chance
        if not np.array_equal(certain, delays != 0):
            fewer = on_turned(fit, without(kept := np.where(certain, delays, 0.0)), monitor=monitor)
            fit = fewer if fewer.schwarz + price_of_delays(delays, kept, fit) > fit.schwarz else fit
        return fit if fit is found else without_weak_modes(fit, monitor)  # which was done there
    except (Stop, KeyboardInterrupt):
        return replace(fit, stopped=True)


def _whole_fit(test: Measurement, monitor: FitMonitor, first: RecordFit | None = None) -> RecordFit:
    try:
        fit = _white_fit(test, monitor, first)
    except (InputError, np.linalg.LinAlgError) as error:
        sentence = steady_sine(test)
        if sentence is None:
            raise
        raise InputError(sentence) from error
    refuse_sines(fit, test)
    monitor.doing = "levels of noise that vary"  # where the level was too low, noise passed for modes
    return without_weak_modes(with_varying_levels(fit, monitor=monitor), monitor)


def _white_fit(test: Measurement, monitor: FitMonitor, first: RecordFit | None = None) -> RecordFit:
    """The fit with one level of noise a channel and run.

    Poles are looked for twice: with rough weights, and with the noise that a first fit found, where it is not given;
    where lines are many, on some of them, from which the fit of all begins.
    """
    if (some := at_some_lines(test)) is not None:
        fit = _white_fit(some, monitor, first)
        monitor.doing = "all lines"
        fit = refitted(replace(fit, test=test), fit.parameters, some=some, monitor=monitor)
        monitor.keep(fit := with_poles_above(fit, some=some, monitor=monitor))
        return _with_all_modes(fit, monitor)  # weak ones show on all lines only, and so do poles above
    if first is None:
        first = by_the_noise_found(near_fit(test, monitor), monitor)
    return _with_all_modes(first, monitor)


def _with_all_modes(fit: RecordFit, monitor: FitMonitor) -> RecordFit:
    """The fit with couplings, then further modes that are worth it, without spurious ones."""
    some = at_some_lines(fit.test)
    fit = with_couplings(fit, lambda rough: pruned(rough, monitor, limits=ROUGH), some=some, monitor=monitor)
    if np.any(no_modes(fit) & ~no_modes(fit, first=True)):  # first ones above the lines, which stand for others there
        fit = pruned(with_static_modes(fit, monitor=monitor), monitor)
    monitor.keep(fit)
    if fit.model.whole.grows and 2 * len(peaks_of(fit, least_worth(fit.model))) > fit.model.m:
        return fit  # levels and shares do not explain what is left, and further modes would take long
    monitor.doing = "further modes"
    fit = with_further_modes(fit, some=some, monitor=monitor)
    monitor.doing = "spurious modes"
    fit = without_spurious_modes(fit, some=some, monitor=monitor)
    monitor.keep_instead(fit)
    # A pole for all modes above the lines may be no mode, and what they add then passes for noise of the base.
    above = with_static_modes(fit, monitor=monitor) if misses_much(left_of(fit)) else fit
    return fit if above is fit else _with_all_modes(above, monitor)


def fit_modes(
    test: Measurement, delays: Delays | None = None, calibration: Calibration | None = None, *,
    monitor: FitMonitor | None = None, amplitude: AmplitudeLaw | None = None,
) -> ModalEstimate:  # fmt: skip
    """Estimate the modes of a test: of whole records with their transients and noise; other lines stand as given.

    Parameters
    ----------
    test : Measurement
    delays : Delays, optional
        Of its sensors and force, which are taken off: see `find_delays`. None where they are not asked for.
    calibration : Calibration, optional
        Errors of its gains, which are taken off; by default what is stated of them alone.
    monitor : FitMonitor, optional
    amplitude : AmplitudeLaw, optional
        Laws that modes of whole records may follow: see `with_laws`.

    Raises
    ------
    InputError, Stop, KeyboardInterrupt
        As `whole_fit` does.
    """
    values, calibration = None if delays is None else delays.values, calibration or Calibration.stated(test)
    test = calibrated(without_window(test), calibration)
    if test.whole is None:
        return _of_lines(test, delays, calibration, monitor)
    with one_thread():  # the same bits on any number of processors, and many times faster where others use them too
        of_laws = monitor or FitMonitor()
        early = amplitude and _early_laws(test, values, amplitude, of_laws)
        fit = early or whole_fit(test, values, monitor=monitor)
        if calibration is not None and not (fit.stopped or np.any(calibration.values)):
            fit, calibration = _calibrated(fit, calibration, monitor)
        if amplitude is not None and early is None:
            fit = with_laws(fit, amplitude, monitor=of_laws)
        return estimate(fit, calibration)


def _of_lines(
    test: Measurement, delays: Delays | None, calibration: Calibration | None, asked: FitMonitor | None
) -> ModalEstimate:
    """The estimate of lines that stand for themselves; with modes where their errors grow with the signal.

    Where shares of the signal do not explain what is left, a model misses something: then the lines stand as given.
    """
    given, monitor = test, asked or FitMonitor()
    test = test if delays is None else without_delays(test, delays.values)
    plain = replace(ModalEstimate.of_lines(test), delays=delays, calibration=calibration)
    if test.sample_rate is not None or not may_grow(test):  # records in time have noise of a level
        return plain
    try:
        with one_thread(), monitor.at_work():
            poles = find_poles(test, monitor=lambda *_: monitor.check())  # told where a strategy asks for them
            plain = replace(plain, poles=poles)
            if not errors_grow(test, poles):
                return plain
            given = replace(given, whole=SteadyLines.of(test.n_runs, test.freq))
            late = None if delays is None else delays.values
            fit = _whole_fit(given, monitor) if late is None else _on_one_clock(given, delays=late, monitor=monitor)
            above = with_static_modes(fit, monitor=monitor)  # what these leave is no noise
            found = with_profile(above, monitor)
            if uneven(found, but=0.03):  # as where squares take the place of noise
                return plain
            fit = found if above is fit else on_turned(fit, found.test, monitor=monitor)
            if calibration is not None and not np.any(calibration.values):
                fit, calibration = _calibrated(fit, calibration, monitor)
            return estimate(fit, calibration)
    except (InputError, np.linalg.LinAlgError):
        return plain
    except (Stop, KeyboardInterrupt):  # what is over ends the search that follows
        if asked is None:
            raise
        return plain


def _calibrated(fit: RecordFit, stated: Calibration, monitor: FitMonitor | None) -> tuple[RecordFit, Calibration]:
    """The fit once more without the errors of gains that it makes likely within tolerances.

    And without modes that stood for them, whose share of the errors is found once they are gone.
    """
    found = calibration_of(fit, stated)
    try:
        free = replace(fit, parameters=_without_errors(fit.parameters, found.values))
        calibrated = pruned(on_turned(free, found.taken_off(fit.test), monitor=monitor), monitor)
        if calibrated.model.m < fit.model.m:
            p = _without_errors(calibrated.parameters, 1 / (1 + found.values) - 1)
            again = replace(calibrated, test=fit.test)
            again = refitted(again, replace(p, gains=fit.parameters.gains), monitor=monitor)
            return _calibrated(again, stated, monitor)
        return calibrated, found
    except (Stop, KeyboardInterrupt):
        return replace(fit, stopped=True), stated


def _without_errors(p: Parameters, errors: Array) -> Parameters:
    """Parameters of records without these errors of gains, (n_sensors + 2 d,), of which modes are as recorded.

    A fit beside tolerances has the force's errors, and those of the base in it, among its gains: see `read_by_gains`.
    """
    n, d = len(p.modes.phi), len(p.rigid)
    sensors, base = 1 + errors[:n, None], 1 + errors[n : n + d]
    modes = p.modes._replace(phi=p.modes.phi / sensors, gamma=p.modes.gamma * base)
    return replace(p, modes=modes, rigid=p.rigid * np.outer(base, base))


def fit_tests(
    tests: Iterable[tuple[Measurement, Delays | None]], monitor: FitMonitor, amplitude: AmplitudeLaw | None = None
) -> tuple[ModalEstimate, ...]:
    """The modes of each test without its delays; they share the time of the monitor. The first may have laws.

    Raises
    ------
    InputError, Stop, KeyboardInterrupt
        As `whole_fit` does; the last two name the test, where there are several.
    """
    every, found = tuple(tests), []
    for number, (test, delays) in enumerate(every, start=1):
        monitor.begin(sum(one.whole is not None for one, _ in every[number - 1 :]))
        try:
            found.append(fit_modes(test, delays, monitor=monitor, amplitude=amplitude))
            amplitude = None
        except (Stop, KeyboardInterrupt) as stop:
            if len(every) == 1:
                raise
            where = f"test {number} of {len(every)} had no modes yet"
            raise type(stop)(", and ".join(filter(None, (str(stop), where)))) from None
    return tuple(found)


def _early_laws(
    test: Measurement, delays: Array | None, stated: AmplitudeLaw, monitor: FitMonitor, much: float = 0.1
) -> RecordFit | None:
    """The fit with laws from rough poles, where these explain what the linear model misses; else None.

    What it misses passes for noise of the base, modes and dampers, which take long and mean nothing. The numbers of
    stated modes, but for the first, are those of the whole linear fit.
    """
    test = test if delays is None else without_delays(test, delays)
    if stated.modes not in ("auto", (1,)) or steady_sine(test) is not None:
        return None
    try:
        with monitor.at_work():
            rough = at_all_lines(rough_fit(test.at(decimated_lines(test)), monitor), test)
        if left_of(rough) < much:
            return None
        found = with_laws(rough, stated, monitor=monitor, probe=True)
    except (InputError, np.linalg.LinAlgError):  # told by the whole fit
        return None
    if not found.stopped and (not found.parameters.laws or left_of(found) > much):
        return None
    if found.stopped or found.model.whole.plain:  # of squares, what laws miss would make further modes
        return found
    try:
        with monitor.at_work():
            more = pruned(with_further_modes(found, monitor=monitor), monitor)
    except (Stop, KeyboardInterrupt):
        return replace(found, stopped=True)
    omega, first = more.parameters.modes.omega, more.parameters.laws[0].mode
    lower = (omega >= 2 * np.pi * test.freq[0]) & (omega < omega[first])
    return None if np.any(lower) else more  # the first mode is another one


@one_thread()
def estimate(fit: RecordFit, calibration: Calibration | None = None) -> ModalEstimate:
    """Modes in ascending order, with their information: the same bits where a stored fit is read."""
    modes, p, index = fit.parameters.modes, fit.parameters, fit.model.index
    order = np.argsort(modes.omega, kind="stable")
    A, B, gain = fit.information(), scatter(fit), gain_errors_of(fit)
    m, (n, d) = order.size, (fit.test.n_sensors, fit.test.n_base)
    at = np.concatenate([
        (np.arange(n)[:, None] * m + order).ravel(),
        (index.gamma.start + order[:, None] * d + np.arange(d)).ravel(),
        index.log_omega.start + order, index.log_ratios.start + order, index.rigid,
    ])  # fmt: skip
    grows = fit.model.whole.grows  # lines that stand for themselves hold no transients
    there = np.ones(m, bool) if fit.kept is None else fit.kept
    laws = (law for law, of in zip(fitted_laws(fit), p.laws, strict=True) if there[of.mode] and there[of.followed])
    found = ModalEstimate(
        replace(fit.test, whole=None) if grows else fit.test, without_transients(fit),
        *modes.at(order), p.rigid,
        A[np.ix_(at, at)], fit.noise, fit.reduced, fit.model.whole.density, replace(gain, moves=gain.moves[at]),
        None if B is None else B[np.ix_(at, at)], fit.settled,
        excess_of(fit), varying_levels(fit), runs_in_motion(fit),
        () if fit.model.whole.plain else unidentifiable_levels(fit),
        record_fit=fit, static=fit.static, coupling=coupling_of(fit.model, p, fit.normal, order, at),
        delays=delays_of(fit), calibration=calibration, laws=(*laws, *fit.left_out),
    )  # fmt: skip
    return found if fit.kept is None else found.at(fit.kept[order])
