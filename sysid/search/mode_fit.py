"""Fit of rank-one modes at the poles of the data, as many at each pole as its residue needs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from sysid.errors import InputError, SolverError
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_fit import ModalFit, Modes, separate_poles
from sysid.modal_analysis.modal_masses import weigh
from sysid.modal_analysis.residues import (
    Records,
    ResidueFit,
    SubsetFits,
    independent,
    linear_residues,
)  # fmt: skip
from sysid.modal_analysis.spectra_model import fit_spectra
from sysid.modal_analysis.vector_fitting import Poles
from sysid.models.spectrum import SOLVED
from sysid.models.unknowns import lower_of, upper_of
from sysid.nlp import IterationMonitor, NonlinearProgram
from sysid.problem.prepared import Prepared
from sysid.search.modal_program import Spectrum, Ties, solve_modes
from sysid.search.modal_scaling import stated_totals
from sysid.search.strategy import DoesNotApplyError
from sysid.structure.structure import Array
from sysid.structure.thresholds import AS_GOOD, CANDIDATES, EXACT, beyond_chance

Integers = NDArray[np.intp]

_SECONDS = 8e-9  # of a processor, for a line and the square of its slopes
_AGREES = 0.01  # relative; a stated total that the base force weighs within this is held in the fit


@dataclass(frozen=True, eq=False)
class ModeFit:
    """Fit of rank-one modes at the poles of a test; a pole whose residue needs it stands for several modes.

    Attributes
    ----------
    test : Measurement
    poles : Poles
    unit : (d,)
        Size of participations, kg^½, m kg^½ for rotations.
    monitor : IterationMonitor
    max_iterations : int
        Of each run of IPOPT.
    """

    test: Measurement
    poles: Poles
    unit: Array
    monitor: IterationMonitor
    max_iterations: int

    @cached_property
    def records(self) -> Records:
        """Records that residues are fitted to."""
        return Records(self.test)

    def best(self) -> ModalFit:
        """The fit, its modes in ascending order.

        Raises
        ------
        DoesNotApplyError
            Fewer measured numbers than unknowns, or base directions that do not move by themselves.
        """
        self._check()
        test, records, poles = self.test, self.records, self.poles
        m, n, d = poles.omega.size, test.n_sensors, test.n_base
        single = np.ones(m, dtype=int)
        best = self._grown(self._with(single), single)
        # Modes of rank one may have dragged poles away from where several modes share one.
        free = records.fit(poles.omega, poles.ratios)
        noise = records.noise(free.left, free.residues.size)
        excess = best.of_accelerations**2 * records.size - free.squared_error
        ranks = free.ranks(noise, n, d)
        # An exact fit lacks nothing; round-off in residues of poles that nearly coincide would ask for more modes.
        lacks = best.of_accelerations > EXACT and excess > noise * beyond_chance(m * (n - 1) * (d - 1), CANDIDATES)
        wanting = lacks or ranks.sum() < best.modes.omega.size
        if self._goes_on and wanting and np.any(ranks > 1):
            other = self._grown(self._with(ranks), ranks)
            more = other.modes.omega.size - best.modes.omega.size
            gained = (best.of_accelerations**2 - other.of_accelerations**2) * records.size / noise
            if gained > np.sign(more) * beyond_chance(abs(more) * (n + d), CANDIDATES):
                best = other
        return _ascending(best)

    def of_strongest(self, count: int) -> ModalFit:
        """The fit of one mode at each of so many poles: those whose loss the records would feel most.

        Raises
        ------
        InputError
            Where there are not so many poles.
        DoesNotApplyError
            As in `best`.
        """
        poles = self.poles
        if count > poles.omega.size:
            raise InputError(f"{poles.omega.size} modes stand out of the noise, fewer than the {count} asked for")
        subsets, kept = SubsetFits(self.records, poles.omega, poles.ratios), np.arange(poles.omega.size)
        while kept.size > count:
            worth, _ = subsets.worth(kept)
            kept = np.delete(kept, np.argmin(worth))
        fit = replace(self, poles=replace(poles, omega=poles.omega[kept], ratios=poles.ratios[kept]))
        fit._check()
        return _ascending(fit._with(np.ones(count, dtype=int)))

    @property
    def _goes_on(self) -> bool:
        """True where nobody has stopped the fit, and there is time for another one."""
        monitor = self.monitor
        return monitor.stopped is None and not monitor.is_over and monitor.allows(self._seconds)

    @property
    def _seconds(self) -> float:
        """About how long it takes until a fit has its first iterate."""
        test = self.test
        return float(_SECONDS * (self.poles.omega.size * (test.n_base + 2)) ** 2 * test.n_runs * test.freq.size)

    def _check(self) -> None:
        """Refuse records that cannot fix the modes, and a time that cannot suffice."""
        if not self.monitor.allows(self._seconds):
            raise SolverError(
                f"a fit of {self.poles.omega.size} modes takes some {self._seconds:.1g} s to set up: too little time, "
                "nothing is identified"
            )
        test, moving = self.test, independent(self.test.base).shape[1]
        if moving < test.n_base:
            raise DoesNotApplyError(
                f"the base moves in only {moving} of {test.n_base} independent directions: add runs that move the "
                "others, or describe the test by the directions that move"
            )
        m = self.poles.omega.size
        unknowns = m * (test.n_sensors + test.n_base + 1)
        if 2 * test.response.size < unknowns or len(self.records.data) < m * len(self.records.base):
            raise DoesNotApplyError(
                f"{test.freq.size} lines ({2 * test.response.size} measured numbers) cannot fix {unknowns} unknowns: "
                "add lines or runs"
            )

    def _grown(self, best: ModalFit, multiplicity: Integers) -> ModalFit:
        """The fit of so many modes at each pole, or one with more where their free residues call for it."""
        while self._goes_on and (lacking := self._lacking_rank(best, multiplicity)) is not None:
            more = multiplicity.copy()
            more[lacking] += 1
            again = self._with(more)
            gained = (best.of_accelerations**2 - again.of_accelerations**2) * self.records.size
            noise = self._free(again, more)[1]
            if gained < beyond_chance(self.test.n_sensors + self.test.n_base, CANDIDATES) * noise:
                break
            best, multiplicity = again, more
        return best

    def _free(self, end: ModalFit, multiplicity: Integers) -> tuple[ResidueFit, float]:
        """Free residues at a fit's poles, and the variance of a real number of the records about them."""
        first = np.cumsum(multiplicity) - multiplicity
        free = self.records.fit(end.modes.omega[first], end.modes.ratios[first])
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

    def _with(self, multiplicity: Integers) -> ModalFit:
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
        return fit_spectra(test, modes, rigid, monitor=self.monitor, max_iterations=self.max_iterations)


def _ascending(fit: ModalFit) -> ModalFit:
    """The same fit, its modes in ascending order."""
    end = fit.modes
    order = np.argsort(end.omega, kind="stable")
    return replace(fit, modes=Modes(end.phi[:, order], end.gamma[order], end.omega[order], end.ratios[order]))


def held_to_totals(problem: Prepared, end: ModalFit, monitor: IterationMonitor, max_iterations: int) -> ModalFit | None:
    """The same fit with stated totals held, where what the base force weighs agrees with them; else None."""
    ties, modes = stated_totals(problem), end.modes
    if ties is None or monitor.is_over:
        return None
    off = ca.vertcat(*ties(ca.DM(modes.phi), ca.DM(modes.gamma), ca.DM(end.rigid)))
    if np.any(np.abs(np.asarray(off)) > _AGREES):
        return None
    held = _again(problem, end, monitor, max_iterations, ties)
    agrees = held.residual <= AS_GOOD * end.residual + EXACT
    return held if agrees and held.status in SOLVED else None


def ended(problem: Prepared, estimate: ModalFit, monitor: IterationMonitor, max_iterations: int) -> ModalFit:
    """Where IPOPT ends from an estimate, with damping ratios within their bounds and no negative mass.

    The estimate itself where nobody wants to wait for it.

    Raises
    ------
    DoesNotApplyError
        Where modes move so much alike that no shapes can be told apart.
    """
    within = _within_bounds(problem, estimate)
    if monitor.is_over or monitor.stopped is not None:
        return estimate
    try:
        # Bounds that nothing presses on would cost iterations, as IPOPT begins away from them.
        end = _again(problem, estimate, monitor, max_iterations, bounded=False) if within else estimate
        return end if within and _within_bounds(problem, end) else _again(problem, end, monitor, max_iterations)
    except SolverError as error:
        raise DoesNotApplyError(f"{error}: use fewer modes, Modal(modes=), or narrow the band") from None


def _within_bounds(problem: Prepared, end: ModalFit) -> bool:
    """True where all damping ratios are within the problem's bounds."""
    low, high = damping_bounds(problem)
    return bool(np.all((end.modes.ratios >= low) & (end.modes.ratios <= high)))


def damping_bounds(problem: Prepared) -> tuple[float, float]:
    """Bounds of the free damping ratios of a problem, those of all modes alike."""
    unknowns = problem.formulation.of_models[2]
    return float(lower_of(unknowns).min()), float(upper_of(unknowns).max())


def _again(
    problem: Prepared, end: ModalFit, monitor: IterationMonitor, max_iterations: int, ties: Ties | None = None,
    *, bounded: bool = True,
) -> ModalFit:  # fmt: skip
    """A fit from where another ended, with ties, and damping ratios within the problem's bounds."""
    modes = end.modes
    first, pole = separate_poles(modes)
    unit, bounds = np.sqrt(problem.totals), damping_bounds(problem) if bounded else (0.0, np.inf)
    return solve_modes(
        problem.modal[0], modes, _free_spectrum(modes.omega[first], modes.ratios[first], pole, *bounds), unit=unit,
        remainder=end.rigid - modes.gamma.T @ modes.gamma, ties=ties, weights=end.weights, monitor=monitor,
        max_iterations=max_iterations,
    )  # fmt: skip


def _free_spectrum(omega: Array, ratios: Array, pole: Integers, lower: float = 0.0, upper: float = np.inf) -> Spectrum:
    """Frequencies without bounds and damping ratios, of each pole; modes of one pole share them."""

    def spectrum(z: NonlinearProgram) -> tuple[ca.MX, ca.MX]:
        # In units of the half-power half-width, which is what frequencies are known in.
        # Cut off where no step of use leads.
        shift = _within(z.variable("frequency", np.zeros(omega.size)) * ca.DM(ratios), 1.0)
        with np.errstate(divide="ignore"):
            low, high = np.log(lower / ratios), np.log(upper / ratios)
        loss = _within(z.variable("damping ratio", np.clip(np.zeros(omega.size), low, high), low, high), 10.0)
        moved, lossy = ca.DM(omega) * ca.exp(shift), ca.DM(ratios) * ca.exp(loss)
        # Entries of a scalar are a row.
        return ca.vec(moved[pole.tolist()]), ca.vec(lossy[pole.tolist()])

    return spectrum


def _within(value: ca.MX, limit: float) -> ca.MX:
    return ca.fmin(ca.fmax(value, -limit), limit)
