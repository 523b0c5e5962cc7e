"""The local phase where mode shapes and participations are free.

The response is bilinear in mode shapes and participations, so these are the unknowns, with ``log w`` and
``log zeta``; no inverse, no eigenvector routine and no infinite slope is left in the graph. Every regular Phi gives a
positive definite ``M_SS = (Phi Phi')^-1`` and ``K_SS = M_SS Phi diag(w²) Phi' M_SS``, and participations give the
coupling. A local minimum shows: with frequencies and damping as they ended, the best residues are a linear
least-squares problem, and where that fits clearly better, the search starts again from there.
"""

from __future__ import annotations

from collections.abc import Iterator

import casadi as ca
import numpy as np

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_fit import ModalFit, Modes, rank_one, separate_poles
from sysid.modal_analysis.residues import linear_residues
from sysid.models.stiffness_and_damping import FREQUENCY_WINDOW
from sysid.models.unknowns import lower_of, upper_of
from sysid.nlp import IterationMonitor, NonlinearProgram
from sysid.problem.matrices import assemble, blocks_of_modes
from sysid.problem.prepared import Prepared
from sysid.search.modal_program import End, add_unknowns, solve_modes
from sysid.search.stated_masses import positive_part, stated_totals, to_stated_totals
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import EXACT, FREE, NEGLIGIBLE

_OPEN_WINDOW = 20.0  # factor either way for a frequency that nobody gave


def fit_in_modes(problem: Prepared, x: Array, monitor: IterationMonitor, max_iterations: int) -> End:
    """Minimise the objective of a problem with free modes, from the structure of `x`."""
    start = problem.structure(x)
    first, test, own, ties = all_modes_of(start), problem.measurement, slice(start.n), stated_totals(problem)
    beyond = first.gamma[start.n :]

    def attempt(modes: Modes) -> ModalFit:
        return solve_modes(
            problem.modal[0], modes, lambda z: spectrum_near(problem, start, modes, z), unit=np.sqrt(problem.totals),
            remainder=_remainder(start) - beyond.T @ beyond, monitor=monitor, max_iterations=max_iterations,
            ties=ties and (lambda phi, gamma, rigid: ties(phi[:, own], gamma[own, :], rigid)),
        )  # fmt: skip

    best, tried = attempt(first), 1
    for again in _linear_starts(test, best, first, start.n):
        if monitor.stopped is not None or best.residual <= EXACT or monitor.left < 1.0:
            break
        answer = attempt(again)
        tried += 1
        if answer.residual < best.residual:
            best = answer
    remark = f"best of {tried} starts, as the first ended in a local minimum" if tried > 1 else ""
    found = unknowns_of(problem, best.modes.at(own), best.rigid, start, x)
    return End(found, best.residual, best.status, best.bounds, remark)


def _linear_starts(test: Measurement, ended: ModalFit, first: Modes, own: int) -> Iterator[Modes]:
    """New starts where free residues fit clearly better than what was reached: at its poles, then at the first ones.

    The first modes are a structure's `own`, to which the others are residual ones; these stay, each pole once.
    """
    fits = [(poles, *_free_residues(test, poles, own)) for poles in (ended.modes, first)]
    if ended.of_accelerations <= FREE * min(possible for _, _, possible in fits):
        return
    for poles, residues, _ in fits:
        mine = poles.at(slice(own))
        new = rank_one(residues[:own], mine.omega, mine.ratios, np.linalg.norm(mine.phi, axis=0))
        yield new.joined(first.at(slice(own, None)))


def _free_residues(test: Measurement, modes: Modes, own: int) -> tuple[Array, float]:
    """Free residues at the poles of a structure's own modes and at each pole of the others; what they leave."""
    others = modes.at(slice(own, None))
    poles = modes.at(slice(own)).joined(others.at(separate_poles(others)[0]))
    residues, left = linear_residues(test, poles.omega, poles.ratios)
    return residues, float(left)


def fits_worse_than_free_residues(test: Measurement, structure: Structure, error: float) -> bool:
    """True where a relative error of the accelerations is clearly above what free residues leave: a local minimum."""
    return error > max(EXACT, FREE * _free_residues(test, all_modes_of(structure), structure.n)[1])


def modes_of(structure: Structure) -> Modes:
    """The modes of a structure, rad/s."""
    omega = 2 * np.pi * structure.natural_frequencies
    return Modes(structure.mode_shapes, structure.participation, omega, structure.damping_ratios)


def all_modes_of(structure: Structure) -> Modes:
    """The modes of a structure, then the residual ones."""
    beyond = structure.residual
    others = Modes(beyond.shapes, beyond.participation, beyond.omega, beyond.damping_ratios)
    return modes_of(structure).joined(others)


def frequencies(problem: Prepared, start: Array, z: NonlinearProgram, *, near: bool = True) -> tuple[ca.MX, Array]:
    """Circular frequencies as new unknowns, and what they are relative to, rad/s; held `near` those that were given."""
    center, window = start.copy(), np.full(start.size, np.log(_OPEN_WINDOW))
    spectrum = problem.formulation.stiffness.spectrum
    if near and spectrum is not None:
        center[: spectrum.size], window[: spectrum.size] = spectrum, np.log1p(FREQUENCY_WINDOW)
    shift = np.clip(np.log(start / center), -window, window)
    return ca.DM(center) * ca.exp(z.variable("frequency", shift, -window, window)), center


def spectrum_near(problem: Prepared, structure: Structure, start: Modes, z: NonlinearProgram) -> tuple[ca.MX, ca.MX]:
    """Circular frequencies and damping ratios as expressions of new unknowns: log w near what is stated, log zeta.

    Of the structure's own modes, the first of `start`; those of residual ones are held.
    """
    n, formulation = structure.n, problem.formulation
    held = start.at(slice(n, None))
    start = start.at(slice(n))
    omega, _ = frequencies(problem, start.omega, z)
    damping, unknowns = formulation.models[2], formulation.of_models[2]
    lower, upper = lower_of(unknowns), upper_of(unknowns)
    if formulation.damping.free:
        guess = np.clip(start.ratios, lower, upper)
        low, high = np.log(lower / guess), np.log(upper / guess)
        ratios = ca.DM(guess) * ca.exp(z.variable(unknowns[0].title, np.zeros(guess.size), low, high))
    else:
        guess = np.clip(damping.values(formulation.geometry, structure), lower, upper)
        ratios = formulation.ratios(add_unknowns(z, unknowns, guess), omega)
    return ca.vertcat(omega, ca.DM(held.omega)), ca.vertcat(ratios, ca.DM(held.ratios))


def unknowns_of(problem: Prepared, modes: Modes, rigid: Array, start: Structure, x: Array) -> Array:
    """The problem's unknowns of a fit that began at a structure, its modes one by one; what enters no matrix as in `x`.

    Frequencies may have changed places. The damping is put inside its search space. `rigid` (d, d), the rigid-body
    mass, counts where a force was measured.
    """
    if problem.measurement.force is None:
        # Accelerations leave the scale of each mode open: shapes keep the size that they had.
        size = np.linalg.norm(start.mode_shapes, axis=0)
        size = size / np.maximum(np.linalg.norm(modes.phi, axis=0), np.finfo(float).tiny)
        modes = modes._replace(phi=modes.phi * size, gamma=modes.gamma / size[:, None])
    order = np.argsort(modes.omega)
    gamma, w, zeta = modes.gamma[order], modes.omega[order], np.maximum(modes.ratios[order], 0.0)
    P, geometry = _regular_inverse(modes.phi[:, order]), problem.geometry
    if problem.measurement.force is None:
        groups = geometry.directions[: len(P)]
        t, left = to_stated_totals(problem, P, gamma, geometry.rigid_body, groups, _remainder(start))
        P, gamma = P * np.sqrt(t), gamma * np.sqrt(t)
    else:
        # IPOPT may leave a base without mass below zero by its tolerance.
        unit = np.sqrt(np.diag(start.rigid_body_mass))
        size = np.outer(unit, unit)
        left = positive_part((rigid - gamma.T @ gamma) / size) * size
    G = geometry.rigid_body
    blocks = blocks_of_modes(P, gamma, w, G, left)
    found = problem.values(assemble(*blocks, G, ratios=zeta, test=problem.measurement))
    at = problem.formulation.parts.damping
    found[at] = np.clip(found[at], problem.lower[at], problem.upper[at])  # IPOPT may leave bounds by its tolerance
    found[at.stop :] = x[at.stop :]
    return found


def _remainder(structure: Structure) -> Array:
    """Rigid-body mass that no mode carries, (d, d)."""
    gamma = structure.participation
    return structure.rigid_body_mass - gamma.T @ gamma


def _regular_inverse(phi: Array) -> Array:
    """Inverse of the shapes; where a bad fit has made some alike or next to nothing, of near ones that are not."""
    u, s, vt = np.linalg.svd(phi)
    return (vt.T / np.maximum(s, NEGLIGIBLE * s[0])) @ u.T
