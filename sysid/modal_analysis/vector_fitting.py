"""Poles from the data: number, frequency and damping of the modes, over all sensors and directions at once.

Relaxed vector fitting of the relative accelerations with common poles (Gustavsen and Semlyen 1999; Gustavsen
2006), in the basis ``g_k = w² / (w_k² - w² + 2 i zeta_k w_k w)`` so that errors weigh as accelerations, from more
poles than there can be modes. Those that do not earn their place are removed one by one (the rise of the squared error
without a pole against the noise), what stays is polished by variable projection over (log w, log zeta) with real
residues, further poles are tried beside and between them, and close ones that a single one can replace are merged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.relocation import relocate
from sysid.modal_analysis.residues import Records, ResidueFit, SubsetFits
from sysid.nlp import one_thread
from sysid.structure.structure import Array
from sysid.structure.thresholds import CANDIDATES, NEGLIGIBLE, ROUND_OFF, beyond_chance, round_off

_SPARE = 6  # poles beyond those expected: without spare ones noise moves true poles
_MANY = 100  # sensors: more of them are not taken to show a mode each unless the channels do
_FAR = 100.0  # times the error that may be, from which moving other poles too does not save a pole less
GUESS = 0.01  # damping ratio to begin with
RAZOR = 0.02  # of the distance of lines; half the width of a peak that answers for one bad line, not for a mode
DAMPED = 0.5  # a pole with more damping than this is no mode of a structure
_EDGE = 10.0  # times their ends, how far outside the lines a mode may lie: it answers for all that are there
_OF_GAIN = 0.1  # of the records' power, that a wrong gain explains at most
BESIDE = 0.1  # how far outside the lines a mode alone may lie, as a fraction of their ends


@dataclass(frozen=True, eq=False)
class Poles:
    """Modes that stand out of the data.

    Attributes
    ----------
    omega, ratios : (p,)
        Circular frequencies, rad/s, ascending, and damping ratios.
    residual : float
        Relative residual of the modal model with these poles and free real residues.
    """

    omega: Array
    ratios: Array
    residual: float


Monitor = Callable[[int, float], object]


class _Progress:
    """Count of iterations and the relative residual so far, which a monitor is called with."""

    def __init__(self, monitor: Monitor | None, records: Records) -> None:
        self.monitor: Monitor = monitor or (lambda iterations, residual: None)
        self.size = max(records.size, np.finfo(float).tiny)
        self.iterations, self.residual = 0, 1.0

    def step(self, squared_error: float) -> None:
        """Count an iteration that ended with this squared error, and call the monitor."""
        self.iterations += 1
        self.residual = float(np.sqrt(squared_error / self.size))
        self.tell()

    def tell(self) -> None:
        """Call the monitor, also within an iteration that takes long: what it raises stops the search."""
        self.monitor(self.iterations, self.residual)


def find_poles(test: Measurement, *, monitor: Monitor | None = None) -> Poles:
    """Find the modes that stand out of the noise.

    Parameters
    ----------
    test : Measurement
        Its lines must hold the modes; lines closer than the half-power bandwidth.
    monitor : callable, optional
        ``monitor(iterations, residual)`` is called in every iteration, with the relative residual so far, and within
        those that take long; what it raises ends the search and passes through.

    Raises
    ------
    InputError
        Too few lines for so many poles, or no mode at all.

    References
    ----------
    B. Gustavsen, A. Semlyen, IEEE Trans. Power Delivery 14 (1999) 1052-1061; B. Gustavsen, ibid. 21 (2006)
    1587-1592. G. H. Golub, V. Pereyra, SIAM J. Numer. Anal. 10 (1973) 413-432, with Kaufman's Jacobian (1975).
    """
    with one_thread():  # the same bits whatever else the machine does
        records = Records(test)
        return _find(records, _Progress(monitor, records), test.rigid_body)


def _find(records: Records, progress: _Progress, rigid_body: Array) -> Poles:
    wanted, most = _count(records, progress), _most_poles(records)
    # Where lines are few a spare pole or two must do.
    count = min(wanted, most) if most > wanted - _SPARE else wanted
    while count <= most:
        omega, ratios = _search(records, count, progress)
        if omega.size <= count - (_SPARE // 2 if count >= wanted else 1):
            break
        count += max(count // 2, _SPARE)  # too few were spare
    else:
        n = records.freq.size
        raise InputError(f"{n} lines are too few to look for {count} poles: state natural_frequencies or add lines")
    lines = records.lines
    below = omega < lines[0]
    if np.any(below) and np.any(below := below & _of_gains(records, omega, ratios, rigid_body)):
        omega, ratios = _settled(records, omega[~below], ratios[~below], progress)
    if not np.any((omega > (1 - BESIDE) * lines[0]) & (omega < (1 + BESIDE) * lines[-1])):
        raise InputError(
            "no mode stands out of the noise between these lines: state natural_frequencies or widen them, unless base "
            "and sensors are in different units (g and m/s²) or the spectra follow exp(-iwt) (take the conjugate)"
        )
    return _in_order(records, omega, ratios)


def _of_gains(records: Records, omega: Array, ratios: Array, rigid_body: Array) -> NDArray[np.bool_]:
    """True for poles that wrong gains show far below the lines, no mode, (m,): what else they explain is chance.

    That of one sensor, or those of the base, by which all sensors move as its rows of G (n_sensors, d) say.
    """
    fit, n = records.fit(omega, ratios), len(rigid_body)
    worth = np.sum(fit.whitened.reshape(omega.size, -1, n) ** 2, axis=1)
    others = np.sum(worth, axis=1) - np.max(worth, axis=1)
    noise = _noise(records, fit, omega.size)
    of_one = others < noise * beyond_chance(fit.residues[0].size * (n - 1) / n, CANDIDATES)
    by_base, spread = _of_base(records, rigid_body), fit.spread[:, : records.driven]
    turn = np.linalg.cholesky(np.einsum("kir,kjr->kij", spread, spread))
    whiten = lambda residues: np.linalg.solve(turn, residues).reshape(omega.size, -1)  # noqa: E731
    along = np.linalg.qr(np.stack([whiten(one[None]) for one in by_base], axis=2))[0]  # (m, entries, d)
    rows = whiten(fit.residues[:, : records.driven])
    rest = np.sum(rows**2, axis=1) - np.sum(np.einsum("ked,ke->kd", along, rows) ** 2, axis=1)
    of_base = (rest < noise * beyond_chance(rows.shape[1] - len(by_base), CANDIDATES)) & (n > 2)
    # What explains most of the records is a mode, and beside another that has no pole yet chance is taken for too much.
    return np.asarray((of_one | of_base) & (fit.gain < _OF_GAIN * records.size)) & (n > 1)


def _of_base(records: Records, rigid_body: Array) -> Array:
    """Residues (d, inputs, channels) by which all sensors move as with each direction of the base."""
    d = rigid_body.shape[1]
    if records.unit:  # each pair of sensor and direction is a channel
        each: Array = np.einsum("jk,cj->jkc", np.eye(d), rigid_body).reshape(d, 1, -1)
        return each * records.channel
    inputs = np.linalg.pinv(records.moving)[: records.driven, :d]
    return np.asarray(np.einsum("ij,cj->jic", inputs, rigid_body) * records.channel)


def poles_near(test: Measurement, omega: Array, window: float, *, monitor: Monitor | None = None) -> Poles:
    """Poles near stated frequencies: polished from there, each held within `window` (relative).

    Parameters
    ----------
    test : Measurement
    omega : (p,)
        Stated circular frequencies, rad/s.
    window : float
    monitor : callable, optional
        As in `find_poles`.

    Raises
    ------
    InputError
        Where a stated frequency is not one of the data.
    """
    records = Records(test)
    distinct = np.unique(omega)
    found, ratios = _polish(records, distinct, np.full(distinct.size, GUESS), _Progress(monitor, records))
    off = np.abs(np.log(found / distinct))
    fit = records.fit(found, ratios)
    # By its place, or by what the fit would lose without it.
    lacking = (off > np.log1p(window)) | (fit.gain < _least_gain(fit) * _noise(records, fit, found.size))
    if np.any(lacking):
        stated, ends = (
            ", ".join(f"{value:.5g}" for value in values[lacking] / (2 * np.pi)) for values in (distinct, found)
        )
        raise InputError(
            f"of the stated natural frequencies {stated} Hz does not stand out of the data (a fit from there ends at "
            f"{ends} Hz): the base may not move this mode"
        )
    return _in_order(records, found, ratios)


def _count(records: Records, progress: _Progress) -> int:
    """Number of poles to begin with."""
    progress.tell()
    sizes, _ = records.singular
    progress.tell()
    # Functions of frequency in the channels that stand out of the noise.
    independent = int(np.count_nonzero(sizes > max(1.5 * np.median(sizes), 1e-9 * sizes[0])))
    return max(min(records.n_sensors, max(2 * independent, _MANY)), independent) + _SPARE


def poles_of_any_damping(records: Records, *, monitor: Monitor | None = None) -> tuple[Array, Array]:
    """Circular frequencies and damping ratios of poles with residues in quadrature beside the real ones.

    They serve to continue records off the lines: none is tried beside or between them, and none is merged. None at all
    where the lines are too few to look for so many.

    Parameters
    ----------
    records : Records
    monitor : callable, optional
        As in `find_poles`.
    """
    progress = _Progress(monitor, records)
    with one_thread():
        count = _count(records, progress)
        while count <= _most_poles(records):
            omega, ratios = _settled(records, *_relocated(records, count, progress), progress, velocity=True)
            if omega.size <= count - _SPARE // 2 or count >= records.n_sensors + _SPARE:
                return omega, ratios
            count += max(count // 2, _SPARE)
    return np.empty(0), np.empty(0)


def poles_from(records: Records, omega: Array, ratios: Array, *, monitor: Monitor | None = None) -> tuple[Array, Array]:
    """The same as `poles_of_any_damping` from poles close by, ascending."""
    with one_thread():
        omega, ratios = _settled(records, omega, ratios, _Progress(monitor, records), velocity=True)
    order = np.argsort(omega)
    return omega[order], ratios[order]


def _most_poles(records: Records) -> int:
    """Number of poles that the lines determine, and the records residues of both kinds beside the motion at ends."""
    inputs = len(records.base) + records.driven
    return min((int(np.count_nonzero(records.freq)) - 1) // 2, (len(records.data) - 1) // inputs)


def _relocated(records: Records, count: int, progress: _Progress, rounds: int = 6) -> tuple[Array, Array]:
    """Poles that earn their place, from `count` that are spread over the lines, before they are polished.

    Some `rounds` at most: each moves all of them.
    """
    omega, ratios = np.geomspace(records.lines[0], records.lines[-1], count), np.full(count, GUESS)
    progress.tell()
    channels = records.principal(count)
    error = np.inf
    for _ in range(rounds):
        omega, ratios = relocate(records, channels, omega, ratios, progress.tell)
        before, error = error, records.fit(omega, ratios).squared_error
        progress.step(error)
        if _is_exact(records, error) or error > 0.97 * before:
            break
    # A pole of a structure with other than classical damping needs its velocity too, or more poles would replace it.
    return _prune(records, omega, ratios, progress, velocity=True)


def _search(records: Records, count: int, progress: _Progress) -> tuple[Array, Array]:
    """Poles that stand out of the noise, from `count` that are spread over the lines."""
    first = _relocated(records, count, progress)
    poles = _settled(records, *first, progress)
    if poles[0].size == 0:
        return poles
    by_velocity = records.fit(*first, velocity=True).squared_error
    if _is_exact(records, by_velocity) and not _is_exact(records, records.fit(*poles).squared_error):
        return _settled(records, *first, progress, velocity=True)  # records without noise, of other damping: no others
    most = poles[0].size + count
    while poles[0].size < most and (more := _with_another(records, *poles, progress)):
        poles = more
    poles = _merged(records, *poles, progress)
    criterion = _criterion(records, poles, velocity=False)
    if _criterion(records, poles, velocity=True) < criterion:
        with_velocity = _settled(records, *first, progress, velocity=True)
        if with_velocity[0].size and _criterion(records, with_velocity, velocity=True) < criterion:
            return with_velocity
    return poles


def _is_exact(records: Records, squared_error: float) -> bool:
    """True where a fit leaves no more than round-off."""
    return squared_error < round_off(len(records.data)) ** 2 * records.size


def _criterion(records: Records, poles: tuple[Array, Array], *, velocity: bool) -> float:
    """Schwarz's criterion of the fit on these poles: the lower, the better for the unknowns it takes."""
    fit = records.fit(*poles, velocity=velocity)
    unknowns = poles[0].size * (fit.residues[0].size + 2)
    error = max(fit.squared_error / records.size, ROUND_OFF**2)
    return float(records.data.size * np.log(error) + unknowns * np.log(records.data.size))


def _merged(records: Records, omega: Array, ratios: Array, progress: _Progress) -> tuple[Array, Array]:
    """Poles without those that a neighbour replaces once it may move: close poles can exchange their residues."""
    order = np.argsort(omega)
    omega, ratios = omega[order], ratios[order]
    k = 0
    while k < omega.size:
        progress.tell()
        close = np.flatnonzero(np.abs(np.log(omega / omega[k])) < ratios[k] / 2)
        k += 1
        if close.size > 1:
            fit = records.fit(omega, ratios)
            allowed = _least_gain(fit) * _noise(records, fit, omega.size)
            if fit.rise_with_one_less(close) <= _FAR * allowed:
                fewer = _polish(records, np.delete(omega, k - 1), np.delete(ratios, k - 1), progress)
                if records.fit(*fewer).squared_error - fit.squared_error <= allowed:
                    (omega, ratios), k = fewer, k - 1
    return omega, ratios


def _settled(
    records: Records, omega: Array, ratios: Array, progress: _Progress, *, velocity: bool = False
) -> tuple[Array, Array]:
    """Poles polished, and pruned until all that stay earn their place."""
    size = omega.size + 1
    while 0 < omega.size < size:
        size = omega.size
        omega, ratios = _polish(records, omega, ratios, progress, velocity=velocity, until_lost=not velocity)
        omega, ratios = _prune(records, omega, ratios, progress, velocity=velocity)
    return omega, ratios


def _with_another(records: Records, omega: Array, ratios: Array, progress: _Progress) -> tuple[Array, Array] | None:
    """The poles and one more, settled; None where what they leave needs none.

    Candidates lie beside each pole, for two modes that share it, between the poles, with as many as sensors just above
    the lines too, where a strong mode may have lost its pole, and, with modes below the lines, where most is left, as
    they may have cost another its own. Damping that is not classical needs no pole: one more must fit what the
    velocities of the poles cannot, or more than they all can.
    """
    shift = np.concatenate([1 + ratios, 1 - ratios, 1 + 3 * ratios, 1 - 3 * ratios])
    without_velocity, with_velocity = records.fit(omega, ratios), records.fit(omega, ratios, velocity=True)
    lines = records.lines
    many = omega.size >= records.n_sensors  # of those that a search begins with none may have been left above the lines
    between = np.geomspace(omega.min(), max(omega.max(), many * 1.2 * lines[-1]), 4 * omega.size)
    if omega.min() < lines[0]:
        left = np.sum(np.abs(records.in_runs(without_velocity.left)) ** 2, axis=(0, 2))[-lines.size :]
        between = np.append(between, lines[np.argmax(np.minimum(left[1:], left[:-1]))])  # one line alone is no mode
    at = np.concatenate([np.tile(omega, 4) * shift, between])
    loss = np.concatenate([np.tile(ratios, 4), np.full(between.size, np.median(ratios))])
    at, loss = at[at > 0], loss[at > 0]
    plain = records.functions(at, loss)
    least_left = NEGLIGIBLE**2 * plain.squares()
    least = _least_gain(without_velocity)
    tried = -1
    for fit, to_beat in ((with_velocity, np.inf), (without_velocity, with_velocity.squared_error)):
        progress.tell()
        trial, products = fit.beside(plain)
        left = trial.squares()
        gain = np.sum(products**2, axis=1) / np.where(left > least_left, left, np.inf)
        gain = gain.reshape(at.size, -1).sum(axis=1)
        best = int(np.argmax(gain))
        if best == tried or gain[best] <= least * _noise(records, fit, omega.size):
            continue
        tried = best
        more = _settled(records, np.append(omega, at[best]), np.append(ratios, loss[best]), progress)
        # Of as many poles as before one above the lines has taken another's place, if what is left falls beyond chance.
        grown, least_fall = more[0].size > omega.size, least * _noise(records, without_velocity, omega.size)
        most = min(to_beat, (without_velocity.squared_error - least_fall, np.inf)[grown])
        fewest = omega.size + 1 - (many and at[best] > lines[-1])
        if more[0].size >= fewest and records.fit(*more).squared_error < most:
            return more
    return None


def _in_order(records: Records, omega: Array, ratios: Array) -> Poles:
    order = np.argsort(omega)
    left = float(np.sqrt(records.fit(omega, ratios).squared_error / records.size))
    return Poles(omega[order], ratios[order], left)


def _least_gain(fit: ResidueFit) -> float:
    """Least fall of the squared error by which a pole earns its place, in units of the noise's variance."""
    return beyond_chance(fit.residues[0].size + 2, CANDIDATES)  # real parameters that come with a pole


def _noise(records: Records, fit: ResidueFit, m: int) -> float:
    """Variance of a record's real number about the fit of m poles."""
    return records.noise(fit.left, m * (fit.residues[0].size + 2))


def _prune(
    records: Records, omega: Array, ratios: Array, progress: _Progress, *, velocity: bool = False
) -> tuple[Array, Array]:
    """Poles without those that do not earn their place."""
    kept = worthwhile(records, omega, ratios, progress.step, velocity=velocity)
    return omega[kept], ratios[kept]


def worthwhile(
    records: Records, omega: Array, ratios: Array, step: Callable[[float], object] = lambda _: None, *,
    velocity: bool = False, held: int = 0,
) -> NDArray[np.intp]:  # fmt: skip
    """Numbers of the poles of which each lowers the squared error by far more than noise would, ascending.

    The others are left out one by one, the least useful first, but for so many at the end that are `held`; `step` is
    called with the squared error that those left give.
    """
    kept = np.flatnonzero(_may_be_modes(records, omega, ratios))  # others go first, whatever they explain
    of, subsets = kept, None
    while kept.size > held:
        if subsets is None or 2 * kept.size < of.size:
            of, subsets = kept, SubsetFits(records, omega[kept], ratios[kept], velocity=velocity)
        worth, squared_error = subsets.worth(np.searchsorted(of, kept))
        step(squared_error)
        least = int(np.argmin(worth[: kept.size - held]))
        if worth[least] > beyond_chance(subsets.per_pole, CANDIDATES):
            break
        kept = np.delete(kept, least)
    return kept


def _may_be_modes(records: Records, omega: Array, ratios: Array) -> NDArray[np.bool_]:
    """Poles that are neither far outside the lines, nor damped as no structure is, nor of a single bad line, (m,)."""
    lines = records.lines
    inside = (omega > lines[0] / _EDGE) & (omega < _EDGE * lines[-1]) & (ratios < DAMPED)
    broad = ratios * omega > RAZOR * np.interp(omega, lines, np.gradient(lines))
    return inside & (broad | (omega > lines[-1]))


def _lost(records: Records, omega: Array, ratios: Array) -> NDArray[np.bool_]:
    """Poles within the lines that can be no modes, (m,)."""
    first, last = records.lines[[0, -1]]
    return (omega >= first) & (omega <= last) & ~_may_be_modes(records, omega, ratios)


def _polish(
    records: Records, omega: Array, ratios: Array, progress: _Progress, *, velocity: bool = False,
    until_lost: bool = False, steps: int = 100,
) -> tuple[Array, Array]:  # fmt: skip
    """Variable projection: Levenberg-Marquardt `steps` at most over (log w, log zeta), the residues eliminated.

    With `until_lost` it ends where a pole within the lines can be no mode any more: it is to go before the others are
    worth polishing. From beyond the lines poles come back.
    """
    m = omega.size
    p = np.log(np.concatenate([omega, ratios]))
    damping, failed = 1e-3, np.array(np.inf)  # the step from here that failed last
    fit = records.fit(omega, ratios, velocity=velocity)
    H, slope = _projected(records, p, fit, velocity)
    for _ in range(steps):
        error = fit.squared_error
        progress.step(error)
        if _is_exact(records, error):
            break
        step = np.clip(np.linalg.solve(H + damping * np.diag(np.diag(H)), slope), -0.5, 0.5)
        if np.linalg.norm(step - failed) < 1e-3 * np.linalg.norm(step):
            damping *= 10
            continue
        trial = p + step
        trial[m:] = np.clip(trial[m:], np.log(1e-6), np.log(0.99))
        other = records.fit(*_poles(trial), velocity=velocity)
        if other.squared_error < error:
            p, fit, damping = trial, other, max(damping / 10, 1e-12)
            if error - fit.squared_error < NEGLIGIBLE * error or (until_lost and np.any(_lost(records, *_poles(p)))):
                break
            H, slope = _projected(records, p, fit, velocity)
            failed = np.array(np.inf)
        else:
            failed, damping = step, 10 * damping
            if damping > 1e6:
                break
    return _poles(p)


def _poles(p: Array) -> tuple[Array, Array]:
    """Circular frequencies and damping ratios of log poles (2m,)."""
    omega, ratios = np.exp(p.reshape(2, -1))
    return omega, ratios


def _projected(records: Records, p: Array, fit: ResidueFit, velocity: bool) -> tuple[Array, Array]:
    """Gauss-Newton matrix (2m, 2m) and descent direction of the projected problem at the `fit` on log poles `p`."""
    slopes = records.pole_slopes(*_poles(p), velocity=velocity)
    beside, products = fit.beside(slopes)
    return beside.pole_equations(products, fit.residues)
