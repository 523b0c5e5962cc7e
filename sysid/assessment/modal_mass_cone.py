"""The modal-mass cone: what the data determine of mass and stiffness.

Base and response accelerations fix frequencies, damping ratios and rank-one residues, and nothing
else. All models that explain them are ``M_SS = P' T P``, ``K_SS = P' W T W P``, ``M_S0 = P' T (Gamma - P G)``,
with ``T = diag(t)``, one modal mass t_k > 0 a mode (P the inverse of the mode shapes, W the circular frequencies),
and a positive definite block of T for modes at one pole. What a measured force or a stated model adds is linear in T:
its rank tells what stays open (`closed_and_open`), and how far that may go is a convex problem (`ends`). Both hold
for all models at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from sysid.assessment.cone import Cone, Pairs, forms, null_space, unknowns
from sysid.finding import Finding, Severity
from sysid.measurement.measurement import Measurement
from sysid.measurement.whole import NoiseLevels, raised
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.residues import line_correlation
from sysid.modal_analysis.response import columns, gains, residual_share
from sysid.models.model import Geometry, Stated
from sysid.problem.formulation import Formulation
from sysid.problem.prepared import Prepared
from sysid.structure.structure import Array, ComplexArray, Structure
from sysid.structure.thresholds import NEGLIGIBLE, ROUND_OFF

UNIT_MASS = "no number with a unit of mass is given: masses are normalised to 1 kg in each base direction"
_UNRESOLVED = 20.0  # misfits, in parts of the half-power half-width, by which resolved poles differ
_CLEAR = 3.0  # misfits above which a mode's share of the responses is seen
_AS_STATED = 1.2  # times the stated noise, to which a misfit may be noise alone
_RESOLVED = 5.0  # standard deviations of a mode's amplitude, at which deviations tell how well it is known
_GAIN = 5e-3  # of the base's motion; a smaller error of a sensor's gain is not told from a mode below the lines


def applies(formulation: Formulation) -> bool:
    """True where the cone holds all models that explain the data, and what is stated of them.

    So it is where the records stand alone, damping is by ratios, and `Stated` tells all of mass and stiffness; not
    where residual modes are asked for beside a model of a form of its own.
    """
    if formulation.residual_modes and not formulation.free_modes:
        return False
    linear = all(stated.free or stated.entries is not None for stated in (formulation.mass, formulation.stiffness))
    return linear and formulation.by_ratios and formulation.geometry.at_sensors and formulation.test_alone


def left_open(sentence: str, **numbers: float) -> Finding:
    """A finding of something that is left open, and the figures in its sentence."""
    return Finding("open", Severity.CAUTION, sentence, numbers=numbers)


def closed_and_open(problem: Prepared, structure: Structure) -> tuple[tuple[str, ...], tuple[Finding, ...]]:
    """Reasons that close the modal masses of `structure`, in sentences, and what is left open.

    What counts as seen is judged against the misfit that the structure leaves: a mode whose share of
    the records is not clearly above it, poles that it cannot tell apart, and base directions that
    differ by less than it are not taken as known.
    """
    test = problem.measurement
    misfit = test.residual(structure)
    known = _known(problem, structure, misfit)
    free, common = _open_modes(known)
    relative = test.relative, test.predict(structure), test.response_std
    responses = _record(*relative, _CLEAR)
    seen = [*_unseen(problem, structure, misfit, responses, free), *_merged(known, test, structure, free, responses)]
    open_ = list(map(left_open, seen))
    if free:
        bounded = ", within what is stated" if len(known.equations) else ""
        alike = f"other mass and stiffness matrices answer identically{bounded}"
        what = _what_is_open(structure, free, common)
        open_ += map(left_open, [f"{what}: {alike}", *[UNIT_MASS] * problem.unit_mass])
    closed = known.sentence, _weighed_in_words(known, test, structure), _in_band_in_words(test, structure)
    return () if free else tuple(filter(None, closed)), tuple(open_)


def _in_band_in_words(test: Measurement, structure: Structure) -> str:
    """The degrees of freedom that hold the modes in the lines, where they are not the sensors; empty where they are."""
    if structure.at_sensors:
        return ""
    sensors, beyond = int(np.count_nonzero(structure.dof_modes < 0)), structure.residual
    others = structure.n - sensors
    what = f"{structure.n} modes on {sensors} of {structure.n_sensors} sensors"
    coordinates = f"{others} modal coordinate{'s' * (others > 1)}"
    what += f" and {coordinates}, which the Craig-Bampton form (to_craig_bampton()) holds" * bool(others)
    if structure.n < structure.n_sensors:
        what += "; a mode that the base does not excite is not among them"
    what += f"; {beyond_in_words(test, structure)}" * bool(beyond.count)
    return f"determined in {test.freq[0]:.4g} to {test.freq[-1]:.4g} Hz: {what}"


def beyond_in_words(test: Measurement, structure: Structure) -> str:
    """Share of the responses that residual modes add, in words."""
    share = 100 * residual_share(test, structure)
    return f"modes beyond the lines add {share:.2g} % of the response, and are kept as residual modes"


def _weighed_in_words(known: _Known, test: Measurement, structure: Structure) -> str:
    """Of modal masses that are all fixed, those that the base force fixes; empty where it was not measured."""
    if test.force is None:
        return ""
    moved, weighed = (sum(W.shape[1] for W in of) for of in (_moved(structure, known.clusters), known.weighed))
    if weighed == moved:
        return "the measured base force weighs each mode that the base moves"
    return f"the measured base force weighs {weighed} of {moved} modes that the base moves"


def _merged(
    known: _Known, test: Measurement, structure: Structure, free: list[int], responses: _Record
) -> Iterator[str]:
    """Modes that cannot be distinguished, as far as something of them is open, in sentences."""
    for cluster in (cluster for cluster in known.clusters if len(cluster) > 1):
        names = " and ".join(_mode(structure, k) for k in cluster)
        seen = _seen(test, structure, cluster, structure.mode_shapes, responses).shape[1]
        if seen < len(cluster):
            yield f"{names} are too close to be told apart, and the data show {seen or 'none'} of them only"
        elif not set(cluster).isdisjoint(free):
            yield f"{names} are too close to be told apart: only the sum of their residues is known"


def _what_is_open(structure: Structure, free: list[int], common: bool) -> str:
    """Which modal masses are open, in words."""
    if common:
        return "mass, stiffness and damping are known up to one common factor"
    if len(free) == structure.n:
        return "all modal masses are open"
    *others, last = (f"the modal mass of {_mode(structure, k)}" for k in free)
    return f"{', '.join(others)} and {last} are open" if others else f"{last} is open"


def open_modes(problem: Prepared, structure: Structure) -> list[int]:
    """Modes, counted from 0, whose modal mass neither the records nor the stated models fix."""
    return _open_modes(_known(problem, structure, problem.measurement.residual(structure)))[0]


def only_scale_is_open(problem: Prepared, structure: Structure) -> bool:
    """True where one scale of mass, stiffness and damping is open, and nothing else."""
    return _open_modes(_known(problem, structure, problem.measurement.residual(structure)))[1]


def ends(problem: Prepared, structure: Structure) -> tuple[Array, Array]:
    """Ends of each entry of M_SS and K_SS over the modal-mass cone.

    Parameters
    ----------
    problem : Prepared
    structure : Structure
        A member of the cone, and one that the models of `problem` can hold: what is known is taken to be equal to what
        it has, so that misfit closes nothing. Its poles, residues and mode shapes are kept, also the shape of a mode
        that the base does not move, of which the data tell nothing.

    Returns
    -------
    mass, stiffness : (2, n, n)
        Lower ends, then upper ends; each is attained by a member, or approached by members where a modal mass of zero
        attains it.
    """
    n = structure.n
    known = _known(problem, structure, problem.measurement.residual(structure))
    mass, stiffness = structure.mass[:n, :n], structure.stiffness[:n, :n]
    if not _open_modes(known)[0]:
        return np.stack([mass, mass]), np.stack([stiffness, stiffness])
    cone = _cone(problem, structure, known)
    P = np.linalg.inv(structure.normal_modes)
    omega = 2 * np.pi * structure.natural_frequencies[:, None]
    return _entries(cone, P, mass), _entries(cone, P * omega, stiffness)


def _entries(cone: Cone, rows: Array, at_identity: Array, at_once: int = 100) -> Array:
    """Ends of the entries of ``rows' T rows``, (2, n, n), so many at once; `at_identity` is their value for T = I."""
    size = np.linalg.norm(rows, axis=0)
    unit = (rows / size).T
    ends = np.empty((2, *at_identity.shape))
    upper = np.array(np.triu_indices(len(at_identity)))
    for i, j in np.array_split(upper, -(-upper.shape[1] // at_once), axis=1):
        functions = unit[i][:, :, None] * unit[j][:, None, :]
        functions = (functions + np.swapaxes(functions, 1, 2)) / 2
        values, _ = cone.largest(np.concatenate([-functions, functions]))
        values = values.reshape(2, -1)
        largest = np.where(np.isfinite(values), np.abs(values), 1.0).max(axis=0)
        values = np.where(np.abs(values) < NEGLIGIBLE * largest + ROUND_OFF, 0.0, values) * size[i] * size[j]
        ends[0, i, j] = ends[0, j, i] = np.minimum(-values[0], at_identity[i, j])
        ends[1, i, j] = ends[1, j, i] = np.maximum(values[1], at_identity[i, j])
    return ends


class _Known(NamedTuple):
    """Statements that hold linear functions of T equal to what they are for T = I.

    `clusters` are modes that the misfit cannot tell apart, `weighed` the directions W (n, w) of a cluster that the
    base force weighs: ``W' T W`` is known. `equations` (e, m), scaled to order one, are what the stated models of
    `sentence` add; `signs` (p, m) are masses or springs that these leave, as functions of the unknowns.
    """

    clusters: list[list[int]]
    weighed: list[Array]
    equations: Array
    signs: Array | None
    sentence: str


def _known(problem: Prepared, structure: Structure, misfit: float) -> _Known:
    clusters = _clusters(structure, misfit)
    weighed = _weighed(problem.modal[0], structure, clusters)
    return _Known(clusters, weighed, *_model_equations(problem, structure, unknowns(clusters)))


def _open_modes(known: _Known) -> tuple[list[int], bool]:
    """Modes whose modal mass is open, and whether only one scale that is common to all modes is."""
    pairs = unknowns(known.clusters)
    rows = [forms(W, W, pairs).reshape(-1, len(pairs)) for W in known.weighed]
    null = null_space(np.vstack([known.equations, *rows]))
    taking_part = np.abs(null).max(axis=0, initial=0.0) > 1e-6
    free = sorted({k for pair, part in zip(pairs, taking_part, strict=True) if part for k in pair})
    eye = np.array([float(k == m) for k, m in pairs])  # T = I, which a common scale multiplies
    common = len(null) == 1 and abs(null[0] @ eye) > (1 - 1e-6) * np.linalg.norm(null[0]) * np.linalg.norm(eye)
    return free, bool(common) and sum(map(len, known.clusters)) > 1


def _cone(problem: Prepared, structure: Structure, known: _Known) -> Cone:
    """The modal-mass cone, with the bounds that a total mass or a rigid-body mass puts on it."""
    totals, n = problem.formulation.mass.totals, structure.n
    visible = sum((W @ (W.T @ structure.participation) for W in _moved(structure, known.clusters)), np.zeros((n, 1)))
    weighed = None if problem.measurement.force is None else structure.rigid_body_mass
    matrices = [_below(visible, bound) for bound in (weighed, problem.rigid_total) if bound is not None]
    traces: list[Array] = []
    if totals is not None and problem.rigid_total is None:
        if totals.kind == "rigid_body":
            traces = list(map(_at_most, visible.T[:, :, None], totals.values))
        elif totals.kind == "trace" and structure.at_sensors:
            traces = list(map(_at_most, _by_direction(problem.geometry, structure), totals.values))
    return Cone(known.clusters, known.weighed, traces, matrices, known.equations, known.signs)


def _by_direction(geometry: Geometry, structure: Structure) -> list[Array]:
    """Weights of each direction's part of trace M, its sensors' and, of M_00, what M cannot do without."""
    P = np.linalg.inv(structure.normal_modes)
    delta = structure.participation - P @ structure.rigid_body_dofs
    groups = geometry.directions[: geometry.n]
    return [np.hstack([P[:, groups == i], delta[:, [i]]]) for i in range(geometry.d)]


def _at_most(weights: Array, total: float) -> Array:
    """Weights W for ``trace(W' T W) <= 1``; what the structure itself has is never too much."""
    return weights / np.sqrt(max(total, float(np.sum(weights**2))) or 1.0)


def _below(weights: Array, bound: Array) -> Array:
    """Weights W for ``W' T W <= I``, of ``weights' T weights <= bound``; what the structure has is never too much."""
    at_identity = weights.T @ weights
    size = np.sqrt(np.maximum(np.diag(at_identity), np.diag(bound)))
    size = np.where(size > 0, size, 1.0)
    lam, V = np.linalg.eigh((bound - at_identity) / np.outer(size, size))
    lam, V = np.linalg.eigh(at_identity / np.outer(size, size) + (V * np.maximum(lam, 0.0)) @ V.T)
    some = lam > 1e-12 * lam[-1]
    return weights / size @ V[:, some] / np.sqrt(lam[some])


def _moved(structure: Structure, clusters: list[list[int]]) -> list[Array]:
    """For each cluster the directions that the base moves, orthonormal, (n, w)."""
    size = np.sqrt(np.diag(structure.rigid_body_mass))
    gamma = structure.participation / np.where(size > 0, size, 1.0)  # kg and kg m² can be compared
    strongest = np.linalg.norm(gamma, axis=1).max()
    moved: list[Array] = []
    for cluster in clusters:
        U, s, _ = np.linalg.svd(gamma[cluster], full_matrices=False)
        W = np.zeros((structure.n, np.count_nonzero(s > NEGLIGIBLE * strongest)))
        W[cluster] = U[:, : W.shape[1]]
        moved.append(W)
    return moved


def _weighed(modal: ModalEstimate, structure: Structure, clusters: list[list[int]]) -> list[Array]:
    """The same for what stands out of the misfit of the base force."""
    record = _forces(modal, structure)
    if record is None:
        return []
    weighed = [_seen(modal.records, structure, cluster, structure.participation.T, record) for cluster in clusters]
    return [W for W in weighed if W.shape[1]]


class _Record(NamedTuple):
    """A record beside what a structure leaves of it, all channels in units of their noise.

    `weight` is (channels, 1), or (runs, channels, n_freq) where the noise of each line is known; `size` the norm of
    the weighted record; `misfit` relative; a mode must exceed the part `level` of the record to be known.
    """

    weight: Array
    size: float
    misfit: float
    level: float


def _like_rigid(test: Measurement, structure: Structure, k: int) -> str:
    """Another meaning of a mode below the lines: far above it, sensors move by a constant times the base's motion."""
    moved = -np.outer(structure.mode_shapes[:, k], structure.participation[k])
    reach = np.abs(test.rigid_body).max(axis=0)
    wrong = np.abs(moved) / np.where(reach > 0, reach, np.inf)
    i, j = np.unravel_index(np.argmax(wrong), wrong.shape)
    if wrong[i, j] < _GAIN or structure.natural_frequencies[k] > test.freq[-1]:
        return ""
    return (
        f"; or sign, gain or axis of {test.sensor_names[i]} are wrong, which in all these lines moves by "
        f"{moved[i, j]:.2g} times base direction {j + 1} beside what its row of rigid_body says"
    )


def _record(record: ComplexArray, predicted: ComplexArray, std: Array | None, times: float) -> _Record:
    """Weigh a record; `times` the misfit is what may look like a mode where no noise is known.

    Where it is, an amplitude counts by the noise at its own lines, and `_RESOLVED` of its standard deviations will do;
    where the misfit is larger than that noise, so is what may look like a mode.
    """
    if (std := raised(std)) is not None:
        weight = 1 / std
        error = (record - predicted) * weight
        size, left = float(np.linalg.norm(record * weight)), float(np.linalg.norm(error))
        more = max(1.0, left / np.sqrt(weight.size) / _AS_STATED)
        if more > 1:  # what a model misses neighbouring lines share
            more *= np.sqrt(line_correlation(error.swapaxes(0, 1)))
        return _Record(weight, size, left / size, float(_RESOLVED * more / np.sqrt(2) / size))
    rms = lambda x: np.sqrt(np.mean(np.abs(x) ** 2, axis=(0, 2)))[:, None]  # noqa: E731
    noise, sizes = rms(record - predicted), rms(record)
    weight = 1 / np.maximum(noise, ROUND_OFF * np.where(sizes > 0, sizes, sizes.max()))
    size = float(np.linalg.norm(record * weight))
    misfit = float(np.linalg.norm((record - predicted) * weight)) / size
    return _Record(weight, size, misfit, times * misfit)


def _forces(modal: ModalEstimate, structure: Structure) -> _Record | None:
    """The base force, where it was measured."""
    test = modal.records
    if test.force is None:
        return None
    return _record(test.force, test.predict_force(structure), test.force_std, 1.0)


def _shares(test: Measurement, structure: Structure, k: int, rows: Array, push: Array, record: _Record) -> Array:
    """Relative size of what motions `rows` (channels, w) at mode k's pole make of a record, pushed by `push` (w, d)."""
    g = gains(test.freq, 2 * np.pi * structure.natural_frequencies[[k]], structure.damping_ratios[[k]])
    moved = np.einsum("wd,rdf->wrf", push, test.base) * g
    if record.weight.ndim == 3:
        pairs = zip(rows.T, moved, strict=True)
        seen = [np.linalg.norm(record.weight * row[:, None] * one[:, None]) for row, one in pairs]
        return np.array(seen) / record.size
    return np.linalg.norm(moved, axis=(1, 2)) * np.linalg.norm(record.weight * rows, axis=0) / record.size


def _seen(test: Measurement, structure: Structure, cluster: list[int], rows: Array, record: _Record) -> Array:
    """Directions of a cluster that stand out of a record in which the modes move `rows` (channels, n), (n, w)."""
    (W,) = _moved(structure, [cluster])
    shares = _shares(test, structure, cluster[0], rows @ W, W.T @ structure.participation, record)
    return W[:, shares >= record.level]


def _unseen(
    problem: Prepared, structure: Structure, misfit: float, responses: _Record, free: list[int]
) -> Iterator[str]:
    """Sentences on what the records do not show; a mode needs no force of its own where what is stated fixes it."""
    test = problem.measurement
    base = columns(test.base)
    sizes = np.linalg.norm(base, axis=1, keepdims=True)
    spread = np.linalg.svd(base / np.where(sizes > 0, sizes, 1.0), compute_uv=False)
    # With the noise of the base known, a direction is not moved where that noise makes most of its motion.
    noise = problem.modal[0].noise
    chance = min(misfit, 0.5) if noise is None else _base_noise(problem.modal[0], noise, sizes.ravel()) / spread[0]
    rank = int(np.count_nonzero(spread > max(1e-9, chance) * spread[0]))
    if rank < test.n_base:
        yield f"the base moves in only {rank} of {test.n_base} independent directions: responses to the others are open"
    count = int(np.count_nonzero(~problem.formulation.outside))
    if 2 * test.response.size < count:
        yield f"{2 * test.response.size} measured numbers cannot fix {count} unknowns"
    forces = _forces(problem.modal[0], structure)
    moved_within = [law.mode for law in structure.laws if law.reaches(*test.freq[[0, -1]])]
    for k in range(structure.n):
        f, push = structure.natural_frequencies[k], structure.participation[[k]]
        (share,) = _shares(test, structure, k, structure.mode_shapes[:, [k]], push, responses)
        if share < NEGLIGIBLE:
            yield f"{_mode(structure, k)} is not moved by the base: nothing in these data tells its mass"
        elif share < responses.level:
            yield (
                f"the mass of {_mode(structure, k)} is not known: it makes {100 * share:.3g} % of the response, and "
                f"what the fit misses ({100 * responses.misfit:.3g} % of the response) can look like a mode that makes "
                f"up to {100 * responses.level:.3g} %"
            )
        elif not (test.freq[0] <= f <= test.freq[-1] or k in moved_within):
            yield (
                f"{_mode(structure, k)} lies outside the lines ({test.freq[0]:.4g} to {test.freq[-1]:.4g} Hz) and "
                f"answers for all modes there{_like_rigid(test, structure, k)}"
            )
        elif k in free and forces and (part := _shares(test, structure, k, push.T, push, forces)[0]) < forces.level:
            yield (
                f"the mass of {_mode(structure, k)} is not weighed: it makes {100 * part:.3g} % of the base force, and "
                f"what the fit misses ({100 * forces.misfit:.3g} % of the force) can look like a mode that makes up to "
                f"{100 * forces.level:.3g} %"
            )


def _base_noise(modal: ModalEstimate, noise: NoiseLevels, sizes: Array) -> float:
    """Largest noise of a base direction over all lines, its record's size being 1."""
    lines = modal.density * np.count_nonzero(modal.records.own_lines, axis=1)
    size = np.sqrt(np.sum(noise.base**2 * lines[:, None], axis=0))
    return float(np.max(size / np.where(sizes > 0, sizes, np.inf)))


def _clusters(structure: Structure, misfit: float) -> list[list[int]]:
    """Modes that the misfit cannot tell apart: of them only the sum of the residues is seen."""
    poles = structure.natural_frequencies * (1 + 1j * structure.damping_ratios)
    widths = min(_UNRESOLVED * misfit, 1.0) * structure.damping_ratios * structure.natural_frequencies
    apart = np.abs(np.diff(poles)) >= np.maximum(NEGLIGIBLE * np.abs(poles), widths)[1:]
    return [part.tolist() for part in np.split(np.arange(structure.n), np.flatnonzero(apart) + 1)]


def _model_equations(problem: Prepared, structure: Structure, pairs: Pairs) -> tuple[Array, Array | None, str]:
    """Equations that the stated models add: `_Known.equations`, `signs` and `sentence`."""
    nothing = np.zeros((0, len(pairs)))
    if not structure.at_sensors:
        return nothing, None, ""
    mass, stiffness = problem.formulation.mass, problem.formulation.stiffness
    of_mass, masses = _of_mass(problem.geometry, mass, structure, pairs)
    of_stiffness, springs = _of_stiffness(stiffness, structure, pairs)
    rows = np.vstack([nothing, *of_mass, *of_stiffness])
    # Modes that share a block have no such rows: their intervals do without the equations.
    modal = np.eye(len(pairs)) if len(rows) and len(pairs) == structure.n else None
    signs = next((signs for signs in (masses, springs) if signs is not None), modal)
    return rows, signs, "; ".join(filter(None, (mass.sentence, stiffness.sentence)))


def _of_mass(
    geometry: Geometry, stated: Stated, structure: Structure, pairs: Pairs
) -> tuple[list[Array], Array | None]:
    """Equations that a stated mass adds, and the masses that it leaves."""
    if stated.entries is None:
        return [], None
    n, P = structure.n, np.linalg.inv(structure.normal_modes)
    delta = structure.participation - P @ structure.rigid_body_dofs
    size = np.linalg.norm(P, axis=0)
    entries = forms(P / size, P / size, pairs)
    coupling = forms(P / size, delta / (np.linalg.norm(delta) + size.max()), pairs)
    known = np.isfinite(stated.entries)
    rows = [entries[known[:, :n]], coupling[known[:, n:]]]
    if stated.totals is not None and stated.totals.kind == "sensors":
        for i in np.unique(geometry.directions[:n][geometry.directions[:n] >= 0]):
            of_direction = P[:, geometry.directions[:n] == i]
            rows.append(np.einsum("iiu->u", forms(of_direction, of_direction, pairs))[None] / np.sum(of_direction**2))
    diagonal = np.all(known[:, :n] | np.eye(n, dtype=bool))
    return rows, None if stated.free or not diagonal else np.einsum("iiu->iu", entries)


def _of_stiffness(stated: Stated, structure: Structure, pairs: Pairs) -> tuple[list[Array], Array | None]:
    """Equations that a stated stiffness adds, and the springs that it leaves."""
    if stated.entries is None:
        return [], None
    n, P = structure.n, np.linalg.inv(structure.normal_modes)
    P = P * (2 * np.pi * structure.natural_frequencies[:, None])
    size = np.sqrt(np.diag(structure.stiffness)[:n])
    entries, rigid = forms(P / size, P / size, pairs), P @ structure.rigid_body_dofs
    # K_S0 = -K_SS G: a floor that no spring ties to the base is at rest in a rigid motion.
    to_base = forms(P / size, rigid / np.linalg.norm(rigid, axis=0), pairs)
    known = np.isfinite(stated.entries)
    rows = [entries[known[:, :n]], to_base[known[:, n:]]]
    if stated.positive is None:
        return rows, None
    return rows, np.einsum("pij,iju->pu", stated.positive, entries * np.outer(size, size)[:, :, None])


def _mode(structure: Structure, k: int) -> str:
    return f"mode {k + 1} ({structure.natural_frequencies[k]:.4g} Hz)"
