"""The modal strategy: poles from the data, the fit in modal coordinates, modal masses by what is known, the structure.

No swarm and no start are needed: residues at given poles are a linear least-squares problem, a residue of rank one is
shape times participation, and what remains is the scale of each mode, its modal mass (`modal_masses`). As many
degrees of freedom as modes are chosen from the sensors; the other sensors follow by a recovery matrix, and where there
are more modes than sensors, modal coordinates stand beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_fit import ModalFit, Modes, Spectrum, fit_modes
from sysid.modal_analysis.residues import Records, ResidueFit, beyond_chance, independent, linear_residues
from sysid.modal_analysis.vector_fitting import Poles, find_poles, poles_near
from sysid.models.mass import FullMass, KnownMass
from sysid.models.spectrum import SOLVED
from sysid.models.stiffness import SpectralStiffness
from sysid.nlp import EXACT, Coordinates, Watch
from sysid.problem.problem import Problem
from sysid.search.modal_scaling import nearest_lumped, of_known_mass, stated_totals, to_stated_totals, weigh
from sysid.structure.structure import Array, Structure
from sysid.structure.triangular import triangle_entries

Integers = NDArray[np.intp]

_SCATTER = 5.0  # times the misfit of all lines together: what noise makes of the shapes' singular values
_DEPENDENT = 1e-6  # of the largest singular value of the shapes: below, sensors move alike in all modes
FREQUENCY_WINDOW = 0.05  # relative; what a frequency read off a peak may be wrong by
_AS_GOOD = 1.02  # times the residual without it, that a stated total may leave
_AGREES = 0.01  # relative; a stated total that the base force weighs within this is held in the fit


class NotModalError(InputError):
    """The modal strategy does not apply to a problem; another may."""


@dataclass(frozen=True)
class Modal:
    """Strategy "modal" with its settings.

    Parameters
    ----------
    sensors : sequence of str or int, optional
        Sensors (names, or numbers from 0) whose motions are the physical degrees of freedom where there are fewer modes
        than sensors, at most one a mode (modal coordinates make up the rest); chosen by a pivoted QR of the mode shapes
        where none are given.
    max_iterations : int
        Of IPOPT, in each fit.
    """

    sensors: Sequence[str | int] | None = None
    max_iterations: int = 200


@dataclass(frozen=True, eq=False)
class DegreesOfFreedom:
    """What the degrees of freedom of a modal model are.

    Attributes
    ----------
    sensors : (k,) of int
        The physical ones: sensors, ascending.
    modes : (m - k,) of int
        Modal coordinates beside them, modes counted from 0.
    """

    sensors: Integers
    modes: Integers


def fit(test: Measurement, poles: Poles, unit: Array, watch: Watch, max_iterations: int) -> ModalFit:
    """Fit of rank-one modes at `poles`; a pole whose residue needs it stands for several modes.

    Parameters
    ----------
    unit : (d,)
        Size of participations, kg^½, m kg^½ for rotations.

    Raises
    ------
    NotModalError
        Fewer measured numbers than unknowns, or base directions that do not move by themselves.
    """
    records = Records(test)
    moving = independent(test.base).shape[1]
    if moving < test.n_base:
        raise NotModalError(
            f"the base moves in only {moving} of {test.n_base} independent directions: add runs that move the others, "
            "or describe the test by the directions that move"
        )
    m, n, d = poles.omega.size, test.n_sensors, test.n_base
    if 2 * test.response.size < m * (n + d + 1) or len(records.data) < m * len(records.base):
        raise NotModalError(
            f"{test.freq.size} lines ({2 * test.response.size} measured numbers) cannot fix {m * (n + d + 1)} "
            "unknowns: add lines or runs"
        )
    best = _grown(records, test, poles, np.ones(m, dtype=int), unit, watch, max_iterations)
    # Modes of rank one may have dragged poles away from where several modes share one.
    free = records.fit(poles.omega, poles.ratios)
    noise = records.noise(free.left, free.residues.size)
    excess = best.of_accelerations**2 * records.size - free.squared_error
    ranks = _ranks(free, noise, n, d)
    wanting = excess > noise * beyond_chance(m * (n - 1) * (d - 1)) or ranks.sum() < best.modes.omega.size
    if watch.stopped is None and wanting and np.any(ranks > 1):
        other = _grown(records, test, poles, ranks, unit, watch, max_iterations)
        more = other.modes.omega.size - best.modes.omega.size
        gained = (best.of_accelerations**2 - other.of_accelerations**2) * records.size / noise
        if gained > (beyond_chance(more * (n + d)) if more > 0 else -beyond_chance(-more * (n + d))):
            best = other
    order = np.argsort(best.modes.omega, kind="stable")
    end = best.modes
    modes = Modes(end.phi[:, order], end.gamma[order], end.omega[order], end.ratios[order])
    return replace(best, modes=modes)


def _grown(
    records: Records,
    test: Measurement,
    poles: Poles,
    multiplicity: Integers,
    unit: Array,
    watch: Watch,
    max_iterations: int,
) -> ModalFit:
    """Fit with so many modes at each pole, and with more where their free residues call for it."""
    n, d = test.n_sensors, test.n_base
    best = _fit_with(test, poles, multiplicity, unit, watch, max_iterations)
    while watch.stopped is None:
        lacking = _lacking_rank(records, best, multiplicity)
        if lacking is None:
            break
        more = multiplicity.copy()
        more[lacking] += 1
        again = _fit_with(test, poles, more, unit, watch, max_iterations)
        gained = (best.of_accelerations**2 - again.of_accelerations**2) * records.size
        if gained < beyond_chance(n + d) * _noise(records, again, more):
            break
        best, multiplicity = again, more
    return best


def _noise(records: Records, end: ModalFit, multiplicity: Integers) -> float:
    """Variance of a real number of the records about free residues at a fit's poles."""
    first = np.concatenate([[0], np.cumsum(multiplicity)[:-1]])
    free = records.fit(end.modes.omega[first], end.modes.ratios[first])
    return records.noise(free.left, free.residues.size)


def _ranks(free: ResidueFit, noise: float, n: int, d: int) -> Integers:
    """Number of modes at each pole: singular values of its free residue that stand out of the noise."""
    s = np.linalg.svd(free.whitened.reshape(len(free.whitened), -1, n), compute_uv=False)
    needed = np.count_nonzero(s**2 > noise * beyond_chance(n + d), axis=1)  # unknowns of a further mode, at most
    return np.clip(needed, 1, min(n, d))


def _lacking_rank(records: Records, best: ModalFit, multiplicity: Integers) -> int | None:
    """The pole whose free residue most lacks in the modes that it has; None where none does."""
    first = np.concatenate([[0], np.cumsum(multiplicity)[:-1]])
    omega, ratios = best.modes.omega[first], best.modes.ratios[first]
    free = records.fit(omega, ratios)
    n, d = records.n_sensors, records.n_base
    if n < 2 or d < 2 or best.of_accelerations <= EXACT:
        return None
    freedom = float(np.sum((n - multiplicity) * (d - multiplicity)))
    excess = best.of_accelerations**2 * records.size - free.squared_error
    noise = records.noise(free.left, free.residues.size)
    if excess < noise * beyond_chance(freedom):
        return None
    residues = free.whitened.reshape(omega.size, -1, n)
    s = np.linalg.svd(residues, compute_uv=False)
    left = np.array([np.sum(row[r:] ** 2) for row, r in zip(s, multiplicity, strict=True)])
    left[multiplicity >= min(n, d)] = 0.0
    return int(np.argmax(left)) if left.max() > 0 else None


def _fit_with(
    test: Measurement,
    poles: Poles,
    multiplicity: Integers,
    unit: Array,
    watch: Watch,
    max_iterations: int,
) -> ModalFit:
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
    lam, vectors = np.linalg.eigh((rigid - modes.gamma.T @ modes.gamma) / np.outer(unit, unit))
    remainder = (vectors * np.maximum(lam, 0.0)) @ vectors.T * np.outer(unit, unit)
    return fit_modes(
        test, modes, _free_spectrum(poles.omega, poles.ratios, pole), unit=unit, remainder=remainder, watch=watch,
        max_iterations=max_iterations,
    )  # fmt: skip


def held_to_totals(problem: Problem, end: ModalFit, watch: Watch, max_iterations: int) -> ModalFit | None:
    """The same fit with stated totals held, where what the base force weighs agrees with them; else None."""
    ties, test, modes = stated_totals(problem), problem.measurement, end.modes
    if ties is None:
        return None
    off = ca.vertcat(*ties(ca.DM(modes.phi), ca.DM(modes.gamma), ca.DM(end.rigid)))
    if np.any(np.abs(np.asarray(off)) > _AGREES):
        return None
    _, first, pole = np.unique(modes.omega + 1j * modes.ratios, return_index=True, return_inverse=True)
    held = fit_modes(
        test, modes, _free_spectrum(modes.omega[first], modes.ratios[first], pole), unit=np.sqrt(problem.totals),
        remainder=end.rigid - modes.gamma.T @ modes.gamma, ties=ties, watch=watch, max_iterations=max_iterations,
    )  # fmt: skip
    agrees = held.residual <= _AS_GOOD * end.residual + EXACT
    return held if agrees and held.status in SOLVED else None


def _free_spectrum(omega: Array, ratios: Array, pole: Integers) -> Spectrum:
    """Frequencies and damping ratios of each pole without bounds; modes of one pole share them."""

    def spectrum(z: Coordinates) -> tuple[ca.MX, ca.MX]:
        # In units of the half-power half-width, which is what frequencies are known in.
        # Cut off where no step of use leads.
        shift = _within(z.add("frequency", np.zeros(omega.size)) * ca.DM(ratios), 1.0)
        loss = _within(z.add("damping ratio", np.zeros(omega.size)), 10.0)
        moved, lossy = ca.DM(omega) * ca.exp(shift), ca.DM(ratios) * ca.exp(loss)
        return moved[pole.tolist()], lossy[pole.tolist()]

    return spectrum


def _within(value: ca.MX, limit: float) -> ca.MX:
    return ca.fmin(ca.fmax(value, -limit), limit)


def degrees_of_freedom(
    problem: Problem, modes: Modes, residual: float, stated: Sequence[str | int] | None
) -> DegreesOfFreedom:
    """Sensors, and modal coordinates where they do not suffice, whose motions tell all modes' apart.

    Sensors by a pivoted QR of the mode shapes, each mode in units of its own size, so that the chosen rows are
    best conditioned. With more modes than independent sensors the modes that the sensors tell least become coordinates.
    The relative `residual` of the fit tells how well shapes are known, and so what is independent.
    """
    n, m = modes.phi.shape
    shapes = modes.phi / np.linalg.norm(modes.phi, axis=0)
    s = np.linalg.svd(shapes, compute_uv=False)
    least = max(_DEPENDENT, _SCATTER * residual / np.sqrt(problem.measurement.freq.size))
    rank = int(np.count_nonzero(s > least * s[0]))
    if stated is not None:
        sensors = _by_name(problem.measurement, stated)
        if sensors.size > m or np.linalg.svd(shapes[sensors], compute_uv=False)[-1] < _DEPENDENT:
            raise InputError(
                f"{sensors.size} sensors are stated as degrees of freedom, but the {m} modes do not tell them apart "
                f"(at most {rank} move independently)"
            )
    elif rank == n:
        sensors = np.arange(n)
    else:
        sensors = np.sort(scipy.linalg.qr(shapes.T, pivoting=True, mode="r")[1][:rank])
    order = scipy.linalg.qr(shapes[sensors], pivoting=True, mode="r")[1]
    return DegreesOfFreedom(sensors, np.sort(order[sensors.size :]))


def _by_name(test: Measurement, stated: Sequence[str | int]) -> Integers:
    names = test.sensor_names
    chosen = []
    for one in stated:
        at = names.index(one) if one in names else one
        if not isinstance(at, int | np.integer) or not 0 <= at < len(names):
            raise InputError(f"Modal: {one!r} is no sensor; the sensors are {', '.join(names)}")
        chosen.append(int(at))
    if len(set(chosen)) < len(chosen):
        raise InputError("Modal: a sensor is named twice")
    return np.sort(np.array(chosen, dtype=int))


def build(problem: Problem, modes: Modes, remainder: Array, chosen: DegreesOfFreedom, *, to_totals: bool) -> Structure:
    """Structure of a modal model; `remainder` (d, d) is the rigid-body mass that no mode carries.

    With `to_totals` all modal masses take one factor, and the remainder what is left, so that stated totals are met.
    """
    layout = problem.layout
    T = np.vstack([modes.phi[chosen.sensors], np.eye(modes.omega.size)[chosen.modes]])
    P = np.linalg.inv(T)
    G = np.vstack([layout.rigid_body[chosen.sensors], np.zeros((chosen.modes.size, layout.d))])
    recovery = modes.phi @ P
    # Exact where a degree of freedom is a sensor.
    recovery[chosen.sensors] = np.eye(T.shape[0])[: chosen.sensors.size]
    gamma = modes.gamma
    plain = chosen.modes.size == 0 and chosen.sensors.size == layout.n
    if to_totals:
        groups = np.concatenate([layout.directions[chosen.sensors], np.full(chosen.modes.size, -1)])
        known = plain and bool(np.nansum(np.abs(problem.known_mass)) > 0)
        t, remainder = to_stated_totals(problem, P, gamma, G, groups, remainder, scaled=known)
        P, gamma = P * np.sqrt(t), gamma * np.sqrt(t)
    M_SS, K_SS = P.T @ P, (P.T * modes.omega**2) @ P
    M_S0 = P.T @ gamma - M_SS @ G
    delta = gamma - P @ G
    K_S0 = -K_SS @ G
    return Structure(
        np.block([[M_SS, M_S0], [M_S0.T, delta.T @ delta + remainder]]),
        np.block([[K_SS, K_S0], [K_S0.T, -G.T @ K_S0]]),
        modes.ratios,
        n_base=layout.d,
        recovery=None if plain else recovery,
        rigid_body=None if plain else layout.rigid_body,
        sensors=problem.measurement.sensors,
    )


def modal_structure(
    problem: Problem, options: Modal, watch: Watch
) -> tuple[Structure, ModalFit, DegreesOfFreedom, Poles]:
    """Structure that the data suggest without any search, and how it was fitted.

    With a lumped or known mass it is where the structured local phase starts; its modal masses come from the model.

    Raises
    ------
    NotModalError
        Where a stated frequency is none of the data's, these do not suffice, or the modes are too much alike at the
        sensors.
    InputError
        Where the base force has the wrong sign, or stated sensors do not tell the modes apart.
    """
    test, layout = problem.measurement, problem.layout
    poles = problem.poles or _stated_poles(problem)
    end = fit(test, poles, np.sqrt(problem.totals), watch, options.max_iterations)
    held = held_to_totals(problem, end, watch, options.max_iterations)
    end = held or end
    chosen = degrees_of_freedom(problem, end.modes, end.of_accelerations, options.sensors)
    modes, remainder = end.modes, end.rigid - end.modes.gamma.T @ end.modes.gamma
    if test.force is None:
        k = chosen.modes.size
        P = np.linalg.inv(np.vstack([modes.phi[chosen.sensors], np.eye(modes.omega.size)[chosen.modes]]))
        G = np.vstack([layout.rigid_body[chosen.sensors], np.zeros((k, layout.d))])
        groups = np.concatenate([layout.directions[chosen.sensors], np.full(k, -1)])
        if isinstance(problem.mass, KnownMass) and len(P) == layout.n:
            t = of_known_mass(problem.mass.full(layout), P, modes.gamma, G)
        else:
            # Known entries are those of the sensors' own mass matrix.
            known = problem.known_mass if len(P) == layout.n and k == 0 else None
            t = nearest_lumped(problem, P, modes.gamma, G, groups, known)
        modes = modes._replace(phi=modes.phi / np.sqrt(t), gamma=modes.gamma * np.sqrt(t)[:, None])
        remainder = np.diag(problem.totals)
    # A stated total is kept, even where the base force weighs another.
    mass = problem.mass
    unmet = isinstance(mass, FullMass) and (test.force is None or (mass.total_mass is not None and held is None))
    try:
        return build(problem, modes, remainder, chosen, to_totals=unmet), end, chosen, poles
    except InputError as error:
        raise NotModalError(
            "the modes found are too much alike at the sensors, as where a sign, gain or axis in rigid_body is "
            f"wrong, or the responses are not absolute accelerations ({error})"
        ) from None


def held_by_model(problem: Problem, structure: Structure) -> Array:
    """Unknowns (n_variables,) of a lumped or known mass that are nearest to a modal model.

    Its mass, its poles, and the orthogonal shapes nearest to its own.
    """
    n = problem.layout.n
    x = problem.values(structure)
    L = np.linalg.cholesky(problem.structure(x).mass[:n, :n])
    u, _, vt = np.linalg.svd(L.T @ structure.mode_shapes)
    shapes = u @ vt
    omega = 2 * np.pi * structure.natural_frequencies
    x[problem.parts.stiffness] = triangle_entries(np.linalg.cholesky((shapes * omega**2) @ shapes.T))
    return x


def _stated_poles(problem: Problem) -> Poles:
    """Poles for the stated frequencies; with others looked for where the model is said to have more."""
    stiffness, test = problem.stiffness, problem.measurement
    assert isinstance(stiffness, SpectralStiffness)
    stated = stiffness.targets
    if stated.size == test.n_sensors:
        try:
            return poles_near(test, stated, FREQUENCY_WINDOW)
        except InputError as error:
            raise NotModalError(str(error)) from error
    found = find_poles(test)
    missed = np.array([w for w in stated if np.min(np.abs(np.log(found.omega / w))) > np.log1p(FREQUENCY_WINDOW)])
    if missed.size:
        told, others = (", ".join(f"{w / (2 * np.pi):.5g}" for w in omega) for omega in (missed, found.omega))
        raise NotModalError(
            f"of the stated natural frequencies {told} Hz does not stand out of the data; found are {others} Hz"
        )
    return found
