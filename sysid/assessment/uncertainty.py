r"""Covariances and intervals of an identified structure, from exact Jacobians and the measured noise.

The fit is weighted least squares over the modal parameters ``theta = (Phi, Gamma, log w, log zeta, M_rb)``. The inverse
of its information is kept as a factor: columns of theta, each the move that one independent standard normal makes.
Moves that no record sees stand beside them. A quantity follows both by its chain rule: its variance is a sum of
squares, and it is NaN where something unseen moves it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.assessment.checks.gains import GainErrors, gain_errors
from sysid.assessment.information import (
    DirectSpectra,
    ModalSpectra,
    Perturbations,
    changes_of_matrices,
    gain_gradients,
    information,
    leakage_moves,
    spectra_of,
    spread,
    std_of,
)
from sysid.assessment.modal_mass_cone import open_modes
from sysid.assessment.sensitivity import (
    Sensitivity,
    blocks_and_slopes,
    meaningful,
    of_outside,
    outside_variables,
    parametrisation,
    sensitivity,
    with_totals,
)  # fmt: skip
from sysid.assessment.statements import conditioned
from sysid.errors import check_frequencies, refuse
from sysid.modal_analysis.coupled_spectra import coupling_information
from sysid.modal_analysis.growing_errors import scatter_of_lines
from sysid.modal_analysis.misfit import inflation_of, noise_records
from sysid.modal_analysis.modal_estimate import (
    Coupling,
    ModalEstimate,
    coupling_about,
    independent_rows,
    information_about,
    shifts_about,
)
from sysid.modal_analysis.modal_fit import Index, Modes
from sysid.modal_analysis.response import columns, weights_of_test
from sysid.models.unknowns import by_name, split
from sysid.problem.direct_response import Slopes, slopes_of
from sysid.problem.formulation import Formulation
from sysid.problem.prepared import Prepared
from sysid.problem.terms import TestTerm
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import NEGLIGIBLE

LARGE = 4000  # entries of the mode shapes, beyond which the covariance takes minutes and gigabytes

_POSITIVE = ("natural_frequencies", "damping_ratios")
_MATRICES = ("mass", "stiffness", "damping")
_QUANTITIES = (*_POSITIVE, "mode_shapes", "participation", "effective_masses", "rigid_body_mass", *_MATRICES)


@dataclass(frozen=True, eq=False, repr=False)
class Uncertainty:
    """Standard deviations of what was identified; NaN where data and stated model leave a quantity open.

    Attributes
    ----------
    structure : Structure
        What they belong to: n_sensors sensors, m modes, d base directions.
    natural_frequencies : (m,)
        Hz.
    damping_ratios : (m,)
    mode_shapes : (n_sensors, m)
        kg^-1/2.
    participation : (m, d)
        kg^1/2 (kg^1/2 m for a rotation of the base).
    effective_masses : (m, d, d)
        kg; of products of two jointly normal participations, so that they hold also where these are about zero.
    rigid_body_mass : (d, d)
    mass, stiffness, damping : (m, m)
        M_SS, K_SS and C at the structure's degrees of freedom.
    parameters : tuple of str
        Frequencies, damping ratios, and the participations that are known; where all unknowns of the problem mean
        something by themselves, these.
    covariance : (p, p)
        Of `parameters`.
    inflation : float
        Factor by which all standard deviations were raised because the misfit is larger than the stated noise
        explains; 1 otherwise, NaN where the lines are too few to tell a noise that is not stated.
    mass_by_gain : (n_sensors, m)
        By how much an error of one, 100 %, of each sensor's gain moves the diagonal of M_SS, to first order, kg.
    values, variables : dict of str to ndarray
        Values, and their standard deviations, of the unknowns that mean something by themselves: variables, springs,
        damping ratios; not the entries of factors of a matrix, nor shares of a total. By name, in their shapes.

    Notes
    -----
    First order in the noise. Degrees of freedom at a sensor move with its row of the mode shapes; others are known
    only where they are modal coordinates, which stand still.

    References
    ----------
    S. M. Kay, Fundamentals of Statistical Signal Processing: Estimation Theory (1993), section 15.7 (complex
    noise); H. White, Econometrica 50 (1982) 1-25 (weights other than the noise's).
    """

    structure: Structure
    natural_frequencies: Array
    damping_ratios: Array
    mode_shapes: Array
    participation: Array
    effective_masses: Array
    rigid_body_mass: Array
    mass: Array
    stiffness: Array
    damping: Array
    parameters: tuple[str, ...]
    covariance: Array
    inflation: float
    _spectra: ModalSpectra | DirectSpectra = field(repr=False)
    mass_by_gain: Array
    values: dict[str, Array] = field(default_factory=dict)
    variables: dict[str, Array] = field(default_factory=dict)

    def __repr__(self) -> str:
        worst = 100 * np.max(self.natural_frequencies / self.structure.natural_frequencies)
        known = "known" if np.all(np.isfinite(self.mass)) else "not all known"
        return f"<Uncertainty: frequencies within {worst:.2g} % (one standard deviation), masses {known}>"

    def interval(self, name: str, level: float = 0.95) -> Array:
        """Interval around the structure's value that holds the true one with probability `level`.

        Parameters
        ----------
        name : str
            One of the quantities above, "natural_frequencies" for instance, or one of `variables`.
        level : float
            Between 0 and 1.

        Returns
        -------
        ndarray, shape (2, ...)
            Lower and upper ends, from a normal law: of the logarithm for frequencies, damping ratios and the diagonals
            of M_SS, K_SS and C, which stay positive; of the participation for diagonal effective masses,
            which may be zero; of the value itself for all others. Bounds of variables are not counted.

        Raises
        ------
        InputError
            For another name, or a level that is no probability.
        """
        from scipy.special import ndtri

        known = (*_QUANTITIES, *self.variables)
        refuse(
            (name not in known, f"no uncertainty of {name!r}; give one of {', '.join(known)}"),
            (not 0 < level < 1, f"level = {level}: a probability between 0 and 1 is needed"),
        )
        z = float(ndtri((1 + level) / 2))
        if name in self.variables:
            value, std = self.values[name], self.variables[name]
            return np.stack([value - z * std, value + z * std])
        std = getattr(self, name)
        value = np.asarray(getattr(self.structure, name))[tuple(map(slice, std.shape))]  # without the rows of the base
        ends = np.stack([value - z * std, value + z * std])
        if name == "effective_masses":
            i = np.arange(self.structure.n_base)
            size, spread = np.abs(self.structure.participation), z * self.participation
            ends[:, :, i, i] = np.stack([np.maximum(size - spread, 0.0), size + spread]) ** 2
        positive = value > 0
        if name in _MATRICES:
            positive &= np.eye(self.structure.n, dtype=bool)
        if name in _POSITIVE + _MATRICES:
            with np.errstate(over="ignore"):  # what is hardly known may be anything above zero
                factor = np.exp(z * std[positive] / value[positive])
            ends[:, positive] = np.stack([value[positive] / factor, value[positive] * factor])
        return ends

    def transmissibility(self, freq: ArrayLike) -> Array:
        """Standard deviation ``sqrt(E|e|²)`` of the transmissibility at lines in Hz, (n_sensors, d, n_freq)."""
        return self._spectra.transmissibility(check_frequencies(freq, increasing=False))

    def base_force(self, freq: ArrayLike) -> Array:
        """Standard deviation ``sqrt(E|e|²)`` of the apparent mass at lines in Hz, kg, (d, d, n_freq)."""
        return self._spectra.base_force(check_frequencies(freq, increasing=False))


def uncertainty(
    problem: Prepared, structure: Structure, x: Array | None, gains: GainErrors | None = None
) -> Uncertainty:
    """Standard deviations of everything that was identified.

    Parameters
    ----------
    problem : Prepared
        The standard deviations that its measurement states are the noise; where none are stated, the misfit that
        `structure` leaves is.
    structure : Structure
        The fit of `problem`.
    x : (n_variables,) or None
        The unknowns that stand for it; those that the models have for it where they are not given.
    gains : GainErrors, optional
        Of the problem's own test, where they are known already.

    Returns
    -------
    Uncertainty
        First order in the noise; an unknown on a bound is treated as if the bound were not there. Where modes are
        free the structure moves as its modal parameters do, elsewhere as the problem's unknowns let it.

    Raises
    ------
    InputError
        Where x is needed and not given, and a matrix is written in expressions.
    """
    if problem.free_modes:
        return _by_modes(problem, structure, x, gains or gain_errors(problem.modal[0], structure))
    return _by_unknowns(problem, structure, problem.values(structure) if x is None else x)


def _by_modes(problem: Prepared, structure: Structure, x: Array | None, gains: GainErrors) -> Uncertainty:
    """Standard deviations where the modal parameters are free, from their Fisher information."""
    test = problem.measurement
    modes, index, inflation, normals, unseen, shifts, couplings = moves_by_records(problem, structure, gains=True)
    own = np.isin(modes.omega, separated_modes(structure).omega)
    possible = gains.possible
    # What makes up for an error that a gain may have counts beside the noise.
    normals = np.hstack([normals, (shifts[:, : possible.size] * possible)[:, possible > 0]])
    normals, unseen, shifts = conditioned(problem, structure, modes, index, normals, unseen, shifts)
    normals = normals if np.isfinite(inflation) else np.full_like(normals, np.nan)
    normals, coupling, coupled = _coupled(
        couplings, own, inflation * np.sqrt(problem.modal[0].scattered or 1.0), normals, unseen
    )
    moves = Perturbations(normals.shape[1], *index.split(np.hstack([normals, unseen])))
    shifts = shifts[:, : possible.size]
    mine = modes.at(own)
    if test.force is None and open_modes(problem, structure):
        open_ = np.full((structure.n, structure.n), np.nan)
        matrices = [open_, open_, open_]  # zeros that a decoupled structure keeps included
    else:
        changes = changes_of_matrices(structure, mine, moves.of(own), coupling, coupled)
        matrices = [moves.std(change, size) for change, size in changes]
    by_gains = Perturbations(0, *index.split(shifts))
    mass_by_gain, _ = next(changes_of_matrices(structure, mine, by_gains.of(own), coupling, coupled))
    by_gain = np.abs(np.einsum("iic->ci", mass_by_gain))
    spectra = ModalSpectra(modes, moves, structure.rigid_body_mass)
    found = _quantities(problem, structure, mine, moves.of(own), inflation, matrices, by_gain, spectra)
    if x is None or not np.any(problem.formulation.outside):
        return found
    variables, at = outside_variables(problem.formulation), x[problem.formulation.outside]
    known = of_outside(problem.formulation, x)
    std = std_of(known.steps, known.rank, known.unit)
    return replace(found, values=by_name(variables, at), variables=by_name(variables, std))


def _coupled(
    found: Coupling | None, own: NDArray[np.bool_], inflation: float, normals: Array, unseen: Array
) -> tuple[Array, Array, Array]:
    """Moves with those of couplings by dampers beside, the couplings of one's `own` modes (n, n), and their changes."""
    n = np.count_nonzero(own)
    if found is None:
        return normals, np.zeros((n, n)), np.zeros((n, n, normals.shape[1] + unseen.shape[1]))
    lam, V = np.linalg.eigh(found.covariance)
    alone = inflation * V * np.sqrt(np.maximum(lam, 0.0))
    change = np.hstack([found.follows @ normals, alone, found.follows @ unseen])
    inside, place = np.all(own[found.pairs], axis=1), np.cumsum(own) - 1
    coupled: Array = np.zeros((n, n, change.shape[1]))
    first, second = place[found.pairs[inside]].T
    coupled[first, second] = coupled[second, first] = change[inside]
    wider = np.hstack([normals, np.zeros((len(normals), lam.size))])
    return wider, found.values[np.ix_(own, own)], coupled


def moves_by_records(
    problem: Prepared, structure: Structure, *, gains: bool = False
) -> tuple[Modes, Index, float, Array, Array, Array, Coupling | None]:
    """Modes, index, inflation, and moves of theta that the records leave: of a standard normal each, and unseen.

    Of gains within tolerances too, as normals. With `gains` also what an error of one of each gain makes of theta, in
    columns as in `Gains.moves`; none without it. At last the couplings of these modes by dampers, and how they move.
    """
    modal, modes = problem.modal[0], _all_modes(structure)
    if modal.by_modes and modal.omega.size != modes.omega.size:  # residual modes of other numbers: by the lines
        modal = replace(ModalEstimate.of_lines(modal.records), calibration=modal.calibration)
    if modal.by_modes and modal.static:  # which turns change nothing holds where their information was taken
        at = slice(-modal.static, None)
        modes.phi[:, at], modes.gamma[at] = modal.phi[:, at], modal.gamma[at]
    test = modal.records
    index = Index(structure.n_sensors, modes.omega.size, structure.n_base)
    path = parametrisation(problem, structure, modes, index)
    unknowns = path.unit.size - path.gauge.shape[1]
    records, B, spectra, scattered = noise_records(test, structure, unknowns), None, None, modal.scattered
    found = coupling_about(modal, modes) if modal.of_records else None
    if modal.of_records:
        A, B = information_about(modal, modes)
    else:
        spectra = spectra_of(test, modes)
        A = information(modes, index, [record.grams(spectra) for record in records])
        if not structure.modal_damping:
            coupling, rigid = _coupling_of(structure), structure.rigid_body_mass
            A, found = coupling_information(test, records, modes, rigid, coupling, structure.residual.static)
        if not all(record.shared for record in records):
            B = information(modes, index, [record.sandwich_grams(spectra) for record in records])
        if structure.modal_damping and (uneven := scatter_of_lines(test, modes, structure.rigid_body_mass)):
            (A, B), scattered = uneven, np.inf
    normals, unseen = spread(A, B, path)
    inflation = inflation_of(test, records, unknowns, scattered)
    shifts, gains = np.zeros((index.size, 0)), gains or modal.calibration is not None
    plain = normals if B is None or not (gains or test.window) else spread(A, None, path)[0]
    if gains:
        if spectra is not None:
            direct = [test.rigid_body, structure.rigid_body_mass]
            pulls = gain_gradients(modes, index, direct, [record.grams(spectra) for record in records])
        else:
            pulls = A @ shifts_about(modal, modes)
        shifts = 2 * plain @ (plain.T @ pulls)  # these make half the inverse of the information
    leaked = leakage_moves(test, structure, modes, index, records, plain)
    normals = np.hstack([(1.0 if np.isnan(inflation) else inflation) * normals, leaked])
    if modal.calibration is not None:
        normals = np.hstack([normals, shifts @ modal.calibration.moves])
    return modes, index, inflation, normals, unseen, shifts, found


def _coupling_of(structure: Structure) -> Array:
    """Off-diagonal entries of ``Phi' C Phi`` of all modes, those of residual ones among them zero, (m, m)."""
    beyond = structure.residual.natural_frequencies
    order = np.argsort(np.concatenate([structure.natural_frequencies, beyond]), kind="stable")
    own = structure.modal_damping_matrix
    return np.pad(own - np.diag(np.diag(own)), (0, beyond.size))[np.ix_(order, order)]


def _by_unknowns(problem: Prepared, structure: Structure, x: Array) -> Uncertainty:
    """Standard deviations from the Jacobian of all that is fitted, in the problem's unknowns."""
    test, modes = problem.measurement, separated_modes(structure)
    formulation, x = with_totals(problem, structure, x)
    slopes = slopes_of(formulation.matrices, x, test, modes.omega)
    known = sensitivity(formulation, x, slopes)
    shifts: Array = np.zeros((x.size, test.n_sensors + 2 * test.n_base))
    if formulation.fits_records:
        known, shifts = _with_gains(formulation, x, slopes, known)
    steps, count = known.steps, known.normals.shape[1]
    term, inflation = formulation.own_test, 1.0
    scattered = term.estimate.scattered if structure.modal_damping else None  # as `rows_of_test` does
    if formulation.fits_records:
        fitted = x.size + term.matrices.beyond.size
        inflation = inflation_of(test, noise_records(test, structure, fitted), fitted, scattered)
    shapes = np.einsum("si,ikc->skc", structure.recovery, slopes.d_shapes)
    parts = (shapes, slopes.d_participation, slopes.d_log_omega, slopes.d_log_ratios, slopes.d_rigid)
    moves = Perturbations(count, *(part @ steps for part in parts))
    matrices = []
    for matrix, slope in blocks_and_slopes(structure, slopes):
        size = np.sqrt(np.abs(np.diag(matrix)))
        matrices.append(std_of(slope @ steps, count, np.outer(size, size)))
    by_gain = np.abs(np.einsum("iic,cs->si", slopes.mass, shifts[:, : test.n_sensors]))
    spectra: ModalSpectra | DirectSpectra = ModalSpectra(modes, moves, structure.rigid_body_mass)
    if not structure.modal_damping:
        spectra = DirectSpectra(slopes, steps, count)
    found = _quantities(problem, structure, modes, moves, inflation, matrices, by_gain, spectra)
    return _with_unknowns(found, problem, formulation, x, known)


def _with_gains(formulation: Formulation, x: Array, slopes: Slopes, known: Sensitivity) -> tuple[Sensitivity, Array]:
    """Add to the moves of x those that make up for errors of gains: within tolerances, or `GainErrors.possible`.

    And what an error of one of each gain makes of x, (size of x, n_sensors + 2 d).
    """
    estimate = formulation.own_test.estimate
    possible = gain_errors(estimate, slopes.structure).possible
    inverse = known.unit[:, None] * known.seen / known.singular_values[: known.rank]
    shifts = inverse @ (inverse.T @ _pulled_by_gains(formulation.own_test, slopes, x.size))
    moves = [known.normals, (shifts[:, : possible.size] * possible)[:, possible > 0]]
    if estimate.calibration is not None:
        moves.append(shifts @ estimate.calibration.moves)
    return replace(known, normals=np.hstack(moves)), shifts


def _pulled_by_gains(term: TestTerm, slopes: Slopes, size: int) -> Array:
    """``J' W y``, y what an error of one of each gain makes of the records, (size, n_sensors + 2 d): see `Gains`."""
    test, structure, (n, d) = term.test, slopes.structure, term.test.rigid_body.shape
    rows, weights = term.rows_of(slopes, size), weights_of_test(test, weighted=True)
    whole = structure.relative_acceleration(test.freq) + test.rigid_body[..., None]
    spectra = [whole, structure.base_force(test.freq)][: len(weights)]
    pull = np.zeros((size, n + 2 * d))
    if len(rows[0].jacobian) != 2 * n * test.n_runs * test.freq.size:  # rows of modes in place of those of lines
        factor = term.weight / weights[0][1] * independent_rows(term.estimate)[0]
        return np.asarray(rows[0].jacobian.T @ (factor @ term.estimate.gain.moves))
    for first, row, (weight, scale), H in zip((0, n + d), rows, weights, spectra, strict=False):
        by_base = np.stack([columns(one) for one in np.einsum("cdf,rdf->drcf", H, test.base)])
        by_base = term.weight * weight / scale * by_base  # (d, channels, runs * n_freq)
        real, imaginary = row.jacobian.reshape(2, *by_base.shape[1:], -1)
        of_channel = np.sum(by_base, axis=0)
        pull[:, first : first + len(H)] = np.einsum("clp,cl->pc", real, of_channel.real) + np.einsum(
            "clp,cl->pc", imaginary, of_channel.imag
        )
        pull[:, n : n + d] -= np.einsum("clp,dcl->pd", real, by_base.real) + np.einsum(
            "clp,dcl->pd", imaginary, by_base.imag
        )
    return pull


def _with_unknowns(
    found: Uncertainty, problem: Prepared, formulation: Formulation, x: Array, known: Sensitivity
) -> Uncertainty:
    """Add the unknowns that mean something by themselves, and their covariance where all do."""
    unknowns, names = formulation.unknowns, {unknown.name for unknown in problem.variables}
    std = std_of(known.steps, known.normals.shape[1], known.unit)
    of_unknowns = zip(unknowns, split(unknowns, meaningful(formulation)), strict=True)
    known_names = [unknown.name for unknown, part in of_unknowns if np.all(part) and unknown.name in names]
    values, variables = ({name: by_name(unknowns, every)[name] for name in known_names} for every in (x, std))
    found = replace(found, values=values, variables=variables)
    if len(known_names) < len(unknowns):
        return found
    covariance = known.normals @ known.normals.T
    covariance[np.isnan(std)], covariance[:, np.isnan(std)] = np.nan, np.nan
    return replace(found, parameters=formulation.labels, covariance=covariance)


def separated_modes(structure: Structure) -> Modes:
    """The modal model, repeated frequencies a little apart.

    At one frequency the shapes are open to a rotation that no record sees and K_SS does not feel; a small distance
    gives both a finite part, and K_SS keeps the variance of its off-diagonal modal entries.
    """
    omega = 2 * np.pi * structure.natural_frequencies
    for k in range(1, omega.size):
        omega[k] = max(omega[k], omega[k - 1] * (1 + NEGLIGIBLE))
    ratios = np.maximum(structure.damping_ratios, NEGLIGIBLE)
    return Modes(structure.mode_shapes, structure.participation, omega, ratios)


def _all_modes(structure: Structure) -> Modes:
    """`separated_modes` with the residual ones among them, ascending."""
    own, beyond = separated_modes(structure), structure.residual
    ratios = np.maximum(beyond.damping_ratios, NEGLIGIBLE)
    every = own.joined(Modes(beyond.shapes, beyond.participation, beyond.omega, ratios))
    return every.at(np.argsort(every.omega, kind="stable"))


def _quantities(
    problem: Prepared, structure: Structure, modes: Modes, moves: Perturbations, inflation: float,
    matrices: Sequence[Array], by_gain: Array, spectra: ModalSpectra | DirectSpectra,
) -> Uncertainty:  # fmt: skip
    """Standard deviations of all quantities from the perturbations; `matrices` are those of M_SS, K_SS and C.

    `by_gain` is `Uncertainty.mass_by_gain`.
    """
    phi, gamma, omega, ratios = modes
    frequencies, n = omega / (2 * np.pi), structure.n
    d_frequencies, d_ratios = frequencies[:, None] * moves.log_omega, ratios[:, None] * moves.log_ratios
    frequency_std, ratio_std = moves.std(d_frequencies, frequencies), moves.std(d_ratios, ratios)
    ratio_std = np.where(problem.formulation.tells_damping, ratio_std, np.nan)  # it may be stated, and is not found
    shape_std = moves.std(moves.phi, np.abs(phi).max(axis=0))
    hidden = np.isnan(shape_std).any(axis=0)  # a shape of unknown scale leaves its participation unknown
    push_std = moves.std(moves.gamma, np.abs(gamma).max())
    shape_std[:, hidden], push_std[hidden] = np.nan, np.nan

    normal = moves.gamma[:, :, : moves.normals]
    together = np.einsum("kic,kjc->kij", normal, normal)
    each = np.einsum("kii->ki", together)
    first = np.einsum("ki,kjc->kijc", gamma, moves.gamma)
    first = first + first.swapaxes(1, 2)
    size = np.sqrt(np.diag(structure.rigid_body_mass))
    size = np.outer(size, size)
    effective = np.sqrt(moves.std(first, size) ** 2 + each[:, :, None] * each[:, None] + together**2)
    effective[hidden] = np.nan

    known = np.isfinite(push_std)
    changes = np.concatenate([d_frequencies, d_ratios, moves.gamma[known]])[:, : moves.normals]
    covariance = changes @ changes.T
    lost = np.isnan(np.concatenate([frequency_std, ratio_std, push_std[known]]))
    covariance[lost], covariance[:, lost] = np.nan, np.nan
    names = [f"frequency {k + 1}, Hz" for k in range(n)] + [f"damping ratio {k + 1}" for k in range(n)]
    axes = problem.measurement.base_axes or ()
    names += [f"participation {k + 1} {axes[j]}" for k, j in np.argwhere(known)]
    return Uncertainty(
        structure=structure,
        natural_frequencies=frequency_std,
        damping_ratios=ratio_std,
        mode_shapes=shape_std,
        participation=push_std,
        effective_masses=effective,
        rigid_body_mass=moves.std(moves.rigid, size),
        mass=matrices[0],
        stiffness=matrices[1],
        damping=matrices[2],
        parameters=tuple(names),
        covariance=covariance,
        inflation=inflation,
        _spectra=spectra,
        mass_by_gain=by_gain,
    )
