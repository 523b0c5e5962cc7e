"""Fit of a modal model with transients to whole records, with the noise of all channels, base included.

True maximum likelihood with the base's motion unknown: errors weigh by their full covariance at each line, and every
derivative is taken at the base's motion as all channels make it likely. Levels of the noise that are not stated are
estimated in turn with the fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sysid.errors import refuse
from sysid.measurement.channels import without_constants
from sysid.measurement.measurement import Measurement
from sysid.measurement.whole import NoiseLevels, SteadyLines
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.least_squares import half_inverse, unit_diagonal
from sysid.modal_analysis.modal_fit import Modes, weigh
from sysid.modal_analysis.modal_model import ModeLaw, trace_count
from sysid.modal_analysis.noise_levels import (
    bounded_by_lines,
    extra_numbers,
    floors,
    likeliest_levels,
    plain_levels,
    rough_levels,
)
from sysid.modal_analysis.record_model import NormalEquations, Parameters, RecordModel
from sysid.modal_analysis.record_steps import KeptEquations, minimised
from sysid.modal_analysis.residues import Records
from sysid.structure.amplitude import FittedLaw, LawForm, laws_from_tree, laws_to_tree
from sysid.structure.structure import Array
from sysid.structure.thresholds import ROUND_OFF

_LEAST_MASS = 1e-3  # of the largest modal mass, that a mode begins with
_SAME_LEVELS = 0.003  # relative change of a standard deviation at which levels stand still


class Limits(NamedTuple):
    """Limits of a fit: rounds of modes and levels in turn, steps of each, further rounds where levels alone move.

    Steps of a round end, too, where one gains less than `creeping`: then the fit is not settled.
    """

    rounds: int
    steps: int
    further: int = 0
    creeping: float = 0.0


WHOLE, TRIAL, ROUGH = Limits(12, 60, 12), Limits(12, 8), Limits(3, 4)


@dataclass(frozen=True, eq=False)
class RecordFit:
    """Modes of whole records, their transients, and the noise of all channels.

    Attributes
    ----------
    test : Measurement
        As given, on the clock of the base.
    parameters : Parameters
    levels : (pieces, c + d) or (pieces, 2 (c + d))
        Variances of a sample in time, of responses, forces and base; a row a run, or a stretch of a run's lines. Where
        noise grows with the signal, squared shares of it behind them.
    chi2 : float
        ``sum e' S^-1 e``: half a chi-squared of `freedom` degrees where the model is right.
    settled : bool
        Whether the fit came to its end.
    stopped : bool
        Whether the search for modes was stopped, and this is the best until then.
    static : int
        So many modes, the last, stand for all above the lines: see `ModalFit`.
    kept : (m,) or None
        Modes that the estimate has, where fewer were asked for than the records show.
    left_out : tuple of FittedLaw
        Laws of amplitude that were tried and do not hold.
    """

    test: Measurement
    parameters: Parameters
    levels: Array
    chi2: float
    settled: bool
    stopped: bool = False
    static: int = 0
    kept: NDArray[np.bool_] | None = None
    left_out: tuple[FittedLaw, ...] = ()

    @cached_property
    def model(self) -> RecordModel:
        """The model that was fitted."""
        return self.model_of(self.parameters)

    def model_of(self, p: Parameters, test: Measurement | None = None, *, gains: bool = False) -> RecordModel:
        """The model of other parameters, or of another test: of these where none is given."""
        coupled, m = p.coupling is not None, p.modes.omega.size
        model = RecordModel(test or self.test, m, gains=gains, static=self.static, coupled=coupled, laws=p.laws)
        return model.at_signal(p)

    @cached_property
    def asked(self) -> RecordModel:
        """The same with the columns of gains and delays, which come last."""
        return self.model_of(self.parameters, gains=True)

    @cached_property
    def equations(self) -> NormalEquations:
        """Normal equations at the end of the fit, of the model that is `asked`."""
        return self.asked.normal_equations(self.parameters, self.levels)

    @cached_property
    def normal(self) -> Array:
        """``Re J' S^-1 J`` over all unknowns of the fit."""
        return self.model.normal_equations(self.parameters, self.levels).normal

    @property
    def freedom(self) -> int:
        """Real numbers of the records less those of the fit."""
        return self.model.numbers - self.model.unknowns

    @property
    def reduced(self) -> float:
        """Chi-squared over its degrees of freedom: one where the model is right and levels are the noise's."""
        return 2 * self.chi2 / self.freedom

    @property
    def schwarz(self) -> float:
        """The log-likelihood less half of Schwarz's price of the unknowns: the larger, the better."""
        unknowns = self.model.unknowns + extra_numbers(self.model.whole.varying)
        return self.likelihood - unknowns * float(np.log(self.model.numbers)) / 2

    @cached_property
    def likelihood(self) -> float:
        """Logarithm of the likelihood of the records' spectra, but for the powers of pi."""
        model, c = self.model, self.model.channels
        spread = 0.0
        for chunk in model.chunks(self.parameters):
            T = chunk.H
            variances = np.broadcast_to(chunk.run.variances(self.levels), (c + model.d, T.shape[-1]))
            inner = np.einsum("cil,cjl,cl->lij", T.conj(), T, 1 / variances[:c]) * variances[c:].T[:, None]
            spread += float(np.sum(np.linalg.slogdet(inner + np.eye(inner.shape[1]))[1]))
            spread += float(np.sum(np.log(variances[:c])))
        return -spread - self.chi2

    def information(self) -> Array:
        """``Re J' S^-1 J`` over the unknowns of `Index`, less what transients and traces explain of it; (p, p)."""
        model, kept = self.model, self.model.kept
        N, size = unit_diagonal(self.normal)
        beside = slice(kept, model.of_gains.start)  # what tolerances leave open counts by itself: see `Calibration`
        turned = half_inverse(N[beside, beside], 1e-12).T @ N[beside, :kept]
        A = np.zeros((model.index.size, model.index.size))
        A[:kept, :kept] = (N[:kept, :kept] - turned.T @ turned) * np.outer(size[:kept], size[:kept])
        return A

    @property
    def levels_of_runs(self) -> Array:
        """Mean variances over the lines of each run, (runs, c + d)."""
        model = self.model
        mean, lines = np.zeros((self.test.n_runs, model.channels + model.d)), np.zeros((self.test.n_runs, 1))
        for run in model.runs:
            mean[run.number] += run.w.size * run.variances(self.levels).mean(axis=1) / run.density
            lines[run.number] += run.w.size
        return mean / lines

    @property
    def constants(self) -> Array:
        """Shares of the base's motion, (n_sensors, d), that `without_constants` took off the test; zero for none."""
        taken = self.model.whole.constants
        return np.zeros(self.test.rigid_body.shape) if taken is None else taken

    @property
    def of_axes(self) -> Array:
        """The constants, (n_sensors, d), of sensors of wrong axis or sign: larger than those of any gain."""
        add, stated = (np.linalg.norm(one, axis=1) for one in (self.constants, self.test.rigid_body))
        return np.where((add > stated / 2)[:, None], self.constants, 0.0)

    @property
    def shares(self) -> Array | None:
        """Shares of the signal in the noise of responses, forces and base, (runs, c + d); None without any."""
        return np.sqrt(np.split(self.levels, 2, axis=1)[1]) if self.model.whole.grows else None

    @property
    def noise(self) -> NoiseLevels:
        """The levels, stated or found, as standard deviations; found ones hold no more than the quietest lines."""
        found = self.levels_of_runs
        if self.model.whole.noise is None and not self.model.whole.grows:
            found = bounded_by_lines(self.model, found)
        root, n, d = np.sqrt(found if len(found) > 1 else found[0]), self.test.n_sensors, self.test.n_base
        force = root[..., n : n + d] if self.test.force is not None else None
        return NoiseLevels(root[..., :n], root[..., -d:], force)

    def to_tree(self) -> dict[str, Any]:
        """Give what was found, without the records, as dictionaries, arrays and numbers; `from_tree` takes it back."""
        p, whole = self.parameters, self.model.whole
        return {
            "modes": p.modes._asdict(), "rigid": p.rigid, "ends": p.ends, "traces": p.traces, "levels": self.levels,
            "chi2": self.chi2, "settled": self.settled, "stopped": self.stopped, "static": self.static,
            "varying": whole.varying, "kept": self.kept, "coupling": p.coupling, "constants": self.constants,
            "left_out": laws_to_tree(self.left_out), "gains": p.gains, "plain": whole.plain, "grows": whole.grows,
            "profile": getattr(whole, "profile", None), "taken": whole.taken if whole.grows else None,
            "laws": [{**law._asdict(), "form": np.array(law.form)} for law in p.laws] or None,
        }  # fmt: skip

    @classmethod
    def from_tree(cls, tree: dict[str, Any], test: Measurement) -> RecordFit:
        """Give the fit of a test, without its delays, that `to_tree` made a tree of, exact to the bit.

        Raises
        ------
        InputError
            Where it is of another test.
        """
        if tree.get("grows", False) and test.whole is None:
            profile, taken, of_lines = tree.get("profile"), tree.get("taken"), SteadyLines.of(test.n_runs, test.freq)
            for one, size in ((profile, test.freq.size), (taken, test.n_sensors + (test.force is not None))):
                wrong = one is not None and (one.shape != (size,) or not np.all(np.isfinite(one)))
                refuse((wrong, "the stored fit of lines is of another test, or holds what is no number"))
            test = replace(test, whole=replace(of_lines, profile=profile, taken=taken))
        refuse((test.whole is None, "a fit of whole records stands beside a test that has none"))
        constants, G = tree.get("constants", np.zeros(1)), test.rigid_body
        if constants.shape in ((1,), (test.n_sensors,)):  # of before: errors of gains
            constants = constants[:, None] * G
        sound = constants.shape == G.shape and bool(np.all(np.isfinite(constants)))
        test = without_constants(test, constants) if sound else test
        coupling, kept, plain = tree.get("coupling"), tree.get("kept"), tree.get("plain", False)  # of before: none
        test = replace(test, whole=replace(test.whole, varying=tree["varying"], plain=plain))  # type: ignore[type-var]
        ends, gains = tree["ends"], tree.get("gains", np.zeros(0))
        laws = tuple(ModeLaw(**{**law, "form": LawForm(*law["form"].tolist())}) for law in tree.get("laws") or ())
        p = Parameters(Modes(**tree["modes"]), tree["rigid"], ends, tree["traces"], coupling, gains, laws)
        ended = {name: tree[name] for name in ("levels", "chi2", "settled", "stopped", "static")}
        fit = cls(test, p, **ended, kept=kept, left_out=laws_from_tree(tree.get("left_out")))
        model, m, c = fit.model, p.modes.omega.size, fit.model.channels
        parts = [*p.modes, p.rigid, p.ends, p.traces, fit.levels, p.gains, *(law.values for law in laws)]
        shapes: list[tuple[int, ...]] = [
            (model.n, m), (m, model.d), (m,), (m,), (model.d, model.d), (m, 2 * len(model.moving)),
            (test.n_runs, c, trace_count(test)), (len(model.runs), (c + model.d) * (1 + model.whole.grows)),
            (model.by_gains.shape[2],), *((law.form.size,) for law in laws),
        ]  # fmt: skip
        sound &= [part.shape for part in parts] == shapes and all(np.all(np.isfinite(part)) for part in parts)
        sound &= coupling is None or (coupling.shape == (m, m) and bool(np.all(np.isfinite(coupling))))
        sound &= all({law.mode, law.followed} <= {*range(m)} and law.sensor in range(model.n) for law in laws)
        sound &= all(law.equivalent.shape == (test.n_runs, 2) and bool(np.all(law.equivalent > 0)) for law in laws)
        sound &= kept is None or (kept.shape == (m,) and kept.dtype == bool and bool(np.any(kept)))
        refuse((not sound, "the stored fit of the whole records is of another test, or holds what is no number"))
        return fit


def record_modes(test: Measurement, omega: Array, ratios: Array, *, monitor: FitMonitor | None = None) -> RecordFit:
    """Fit modes to whole records, roughly, from poles close by: a few steps, for `refitted` to go on from.

    Parameters
    ----------
    test : Measurement
        Of whole records.
    omega, ratios : (m,)
        Circular frequencies, rad/s, and damping ratios.
    monitor : FitMonitor, optional
        Called with iterations and ``sqrt(chi2 / numbers)``; what it raises passes through.
    """
    first = _first(test, omega, ratios)
    model = RecordModel(test, first.modes.omega.size)
    return fit_model(model, first, None, monitor or FitMonitor(), ROUGH)


def refitted(
    fit: RecordFit,
    p: Parameters,
    *,
    limits: Limits = WHOLE,
    some: Measurement | None = None,
    monitor: FitMonitor | None = None,
    static: int | None = None,
) -> RecordFit:
    """The fit from other parameters, and from its levels of noise, within limits: of `ROUGH` it takes a few steps.

    Where lines are many, `some` is the test at a few of them, which give the normal matrix of each step. Gradients and
    what is left are those of all lines, so that the end is theirs.
    """
    fit = fit if static is None else replace(fit, static=static)
    coarse = None if some is None else fit.model_of(p, some).weighed_as_all()
    found = fit_model(fit.model_of(p), p, fit.levels, monitor or FitMonitor(), limits, coarse)
    return replace(found, left_out=fit.left_out)


def on_turned(fit: RecordFit, test: Measurement, *, monitor: FitMonitor | None = None) -> RecordFit:
    """The fit of the same records with other delays, or errors of gains, taken off.

    What stands at the ends of turned records is another thing with each delay. Records are linear in it, and it is
    fitted first, the modes as they are: from none of it steps of the modes lead far away.
    """
    assert test.whole is not None
    was, p = fit.model.whole, fit.parameters
    test = replace(test, whole=replace(test.whole, varying=was.varying, plain=was.plain))
    traces = np.zeros((*p.traces.shape[:2], trace_count(test)))
    fit, p = replace(fit, test=test), replace(p, traces=traces, gains=np.zeros(0))
    model = fit.model_of(p)
    equations, x = model.at_signal(p).normal_equations(p, fit.levels), model.pack(p)
    ends = model.kept + np.flatnonzero(~model.held[model.kept : model.coupling.start])
    normal, size = unit_diagonal(equations.normal[np.ix_(ends, ends)])
    half = half_inverse(normal, ROUND_OFF)
    x[ends] += half @ (half.T @ (equations.gradient[ends] / size)) / size
    return refitted(fit, model.unpack(x), monitor=monitor)


def at_all_lines(fit: RecordFit, test: Measurement) -> RecordFit:
    """The same in one step, with levels and sum of squares of all lines; settled where the fit of some lines was."""
    model, coarse = fit.model_of(fit.parameters, test), fit.model_of(fit.parameters).weighed_as_all()
    one = fit_model(model, fit.parameters, fit.levels, FitMonitor(), Limits(1, 1), coarse)
    return replace(one, settled=fit.settled)


def fit_model(
    model: RecordModel,
    p: Parameters,
    levels: Array | None,
    monitor: FitMonitor,
    limits: Limits,
    coarse: RecordModel | None = None,
) -> RecordFit:
    """Modes and levels in turn."""
    test = model.test
    assert test.whole is not None
    least, plain = floors(model), test.whole.plain
    stated = None if plain else test.whole.noise
    model = model.at_signal(p)
    if plain:
        levels = plain_levels(model, p)
    elif stated is not None:
        levels = np.maximum(np.concatenate([stated.outputs, stated.base], axis=-1) ** 2, least)
    elif levels is None:
        levels = rough_levels(model, p)
    settled, chi2, equations = False, np.inf, KeptEquations(model, coarse)
    for round_ in range(limits.rounds + limits.further):
        if round_ and model.whole.grows:  # held within a round: varying without log det it would bias the modes
            model = model.at_signal(p)
            equations = KeptEquations(model, coarse and coarse.at_signal(p))
        p, chi2, done = minimised(model, p, levels, monitor, (10 * round_, limits.steps), equations, limits.creeping)
        if stated is not None:
            settled = done
            break
        before = levels
        levels = plain_levels(model, p) if plain else likeliest_levels(model, p, levels)
        changes = [np.log(run.variances(levels) / run.variances(before)) for run in model.runs]
        if done and max(np.abs(one).max() for one in changes) < 2 * _SAME_LEVELS:
            settled = True
            break
        if not done and round_ + 1 >= limits.rounds:
            break
    if stated is None:
        chi2 = model.at_signal(p).chi2(p, levels)  # at the last levels
    return RecordFit(test, p, levels, chi2, settled, static=model.static)


def _first(test: Measurement, omega: Array, ratios: Array) -> Parameters:
    """Rank-one modes nearest to free residues at given poles; with a force, its masses."""
    records = Records(test)
    d, free = test.n_base, records.fit(omega, ratios)
    residues = records.by_sensor(free.residues)  # (m, n, d + 2 r)
    size = np.linalg.norm(np.concatenate(list(test.inputs), axis=-1), axis=1)
    size[size == 0] = size.max()  # a base direction that does not move: any scale will do
    u, s, vt = np.linalg.svd(residues * size)
    strength = np.sqrt(s[:, 0] / size[:d].max())
    phi, push = u[:, :, 0].T * strength, vt[:, 0] * (s[:, 0] / strength)[:, None] / size
    modes, ends = Modes(phi, push[:, :d], omega, ratios), push[:, d:]
    rigid: Array = np.zeros((d, d))
    if test.force is not None:
        t, rigid = weigh(test, modes, ends)
        scale = np.sqrt(np.maximum(t, _LEAST_MASS * t.max()))
        modes = modes._replace(phi=modes.phi / scale, gamma=modes.gamma * scale[:, None])
        ends = ends * scale[:, None]
    channels = test.n_sensors + (0 if test.force is None else d)
    return Parameters(modes, rigid, ends, np.zeros((test.n_runs, channels, trace_count(test))))


def without(fit: RecordFit, gone: NDArray[np.bool_]) -> Parameters:
    """Parameters of a fit without some modes, (m,)."""
    return fit.parameters.at(~gone)


def as_one(fit: RecordFit, same: NDArray[np.bool_], number: int) -> Parameters:
    """Parameters of a fit with one mode in place of several, (m,), at the place of that of a number.

    It has their mean pole and the sum of their residues, as they may be large and cancel one another.
    """
    p = fit.parameters
    several, modes, ends = p.modes.at(same), Modes(*(part.copy() for part in p.modes)), p.ends.copy()
    u, s, vt = np.linalg.svd(several.phi @ several.gamma)
    # A force weighs the mode: it answers by the squares of participations.
    size = float(np.linalg.norm(several.gamma @ vt[0])) if fit.model.force else float(np.sqrt(s[0]))
    modes.phi[:, number], modes.gamma[number] = u[:, 0] * s[0] / max(size, ROUND_OFF), vt[0] * size
    modes.omega[number], modes.ratios[number] = (np.exp(np.mean(np.log(part))) for part in several[2:])
    ends[number] = np.linalg.pinv(modes.phi[:, [number]]) @ several.phi @ ends[same]
    return replace(p, modes=modes, ends=ends).at(~same | (np.arange(same.size) == number))
