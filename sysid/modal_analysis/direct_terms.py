"""Absolute motion of the sensors beside all modes: their rigid-body motion and their delay, as recorded.

Absolute accelerations are ``(G + sum of R_k g_k) u_0''``. With poles, residues and a term without poles free, that term
tells what each sensor's row of G would have to be, whatever was stated of it. A record that is late by tau has
``G (1 - i w tau)`` there, to first order, and no structure has a part that grows as ``i w``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.measurement.spectra import blurred
from sysid.measurement.whole import raised
from sysid.modal_analysis.least_squares import units_of
from sysid.modal_analysis.pole_functions import orthonormal
from sysid.modal_analysis.relocation import relocate
from sysid.modal_analysis.residues import Records
from sysid.modal_analysis.response import states_noise
from sysid.modal_analysis.rough_poles import decimated_lines, rough_deviations, steady_sine
from sysid.modal_analysis.vector_fitting import GUESS, RAZOR
from sysid.nlp import one_thread
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import CANDIDATES, ROUND_OFF, beyond_chance, largest_modulus, round_off

_SPARE, _MOST = 6, 40  # poles beyond one a sensor; all of them
MOST_DAMPED = 0.3  # largest damping ratio of a pole that is kept; what has more answers like a term without poles
_OUTSIDE = 1.5  # times the last line, up to where poles are kept; what lies below the first shows by its tail
_FEW = 0.25  # of the lines


@dataclass(frozen=True, eq=False)
class DirectTerms:
    """Terms without poles of a test's accelerations, and of its base force.

    Attributes
    ----------
    rigid, rigid_std : (n_sensors, d)
        What the sensors move with the base beside all modes, and its standard deviation.
    slope, slope_std : (n_sensors, d), s
        Its part that grows as ``i w``.
    modal : (n_sensors, d)
        Sum of the residues of all modes.
    mass, mass_std : (d, d), kg, or None
        The same of the force: the rigid-body mass.
    modal_mass : (d, d), kg, or None
        Sum of the force's residues: effective masses.
    below : bool
        Modes below the lines show, which answer like a constant too: the terms are not the rigid-body motion alone.
    misfit : float
        Relative residual of the absolute accelerations on all lines; the terms are those without lines far off the fit.
    """

    rigid: Array
    rigid_std: Array
    slope: Array
    slope_std: Array
    modal: Array
    mass: Array | None
    mass_std: Array | None
    modal_mass: Array | None
    below: bool
    misfit: float


class BesidePoles(NamedTuple):
    """Fits of a test's absolute accelerations on poles, free residues and terms that have no pole.

    Attributes
    ----------
    test : Measurement
        Its lines that are asked, without those with spikes.
    every, at : AtPoles
        Of all lines, and of these.
    """

    test: Measurement
    every: AtPoles
    at: AtPoles


def beside_poles(test: Measurement) -> BesidePoles | None:
    """Poles beside terms without any; None where lines or base motion do not tell them.

    Noise counts by its deviations where these are stated; a test of whole records is fitted with its transients.
    """
    return None if test.is_whole and steady_sine(test) is not None else beside_poles_at(telling_lines(test))


def telling_lines(test: Measurement) -> Measurement:
    """The lines of a test that tell its poles, with rough deviations where it is one of whole records."""
    if not test.is_whole:
        return test
    test = test.at(decimated_lines(test))
    return replace(test, response_std=rough_deviations(test), force_std=None)


@one_thread()
def beside_poles_at(test: Measurement) -> BesidePoles | None:
    """The same at these lines, with the deviations that they have."""
    every = at = _relocated(test)
    for _ in range(3):  # times that lines with spikes are left out
        if at is None or not at.spikes.any():
            break
        test = test.at(~at.spikes)
        at = _relocated(test)
    return None if every is None or at is None else BesidePoles(test, every, at)


def under_hann(freq: Array, pole: ComplexArray, seconds: float) -> ComplexArray:
    r"""What blocks of so many seconds make of ``1 / (i w - pole)`` at lines in Hz, (k, n_freq) of poles (k,), rad/s.

    Of functions H1 under Hann's window, with an input of all frequencies: the transform of the impulse response times
    the window's autocorrelation r,

    .. math:: \int_0^T r(t) e^{(\lambda - i w) t} dt = T \left[\frac23 E_1(p) + \frac{E_1(p - q) + E_1(p + q)}{6}
              + \frac{E_0(p - q) - E_0(p + q)}{4 \pi i}\right], \quad p = (i w - \lambda) T, \quad q = 2 \pi i,

    with :math:`E_0 = (1 - e^{-p}) / p` and :math:`E_1 = (p - 1 + e^{-p}) / p^2`.
    """
    p, q = (2j * np.pi * freq - pole[:, None]) * seconds, 2j * np.pi
    first = lambda p: (1 - np.exp(-p)) / p  # noqa: E731
    second = lambda p: (p - 1 + np.exp(-p)) / p**2  # noqa: E731
    sides = (second(p - q) + second(p + q)) / 6 + (first(p - q) - first(p + q)) / (4j * np.pi)
    return np.asarray(seconds * (2 / 3 * second(p) + sides))


@one_thread()
def without_window(test: Measurement, rounds: int = 12, near: float = 0.1) -> Measurement:
    """The test without what Hann's window makes of its poles; as it is where none was stated.

    Until that moves no line by more than `near` of its deviation. Poles whose half-power width is less than the
    distance of lines may be noise at one line: what the window makes of these, and by what the last round still moved,
    counts among the errors. So does all that it blurs, where lines are no even ones, no test of functions, show no
    poles, or are explained worse without it, by more than a pole of noise that comes or goes, as where they are not all
    lines of the blocks.
    """
    if test.window != "hann":
        return test
    spacing = float(np.diff(test.freq).min()) if test.freq.size > 1 else np.inf
    even = np.allclose(test.freq / spacing, np.round(test.freq / spacing), atol=0.01)
    turned = test = replace(test, window="taken off")
    lefts: list[float] = []
    last, rest = np.zeros(1), blurred(test.outputs)
    try:
        for _ in range(rounds if even and test.has_unit_runs else 0):
            beside = beside_poles(turned)
            if beside is None:
                break
            wide = beside.at.ratios * beside.at.omega > np.pi * spacing
            (off, narrow), left = _by_window(turned, beside.at.omega, beside.at.ratios, wide, spacing)
            before, turned = turned, test.less(off)
            size = 1e-3 * np.abs(test.response) if test.response_std is None else test.response_std
            lefts, rest, last = [*lefts, left], np.abs(narrow) + np.abs(off - last), off
            if np.all(np.abs(turned.response - before.response) < near * size):
                break
    except (InputError, np.linalg.LinAlgError):
        lefts = []
    channels = test.outputs.shape[1]
    chance = beyond_chance(2 * test.n_runs * (channels + 1)) / 2 * states_noise(test)
    if not lefts or lefts[-1] - lefts[0] > chance:
        rest, turned = blurred(test.outputs), replace(test, window="")
    of_response, of_force = np.split(np.abs(rest), [test.n_sensors], axis=1)
    of_window = [
        None if std is None else np.hypot(std, error)
        for std, error in ((test.response_std, of_response), (test.force_std, of_force))
    ]
    return replace(turned, response_std=of_window[0], force_std=of_window[1])


def _by_window(
    test: Measurement, omega: Array, ratios: Array, some: NDArray[np.bool_], spacing: float
) -> tuple[ComplexArray, float]:
    """What the window adds to `some` poles, and to the others, in responses and force, (2, runs, channels, n_freq).

    And the sum of squares that the residues at all poles leave, in units of the noise.
    """
    every = test.outputs
    deviations = (raised(test.response_std), test.response), (raised(test.force_std), test.force)
    stds = [np.ones(H.shape) if std is None else std for std, H in deviations if H is not None]
    pole = omega * (-ratios + 1j * np.sqrt(1 - ratios**2))
    plain, hann = (
        np.concatenate([one + other, 1j * (one - other)])
        for one, other in (
            [1 / (2j * np.pi * test.freq - at[:, None]) for at in (pole, pole.conj())],
            [under_hann(test.freq, at, 1 / spacing) for at in (pole, pole.conj())],
        )
    )
    x = test.freq / test.freq[-1]
    columns = np.concatenate([plain, np.stack([x**0 + 0j, 1j * x, x**2 + 0j])])
    size = np.sqrt(np.mean(np.abs(columns) ** 2, axis=1))
    off, left, std = np.zeros((2, *every.shape), complex), 0.0, np.concatenate(stds, axis=1)
    for at in np.ndindex(every.shape[:2]):
        rows, data = columns / std[at] / size[:, None], every[at] / std[at]
        found = np.linalg.lstsq(np.hstack([rows.real, rows.imag]).T, np.hstack([data.real, data.imag]), rcond=None)[0]
        left += float(np.sum(np.abs(data - found @ rows) ** 2))
        for which, added in zip((some, ~some), off, strict=True):
            added[at] = np.where(np.tile(which, 2), (found / size)[: len(plain)], 0.0) @ (hann - plain)
    return off, left


@one_thread()
def direct_terms(test: Measurement, beside: BesidePoles | None = None) -> DirectTerms | None:
    """Terms without poles, at poles fitted beside them, from those found already; None where there are none."""
    beside = beside or beside_poles(test)
    if beside is None:
        return None
    test, at = beside.test, _settled(beside.at)
    rigid = _fitted(at, at.errors)
    force = None if test.force is None else _fitted(AtPoles(Records(test, force=True), at.poles), at.errors)
    (const, slope), (const_std, slope_std) = rigid.terms, rigid.std
    mass, mass_std, modal_mass = (None,) * 3 if force is None else (force.terms[0], force.std[0], force.modal)
    return DirectTerms(
        const, const_std, slope, slope_std, rigid.modal, mass, mass_std, modal_mass, rigid.below, beside.every.misfit
    )


def _relocated(test: Measurement, steps: int = 8) -> AtPoles | None:
    """Fit of the accelerations; None where the base moves in too few directions, or no pole is found.

    No pole is removed for explaining no more than noise. They are looked for in the principal channels, the first half
    of the steps in few of them, which is quicker; records without noise tell them in the first step.
    """
    records = Records(replace(test, rigid_body=np.zeros_like(test.rigid_body), sensors=None))
    start = _start(records)
    if start is None or (not records.unit and records.driven < test.n_base):
        return None
    omega, ratios = start
    first, every = records.principal(4), records.principal(12)
    direct = _without_poles(records.freq)
    for step in range(steps):
        omega, ratios = relocate(records, first if 2 * step < steps else every, omega, ratios, lambda: None, direct)
        if step in (0, steps - 1):
            at = _at(records, omega, ratios)
            if at is not None and at.misfit < round_off(len(records.data)):
                break
    return at


def _settled(best: AtPoles, steps: int = 20, least: float = 1e-4) -> AtPoles:
    """The fit after Levenberg-Marquardt steps to likelier poles, until one would move no term by its deviation.

    Each channel has its own level of noise. No pole leaves the lines downwards, where modes show by their tail.
    """
    damping, longest = 10 * least, 0.3
    for _ in range(steps):
        step, moved = best.step(damping)
        if np.max(np.abs(moved)) < 1:
            break
        poles = best.poles + np.clip(step, -longest, longest)
        trial = AtPoles(best.records, np.clip(poles, *best.ends))
        better = np.sum(np.log(trial.level)) < np.sum(np.log(best.level))
        best, damping = (trial, max(damping / 10, least)) if better else (best, 10 * damping)
    return best


def _start(records: Records) -> tuple[Array, Array] | None:
    """Poles spread over the lines; None where these are too few for one."""
    lines = records.lines
    room = (records.data.shape[0] // 3 // records.base.shape[0] - 3) // 2  # three real numbers of a channel a function
    count = min(records.n_sensors + _SPARE, _MOST, room)
    return (np.geomspace(lines[0], lines[-1], count), np.full(count, GUESS)) if count > 0 else None


def _at(records: Records, omega: Array, ratios: Array) -> AtPoles | None:
    """The fit on those poles that can be modes; None where there are none."""
    lines = records.lines
    kept = (omega > lines[0]) & (omega < _OUTSIDE * lines[-1]) & (ratios < MOST_DAMPED)
    kept &= ratios * omega > RAZOR * np.interp(omega, lines, np.gradient(lines))  # else it answers for one bad line
    return AtPoles(records, np.log([omega[kept], ratios[kept]]).ravel()) if np.any(kept) else None


def _without_poles(freq: Array) -> ComplexArray:
    """The functions 1, i w and w², the latter two one in size at the last line, (3, n_freq)."""
    x = freq / freq[-1]
    return np.stack([np.ones_like(x) + 0j, 1j * x, x**2 + 0j])


class BesideTerms:
    """Least squares on functions of poles, log w_k and then log zeta_k (2m,), and on `direct` columns without poles.

    With `velocity` residues have a part in quadrature too.
    """

    def __init__(self, records: Records, poles: Array, direct: Array, *, velocity: bool) -> None:
        self.records, self.poles = records, poles
        self.omega, self.ratios = np.exp(poles.reshape(2, -1))
        functions = records.functions(self.omega, self.ratios, velocity=velocity)
        self.basis, R, size = orthonormal(functions._replace(shared=np.hstack([direct, functions.shared])))
        answered = self.basis.answers(records.data)
        self.left = records.data - self.basis.times(answered)
        regular = scipy.linalg.lapack.dtrcon(R)[0] > ROUND_OFF
        inverse = scipy.linalg.lapack.dtrtri(R)[0] if regular else np.linalg.pinv(R, rcond=ROUND_OFF)
        self.inverse = inverse / size[:, None]
        self.beta, self.count = self.inverse @ answered, len(R)
        of_poles = self.count - functions.shared.shape[1]  # behind those of one run each, and those without poles
        self.of_runs = of_poles - direct.shape[1]
        residues = functions.in_order([self.beta[: self.of_runs], self.beta[of_poles:]])
        self.residues = residues.reshape(self.omega.size, -1, residues.shape[1])
        least = ROUND_OFF * np.linalg.norm(records.data, axis=0) + np.finfo(float).tiny
        self.level = np.maximum(np.linalg.norm(self.left, axis=0), least)


class AtPoles(BesideTerms):
    """The same with the terms 1, i w and w².

    Of these `terms` (2 driven inputs, channels) belong to 1 and i w, and `rows` make them of independent errors.
    """

    def __init__(self, records: Records, poles: Array) -> None:
        direct = records.basis(_without_poles(records.freq), records.driven)
        super().__init__(records, poles, direct, velocity=True)
        at = slice(self.of_runs, self.of_runs + 2 * records.driven)
        self.terms, self.rows = self.beta[at], self.inverse[at]

    @cached_property
    def ends(self) -> tuple[Array, Array]:
        """Least and largest log w_k and log zeta_k, (2m,) each."""
        least, most = np.full((2, *self.poles.shape), [[-np.inf], [np.inf]])
        least[: self.omega.size] = np.log(self.records.lines[0])
        most[self.omega.size :] = np.log(MOST_DAMPED)
        return least, most

    @property
    def misfit(self) -> float:
        """Relative residual."""
        return float(np.linalg.norm(self.left) / np.sqrt(self.records.size))

    @cached_property
    def spikes(self) -> NDArray[np.bool_]:
        """Lines (n_freq,) that are far off."""
        return _spikes(self.records, self.left)

    @cached_property
    def by_poles(self) -> tuple[Array, Array, Array]:
        """Normal matrix of the poles, descent, each channel in units of its level, and slopes of the terms.

        (2m, 2m), (2m,) and (2m, 2 driven inputs, channels); the residues follow the poles.
        """
        slopes = self.records.pole_slopes(self.omega, self.ratios, velocity=True)
        beside = self.basis.beside(slopes)
        products = beside.products(beside.shared.T @ self.left, self.left)
        normal, descent = beside.pole_equations(products / self.level, self.residues / self.level)
        weights = self.basis.shared @ self.rows[:, -self.basis.shared.shape[1] :].T  # whose sums of data are the terms
        of_runs = [columns.T @ weights[rows] for rows, _, columns in slopes.by_run]
        of_slopes = slopes.in_order([*of_runs, slopes.shared.T @ weights]).reshape(2, *self.residues.shape[:2], -1)
        by_pole = -np.einsum("amit,mic->amtc", of_slopes, self.residues)
        return normal, descent, by_pole.reshape(self.poles.size, *self.terms.shape)

    @cached_property
    def share(self) -> float:
        """Root of the variance of the noise over the squares of levels, of which each channel has its own."""
        unknowns, left = self.count * self.left.shape[1], self.left
        factor = self.records.noise(left, unknowns) / self.records.variance(float(np.sum(left**2)), unknowns)
        return float(np.sqrt(factor / max(len(left) - self.count, 1)))

    @property
    def errors(self) -> Array:
        """Independent errors of the poles, (2m, r): those of noise, and last the step that they have still to go."""
        normal, descent, _ = self.by_poles
        unit = units_of(normal)
        values, vectors = np.linalg.eigh(normal * np.outer(unit, unit))
        known = values > ROUND_OFF * values[-1]
        root = unit[:, None] * vectors[:, known] / np.sqrt(values[known])
        return np.column_stack([self.share * root, root @ (descent @ root)])

    def step(self, damping: float) -> tuple[Array, Array]:
        """A damped step of the poles, and how far it moves the terms, in units of their deviations at fixed poles."""
        normal, descent, by_pole = self.by_poles
        free = ~np.where(descent > 0, self.poles >= self.ends[1], self.poles <= self.ends[0])
        step = np.zeros_like(descent)
        damped = normal + damping * np.diag(np.diag(normal))
        step[free] = np.linalg.solve(damped[np.ix_(free, free)], descent[free])
        std = np.linalg.norm(self.rows, axis=1)[:, None] * self.level / np.sqrt(max(len(self.left) - self.count, 1))
        return step, np.tensordot(step, by_pole, 1) / std


@dataclass(frozen=True, eq=False)
class _Fit:
    """Coefficients of the functions 1 and i w (2, channels, d), their deviations, and the sum of residues.

    Whether modes below the lines show.
    """

    terms: Array
    std: Array
    modal: Array
    below: bool


def _fitted(at: AtPoles, errors: Array) -> _Fit:
    """The fit in the test's own units, the slopes per rad/s; `errors` (2m, r) of the poles are independent ones."""
    records = at.records
    turn = np.array([1.0, 1 / (2 * np.pi * records.freq[-1])])[:, None, None]
    of_terms = lambda x: x.reshape(2, records.driven, *x.shape[1:])  # noqa: E731
    of_poles = np.tensordot(at.by_poles[2], errors, (0, 0))
    return _Fit(
        turn * _by_sensor(records, of_terms(at.terms)),
        turn * _deviations(records, of_terms(at.rows), at.share * at.level, of_terms(of_poles)),
        _by_sensor(records, at.residues[:, : records.driven].sum(axis=0, keepdims=True))[0],
        _shows_below(at),
    )


def _shows_below(at: AtPoles) -> bool:
    """True where modes below the lines leave what falls as 1/w², poles held at the first line left out."""
    inside = (at.poles > at.ends[0])[: at.omega.size]
    records = at.records
    if not inside.all() and inside.any():
        at = AtPoles(records, at.poles.reshape(2, -1)[:, inside].ravel())
    tail = records.basis(np.maximum(2 * np.pi * records.freq, records.lines[0])[None] ** -2.0 + 0j, records.driven)
    beyond = np.linalg.qr(tail - at.basis.times(at.basis.answers(tail)))[0]
    gained, left = float(np.sum((beyond.T @ at.left) ** 2)), at.left
    noise = records.noise(left, at.count * left.shape[1])
    return gained > noise * beyond_chance(beyond.shape[1] * left.shape[1], CANDIDATES)


def _spikes(records: Records, left: Array) -> NDArray[np.bool_]:
    """Lines (n_freq,) at which a fit leaves a number far off those of its run; none where these are many."""
    size = np.hypot(*left.reshape(2, -1, left.shape[1]))
    level = np.stack([np.median(size[records.run == run], axis=0) for run in range(len(records.blocks))])
    level = np.maximum(level, ROUND_OFF * np.sqrt(records.size / records.data.size))
    spike = largest_modulus(CANDIDATES) / np.sqrt(np.log(2))  # medians of the modulus of noise
    far = records.largest(np.any(size > spike * level[records.run], axis=1)) > 0
    return far if np.count_nonzero(far) < _FEW * far.size else np.zeros_like(far)


def _by_sensor(records: Records, terms: Array) -> Array:
    """Coefficients (k, driven inputs, channels) in the test's own units, (k, n_sensors, d)."""
    plain = terms / records.channel
    if records.unit:
        return plain.reshape(len(terms), -1, records.n_sensors).transpose(0, 2, 1)
    return np.einsum("kic,di->kcd", plain, _of_base(records))


def _deviations(records: Records, rows: Array, level: Array, of_poles: Array) -> Array:
    """Deviations of the coefficients that rows (k, driven inputs, r) make of r independent errors of each channel.

    Beside them those that the poles' errors make, (k, driven inputs, channels, s) of s independent ones. Errors of the
    inputs, which are combinations of base directions, are not independent of one another.
    """
    if records.unit:
        both = np.hypot(np.linalg.norm(rows, axis=2)[:, :, None] * level, np.linalg.norm(of_poles, axis=3))
        return _by_sensor(records, both)
    to_base = lambda x: np.linalg.norm(np.einsum("di,ki...->kd...", _of_base(records), x), axis=-1)  # noqa: E731
    of_base = np.hypot(to_base(rows)[:, :, None] * level, to_base(of_poles)) / records.channel
    return of_base.swapaxes(1, 2)


def _of_base(records: Records) -> Array:
    """Combinations of the base directions (d, driven inputs) that the records were fitted on."""
    d = len(records.moving) - (records.base.shape[0] - records.driven)
    return records.moving[:d, : records.driven]
