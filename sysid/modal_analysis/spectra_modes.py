"""Modes of plain spectra: fit of rank-one modes at the poles of a test, as many at each pole as its residue needs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sysid.errors import SolverError
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.coupled_spectra import with_couplings_of_lines
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.modal_fit import (
    STATIC_POLE,
    ModalFit,
    Modes,
    Weights,
    rank_one,
    separate_poles,
    too_few,
    weigh,
)
from sysid.modal_analysis.residues import Records, ResidueFit, SubsetFits, independent, linear_residues
from sysid.modal_analysis.response import modes_above
from sysid.modal_analysis.spectra_model import SpectraModel, fit_spectra, weights_at
from sysid.modal_analysis.vector_fitting import Poles, worthwhile
from sysid.nlp import IterationMonitor
from sysid.structure.structure import Array
from sysid.structure.thresholds import CANDIDATES, EXACT, ROUND_OFF, beyond_chance

Integers = NDArray[np.intp]

_TRIAL = 60  # iterations of a fit with one more pole above the lines
_SECONDS = 8e-9  # of a processor, for a line and the square of its slopes


def fit_modes_of_lines(
    modal: ModalEstimate, poles: Poles, unit: Array, *, count: int | None = None,
    inside: NDArray[np.bool_] | bool = True, residual: bool = False, monitor: IterationMonitor, max_iterations: int,
) -> ModalEstimate:  # fmt: skip
    """Fit modes at the poles of a test whose lines stand for themselves: its estimate with these, ascending.

    Parameters
    ----------
    modal : ModalEstimate
        Of the test, without modes.
    poles : Poles
        Close by.
    unit : (d,)
        Size of participations, kg^½, m kg^½ for rotations.
    count : int or None
        Of modes at the poles that are `inside`, one each at those whose loss the records would feel most, further ones
        where their residues need them; as many as the records need where None.
    inside : (p,) or True
        Poles of the structure's modes; the others stand for modes beyond the lines, and are not counted.
    residual : bool
        Let modes stand for all that are above the lines where the records ask for it.
    monitor : IterationMonitor
    max_iterations : int
        Of each fit.

    Returns
    -------
    ModalEstimate
        With `lacking`, and without modes, where the records cannot fix them.

    Raises
    ------
    InputError
        Where the base force has the wrong sign.
    SolverError
        Where the time does not suffice.
    """
    fit = ModeFit(modal.records, poles, unit, monitor, max_iterations)
    if count is not None:
        fit, ours, counts = fit.at_strongest(count, np.broadcast_to(inside, poles.omega.size))
        if counts[ours].sum() < count:
            return replace(modal, lacking=too_few(counts[ours].sum(), count))
    if not monitor.allows(fit.seconds):
        raise SolverError(
            f"a fit of {fit.poles.omega.size} modes takes some {fit.seconds:.1g} s to set up: too little time, "
            "nothing is identified"
        )
    lacking = fit.lacking
    if lacking:
        return replace(modal, lacking=lacking)
    found = fit.best() if count is None else fit.of_count(counts, ours)
    if residual:
        found = fit.with_static(found)
    found = fit.with_weights_of_runs(found, pruned=count is None)
    if residual:
        found = fit.with_poles_above(found)
    modes = found.modes.at(np.argsort(found.modes.omega, kind="stable"))
    modal = replace(
        modal, **modes._asdict(), rigid=found.rigid, fit=replace(found, modes=modes), static=found.static
    )  # fmt: skip
    return with_couplings_of_lines(modal, monitor, max_iterations)


def strongest_poles(records: Records, poles: Poles, count: int, inside: NDArray[np.bool_]) -> Integers:
    """Numbers of so many poles `inside` (p,), those whose loss the records would feel most, and of all others."""
    subsets, kept = SubsetFits(records, poles.omega, poles.ratios), np.arange(inside.size)
    while np.count_nonzero(inside[kept]) > count:
        worth, _ = subsets.worth(kept)
        kept = np.delete(kept, np.argmin(np.where(inside[kept], worth, np.inf)))
    return kept


@dataclass(frozen=True, eq=False)
class ModeFit:
    """Fit of rank-one modes at the poles of a test; a pole whose residue needs it stands for several modes.

    Its fields are arguments of `fit_modes_of_lines`.
    """

    test: Measurement
    poles: Poles
    unit: Array
    monitor: IterationMonitor
    max_iterations: int
    static: int = 0
    """So many modes, all at the last pole, which is held: see `ModalFit`."""
    grows: bool = True
    """Poles within the lines may go, or take further modes, as the records need; False where they are asked for."""

    @cached_property
    def records(self) -> Records:
        """Records that residues are fitted to."""
        return Records(self.test)

    def best(self) -> ModalFit:
        """The fit of as many modes as the records need.

        Modes of rank one may have dragged a pole to where noise explains it: it is left out.
        """
        best = self._best_at_all()
        if not self._goes_on or best.of_accelerations <= EXACT:
            return best
        omega, ratios = _poles_of(best)
        kept = worthwhile(self.records, omega, ratios)
        if kept.size in (0, omega.size):
            return best
        return replace(self, poles=replace(self.poles, omega=omega[kept], ratios=ratios[kept])).best()

    def _best_at_all(self) -> ModalFit:
        """The fit of as many modes as the records need at all poles."""
        test, records, poles = self.test, self.records, self.poles
        m, n, d = poles.omega.size, test.n_sensors, test.n_base
        single = np.ones(m, dtype=int)
        best = self._grown(self.of_modes(single), single)
        # Modes of rank one may have dragged poles away from where several modes share one.
        free, noise = self._free_residues(poles.omega, poles.ratios)
        excess = best.of_accelerations**2 * records.size - free.squared_error
        ranks = free.ranks(noise, n, d)
        # An exact fit lacks nothing; round-off in residues of poles that nearly coincide would ask for more modes.
        lacks = best.of_accelerations > EXACT and excess > noise * beyond_chance(m * (n - 1) * (d - 1), CANDIDATES)
        wanting = lacks or ranks.sum() < best.modes.omega.size
        if self._goes_on and wanting and np.any(ranks > 1):
            other = self._grown(self.of_modes(ranks), ranks)
            more = other.modes.omega.size - best.modes.omega.size
            gained = (best.of_accelerations**2 - other.of_accelerations**2) * records.size / noise
            if gained > np.sign(more) * beyond_chance(abs(more) * (n + d), CANDIDATES):
                best = other
        return best

    def with_static(self, best: ModalFit) -> ModalFit:
        """The fit, with as many modes as base directions at a far pole, held, where it leaves what modes above add.

        Their answer is theirs at low frequency, of all together, with a mass that is positive: what is left grows as
        w². So it is where poles above the lines, next to exchangeable, came to no end. Those as far give way, and so do
        poles, and second modes at a pole, that stood for what these modes explain.
        """
        test, (_, d) = self.test, self.test.rigid_body.shape
        if not self._goes_on or (best.status == "settled" and not misses_static(test, self.records, *_poles_of(best))):
            return best
        (times, ratio), last = STATIC_POLE, 2 * np.pi * float(test.freq[-1])
        omega, ratios = _poles_of(best)
        near, far = omega < times * last, times * last * (1 + ROUND_OFF)
        counts = np.ones_like(omega, dtype=int) if self.grows else np.bincount(separate_poles(best.modes)[1])
        omega, ratios = np.append(omega[near], times * last), np.append(ratios[near], ratio)
        counts = np.append(counts[near], test.n_base)
        while True:
            inside, more = np.count_nonzero(omega < last), self._beside_static(omega, ratios, counts)
            omega, ratios = _poles_of(more)
            kept = worthwhile(self.records, omega, ratios, held=1)
            kept = kept[omega[kept] < far]  # a pole that passes the static modes stands for what they do
            if not self.grows:  # those within the lines are asked for
                kept = np.union1d(kept, np.flatnonzero(omega <= last))
            if kept.size == omega.size:
                break
            omega, ratios, counts = omega[kept], ratios[kept], counts[kept]
        # One that comes into the lines is no mode.
        if more.status != "settled" or np.count_nonzero(omega < last) > inside:
            return best
        unknowns = (more.modes.omega.size - best.modes.omega.size) * (test.n_sensors + d)
        gained = (best.residual**2 - more.residual**2) * self.records.size
        noise = self._free_residues(omega, ratios)[1]
        return more if gained > np.sign(unknowns) * beyond_chance(max(abs(unknowns), 1)) * noise else best

    def _beside_static(self, omega: Array, ratios: Array, counts: Integers) -> ModalFit:
        """Fit of so many modes at each of these poles, of which the last is held."""
        fit = replace(self, poles=replace(self.poles, omega=omega, ratios=ratios), static=self.test.n_base)
        found = fit.of_modes(counts)
        return fit._grown(found, counts) if self.grows else found

    def at_strongest(self, count: int, inside: NDArray[np.bool_]) -> tuple[ModeFit, NDArray[np.bool_], Integers]:
        """The same at so many of the poles `inside`, those whose loss the records would feel most, and at all others.

        Returns
        -------
        fit : ModeFit
        inside : (p,)
            Of its poles.
        counts : (p,)
            Modes at each: where there are fewer poles, further ones where residues need them, at most as many as these.
        """
        kept = strongest_poles(self.records, self.poles, count, inside)
        fit, counts, inside = self._at(kept), np.ones(kept.size, dtype=int), inside[kept]
        lacking = count - np.count_nonzero(inside)
        if lacking > 0:
            free, noise = fit._free_residues(fit.poles.omega, fit.poles.ratios)
            s = np.linalg.svd(free.whitened.reshape(kept.size, -1, self.test.n_sensors), compute_uv=False)[:, 1:]
            ranks = free.ranks(noise, *self.test.rigid_body.shape)
            s[(np.arange(s.shape[1]) >= ranks[:, None] - 1) | ~inside[:, None]] = 0.0
            strongest = np.argsort(-s, axis=None)[: min(lacking, np.count_nonzero(s))]
            counts += np.bincount(strongest // max(s.shape[1], 1), minlength=kept.size)
        return fit, inside, counts

    def of_count(self, counts: Integers, inside: NDArray[np.bool_]) -> ModalFit:
        """Fit of so many modes at each pole; of the poles that are not `inside` none may come into the lines."""
        found = self.of_modes(counts)
        first, last = 2 * np.pi * self.test.freq[[0, -1]]
        omega = found.modes.omega[separate_poles(found.modes)[0]]
        stays = inside | (omega < first) | (omega > last)
        return found if np.all(stays) else self._at(np.flatnonzero(stays)).of_count(counts[stays], inside[stays])

    def _at(self, kept: Integers) -> ModeFit:
        """The same at some of the poles, which are asked for."""
        poles = replace(self.poles, omega=self.poles.omega[kept], ratios=self.poles.ratios[kept])
        return replace(self, poles=poles, grows=False)

    @property
    def lacking(self) -> str:
        """Why these records cannot fix the modes; empty where they can."""
        test, moving = self.test, independent(self.test.base).shape[1]
        if moving < test.n_base:
            return (
                f"the base moves in only {moving} of {test.n_base} independent directions: add runs that move the "
                "others, or describe the test by the directions that move"
            )
        m = self.poles.omega.size
        unknowns = m * (test.n_sensors + test.n_base + 1)
        if 2 * test.response.size < unknowns or len(self.records.data) < m * len(self.records.base):
            return (
                f"{test.freq.size} lines ({2 * test.response.size} measured numbers) cannot fix {unknowns} unknowns: "
                "add lines or runs"
            )
        return ""

    @property
    def _goes_on(self) -> bool:
        """True where nobody has stopped the fit, and there is time for another one."""
        monitor = self.monitor
        return monitor.stopped is None and not monitor.is_over and monitor.allows(self.seconds)

    @property
    def seconds(self) -> float:
        """About how long it takes until a fit has its first iterate."""
        test = self.test
        return float(_SECONDS * (self.poles.omega.size * (test.n_base + 2)) ** 2 * test.n_runs * test.freq.size)

    def _grown(self, best: ModalFit, multiplicity: Integers) -> ModalFit:
        """The fit of so many modes at each pole, or one with more where their free residues call for it."""
        while self._goes_on and (lacking := self._lacking_rank(best, multiplicity)) is not None:
            more = multiplicity.copy()
            more[lacking] += 1
            again = self.of_modes(more)
            gained = (best.of_accelerations**2 - again.of_accelerations**2) * self.records.size
            noise = self._free(again, more)[1]
            if gained < beyond_chance(self.test.n_sensors + self.test.n_base, CANDIDATES) * noise:
                break
            best, multiplicity = again, more
        return best

    def _free(self, end: ModalFit, multiplicity: Integers) -> tuple[ResidueFit, float]:
        """Free residues at a fit's poles, and the variance of a real number of the records about them."""
        first = np.cumsum(multiplicity) - multiplicity
        return self._free_residues(end.modes.omega[first], end.modes.ratios[first])

    def _free_residues(self, omega: Array, ratios: Array) -> tuple[ResidueFit, float]:
        """Free residues at poles, and the variance of a real number of the records about them."""
        free = self.records.fit(omega, ratios)
        return free, self.records.noise(free.left, free.residues.size)

    def _lacking_rank(self, best: ModalFit, multiplicity: Integers) -> int | None:
        """The pole whose free residue most lacks in the modes that it has; None where none does."""
        n, d = self.records.n_sensors, self.records.n_base
        if n < 2 or d < 2 or best.of_accelerations <= EXACT:
            return None
        free, noise = self._free(best, multiplicity)
        freedom = float(np.sum((n - multiplicity) * (d - multiplicity)))
        excess = best.of_accelerations**2 * self.records.size - free.squared_error
        if excess < noise * beyond_chance(freedom, CANDIDATES):
            return None
        s = np.linalg.svd(free.whitened.reshape(multiplicity.size, -1, n), compute_uv=False)
        left = np.array([np.sum(row[r:] ** 2) for row, r in zip(s, multiplicity, strict=True)])
        left[multiplicity >= min(n, d)] = 0.0
        return int(np.argmax(left)) if left.max() > 0 else None

    def of_modes(self, multiplicity: Integers) -> ModalFit:
        """Fit with so many modes at each pole, from its free residue's largest singular values."""
        test, poles, unit = self.test, self.poles, self.unit
        residues, _ = linear_residues(test, poles.omega, poles.ratios)
        pole = np.repeat(np.arange(poles.omega.size), multiplicity)
        rank = np.concatenate([np.arange(r) for r in multiplicity])
        u, s, vt = np.linalg.svd(residues * unit)  # participations of order one whatever the direction's unit
        root = np.sqrt(s[pole, rank])
        phi, gamma = u[pole, :, rank].T * root, vt[pole, rank] * root[:, None] / unit
        modes = Modes(phi, gamma, poles.omega[pole], poles.ratios[pole])
        rigid = np.diag(unit**2)
        if test.force is not None:
            t, rigid = weigh(test, modes)
            modes = modes._replace(phi=modes.phi / np.sqrt(t), gamma=modes.gamma * np.sqrt(t)[:, None])
        return self._from(modes, rigid, self.static, together=not self.records.unit)

    def _from(self, modes: Modes, rigid: Array, static: int, *, together: bool) -> ModalFit:
        return fit_spectra(
            self.test, modes, rigid, static=static, together=together, monitor=self.monitor,
            max_iterations=self.max_iterations,
        )  # fmt: skip

    def with_weights_of_runs(self, best: ModalFit, *, pruned: bool) -> ModalFit:
        """The fit with the weights that channels have in each run, where those of all runs were taken together.

        Where it is `pruned`, without modes that were taken for some by the other weights.
        """
        if self.records.unit or not self._goes_on:
            return best
        own = weights_at(self.test, *_poles_of(best))
        every = own.sensors if own.force is None else np.hstack([own.sensors, own.force])
        if np.allclose(every, every[0], rtol=ROUND_OFF, atol=0.0):
            return best
        best = self._from(best.modes, best.rigid, best.static, together=False)
        least = beyond_chance(self.test.n_sensors + self.test.n_base + 1, CANDIDATES)
        while pruned and self._goes_on and best.of_accelerations > EXACT and best.modes.omega.size > best.static + 1:
            fewer = self._from(self._without_least(best, own), best.rigid, best.static, together=False)
            if fewer.residual**2 - best.residual**2 > least * self._variance(best):
                break
            best = fewer
        return best

    def with_poles_above(self, best: ModalFit) -> ModalFit:
        """The fit with further poles above the lines, beside one or static modes, while the records ask for one.

        They are no modes, and need not stand out of chance: what they explain pulls at the modes in the lines. Akaike's
        criterion decides.
        """
        test, last = self.test, 2 * np.pi * float(self.test.freq[-1])
        far, least = STATIC_POLE[0] * last * (1 + ROUND_OFF), 2 * (test.n_sensors + test.n_base + 2)
        short = replace(self, max_iterations=min(self.max_iterations, _TRIAL))
        while self._goes_on and best.of_accelerations > EXACT:
            omega, ratios = _poles_of(best)
            inside = np.count_nonzero(omega <= last)
            if not 0 < omega.size - inside < max(test.n_base, 2) + bool(best.static):
                break
            modes = self._with_mode(best, *self._most_above(omega, ratios))
            more = short._from(modes, best.rigid, best.static, together=False)
            stays = (np.count_nonzero(_poles_of(more)[0] <= last) == inside) & np.all(more.modes.omega < far)
            if more.status != "settled" or not stays:
                break
            if self._left(best, more) - more.residual**2 < least * self._variance(more):
                break
            best = more
        return best

    def _left(self, fit: ModalFit, other: ModalFit) -> float:
        """Weighted squared error of a fit by the weights of another."""
        assert other.weights is not None
        model = SpectraModel(self.test, other.weights, separate_poles(fit.modes)[1])
        return model.chi2(model.with_best_shapes(fit.modes, fit.rigid), model.levels)

    def _most_above(self, omega: Array, ratios: Array) -> tuple[float, float]:
        """The pole above the lines, below the static modes', that explains most beside others: rad/s and ratio."""
        last = 2 * np.pi * float(self.test.freq[-1])
        at, loss = last * np.geomspace(1, STATIC_POLE[0], 20)[1:-1], float(np.median(ratios))
        trial, products = self.records.fit(omega, ratios).beside(self.records.functions(at, np.full(at.size, loss)))
        gain = np.sum(products**2, axis=1) / trial.squares()
        return float(at[np.argmax(gain.reshape(at.size, -1).sum(axis=1))]), loss

    def _with_mode(self, best: ModalFit, omega: float, ratio: float) -> Modes:
        """Modes of a fit with one more at this pole, before the static ones."""
        first, before = separate_poles(best.modes)[0], best.modes.omega.size - best.static
        poles = np.append(best.modes.omega[first], omega), np.append(best.modes.ratios[first], ratio)
        residue = linear_residues(self.test, *poles)[0][-1:] * self.unit
        added = rank_one(residue, np.array([omega]), np.array([ratio]), np.linalg.norm(residue, 2, (1, 2)) ** 0.5)
        added = added._replace(gamma=added.gamma / self.unit)
        modes = best.modes.at(slice(before)).joined(added).joined(best.modes.at(slice(before, None)))
        if self.test.force is not None:
            modes.gamma[before] *= np.sqrt(weigh(self.test, modes)[0][before])
        return modes

    def _without_least(self, best: ModalFit, weights: Weights) -> Modes:
        """Modes of a fit without the one whose loss the records would feel least, all others as they are."""
        modes, m = best.modes, best.modes.omega.size
        rise = []
        for k in range(m - best.static):
            others = modes.at(np.arange(m) != k)
            model = SpectraModel(self.test, weights, separate_poles(others)[1])
            rise.append(model.chi2(model.with_best_shapes(others, best.rigid), model.levels))
        return modes.at(np.arange(m) != np.argmin(rise))

    def _variance(self, best: ModalFit) -> float:
        """Share of one real number of the records in what a fit leaves, as it affects smooth functions."""
        test, (free, noise) = self.test, self._free_residues(*_poles_of(best))
        shared = noise / self.records.variance(float(np.sum(free.left**2)), free.residues.size)
        numbers = 2 * test.outputs.size
        unknowns = best.modes.omega.size * (test.n_sensors + test.n_base + 1)
        return shared * best.residual**2 / max(numbers - unknowns, 1)


def _poles_of(fit: ModalFit) -> tuple[Array, Array]:
    """Circular frequencies and damping ratios of the poles of a fit, each once, in its order."""
    modes = fit.modes.at(separate_poles(fit.modes)[0])
    return modes.omega, modes.ratios


def misses_static(test: Measurement, records: Records, omega: Array, ratios: Array) -> bool:
    """True where what free residues leave at poles grows as w², beyond chance; `records` are those of the test.

    Beside a constant, which a wrong gain makes.
    """
    free = records.fit(omega, ratios)
    rise = modes_above(test.freq, test.freq[-1])[:1]
    beside = np.linalg.qr(np.hstack([free.Q, records.basis(np.ones_like(rise) + 0j)]))[0]
    rising = records.basis(rise + 0j)
    along = np.linalg.qr(rising - beside @ (beside.T @ rising))[0].T @ free.left
    noise = records.noise(free.left, free.residues.size)
    return bool(np.sum(along**2) > max(noise * beyond_chance(along.size), EXACT**2 * records.size))
