"""The modal-mass cone as a convex set, and the exact extremes of linear functions over it.

A member is a symmetric T >= 0 with one block a cluster of modes; T = I is the model that was found. What is
known of the mass holds linear functions of T equal, or bounds them from above. Where no matrix bounds T and no
cluster is open the extremes are linear programmes. Elsewhere they are semidefinite ones: a barrier method takes
all functions along the central path at once (Boyd and Vandenberghe, Convex Optimization, 2004, section 11.6).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement, pairwise
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.structure.structure import Array
from sysid.structure.thresholds import EXACT, NEGLIGIBLE, ROUND_OFF, round_off

Pairs = list[tuple[int, int]]


def unknowns(clusters: Sequence[list[int]]) -> Pairs:
    """Entries of T on and above its diagonal, cluster by cluster."""
    return [pair for cluster in clusters for pair in combinations_with_replacement(cluster, 2)]


def forms(left: Array, right: Array, pairs: Pairs) -> Array:
    """Coefficients of the unknowns in ``left' T right``, (columns of left, columns of right, unknowns).

    T is symmetric, with one entry for each of `pairs`.
    """
    k, m = np.array(pairs, dtype=int).reshape(-1, 2).T
    one = left[k][:, :, None] * right[m][:, None, :]
    other = left[m][:, :, None] * right[k][:, None, :] * (k != m)[:, None, None]
    return np.moveaxis(one + other, 0, -1)


def null_space(system: Array) -> Array:
    """Directions of the unknowns that the equations leave open, one a row, orthonormal."""
    _, s, vt = np.linalg.svd(system)
    return vt[np.count_nonzero(s > NEGLIGIBLE) :]


class Affine(NamedTuple):
    """That ``at_start + sum_j z_j slopes[:, :, j]``, (s, s) and (s, s, k), is positive semidefinite."""

    at_start: Array
    slopes: Array


class Region(NamedTuple):
    """The part of the cone that something limits: unknowns ``start + z @ open`` in coordinates of order one.

    The limited block t of T has order `width` and the unknown entries `pairs`; `start` (m,) is T = I, `open` (k, m)
    are directions that no equation fixes; `signs` tell that T >= 0, `limits` the bounds from above.
    """

    width: int
    pairs: Pairs
    start: Array
    open: Array
    signs: list[Affine]
    limits: list[Affine]

    def coefficients(self, functions: Array) -> Array:
        """Coefficients (q, m) of the unknowns in ``trace(C t)``, C (q, width, width) symmetric."""
        k, m = self.indices
        return functions[:, k, m] * np.where(k == m, 1, 2)

    def block(self, values: Array) -> Array:
        """The symmetric t, (q, width, width), of values (q, m) of the unknowns."""
        t, (k, m) = np.zeros((len(values), self.width, self.width)), self.indices
        t[:, k, m] = t[:, m, k] = values
        return t

    @property
    def indices(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows and columns of the unknowns in t, (m,) each."""
        k, m = np.array(self.pairs, dtype=int).reshape(-1, 2).T
        return k, m


@dataclass(frozen=True, eq=False)
class Cone:
    """Symmetric ``T >= 0`` with one block a cluster of modes, and what is known of it. ``T = I`` belongs to it.

    Parameters
    ----------
    clusters : sequence of list of int
        Modes 0 to n - 1, ascending; T is zero between clusters.
    fixed : sequence of (n, w)
        Weights W, each for one cluster and orthonormal, for which ``W' T W`` is known: it is ``W' W``.
    traces : sequence of (n, w)
        Weights with ``trace(W' T W) <= 1``.
    matrices : sequence of (n, w)
        Weights with ``W' T W <= I`` in the sense of Loewner.
    equations : (e, m), optional
        Linear functions of the unknowns (`unknowns`) that keep the value that they have for T = I; they count beside
        `signs` only.
    signs : (p, m), optional
        Linear functions, all positive for T = I, that are nonnegative exactly where T >= 0, given that the equations
        hold: the masses of a lumped model, the springs of a chain.
    """

    clusters: Sequence[list[int]]
    fixed: Sequence[Array] = ()
    traces: Sequence[Array] = ()
    matrices: Sequence[Array] = ()
    equations: Array | Sequence[Array] = ()
    signs: Array | None = None

    @property
    def n(self) -> int:
        """Number of modes."""
        return sum(map(len, self.clusters))

    @cached_property
    def bases(self) -> list[tuple[Array, Array]]:
        """Directions of each cluster that something limits, (r, b), scaled to order one, and the others, (r, r - b).

        Under equations each direction counts as limited: they may tie it to others.
        """
        if self.signs is not None:
            return [(np.eye(len(c)), np.zeros((len(c), 0))) for c in self.clusters]
        weight = sum((W @ W.T for W in (*self.fixed, *self.traces, *self.matrices)), np.zeros((self.n, self.n)))
        spectra = [np.linalg.eigh(weight[np.ix_(c, c)]) for c in self.clusters]
        least = round_off(len(spectra)) * max(lam.max() for lam, _ in spectra)
        return [(V[:, lam > least] / np.sqrt(lam[lam > least]), V[:, lam <= least]) for lam, V in spectra]

    @cached_property
    def groups(self) -> list[list[int]]:
        """Limited directions of each cluster, numbered through."""
        ends = np.cumsum([0, *(bound.shape[1] for bound, _ in self.bases)]).tolist()
        return [list(range(a, b)) for a, b in pairwise(ends)]

    @cached_property
    def region(self) -> Region:
        """Region of the limited directions; the others follow (`_follow`)."""
        pairs, width = unknowns(self.groups), sum(map(len, self.groups))
        scale, at_identity = np.zeros((self.n, width)), np.zeros((width, width))
        for cluster, group, (bound, _) in zip(self.clusters, self.groups, self.bases, strict=True):
            inverse = np.linalg.pinv(bound)
            scale[np.ix_(cluster, group)] = bound
            at_identity[np.ix_(group, group)] = inverse @ inverse.T
        start = np.array([at_identity[pair] for pair in pairs])
        of = lambda W: forms(scale.T @ W, scale.T @ W, pairs)  # noqa: E731

        rows = [np.zeros((0, len(pairs))), *(of(W)[np.triu_indices(W.shape[1])] for W in self.fixed)]
        if self.signs is None:
            open_ = null_space(np.vstack(rows))
            units = [np.eye(width)[:, group] for group in self.groups if group]
            signs = [Affine(unit.T @ at_identity @ unit, forms(unit, unit, pairs) @ open_.T) for unit in units]
        else:
            open_ = null_space(np.vstack([*rows, *self.equations]))
            signs = [Affine(np.eye(1), (row @ open_.T / (row @ start))[None, None]) for row in self.signs]
        limits = [np.einsum("iiu->u", of(W))[None, None] for W in self.traces] + [of(W) for W in self.matrices]
        bounds = [_varying(np.eye(len(form)) - form @ start, -form @ open_.T) for form in limits]
        return Region(width, pairs, start, open_, signs, [bound for bound in bounds if len(bound.at_start)])

    def largest(self, functions: Array) -> tuple[Array, Array]:
        """Suprema of the linear functions ``trace(C T)`` over the cone.

        Parameters
        ----------
        functions : (q, n, n)
            Symmetric C, scaled so that their entries are of order one or below.

        Returns
        -------
        values : (q,)
            Infinite where the function has no bound.
        members : (q, n, n)
            T that attain them (the barrier's to `EXACT` of the function's range); NaN where they are infinite.

        Raises
        ------
        RuntimeError
            Where a linear programme or the barrier method does not end at an extreme.
        """
        values, members = np.full(len(functions), np.inf), np.full_like(functions, np.nan, dtype=float)
        followers, finite = self._follow(functions)
        region = self.region
        C = np.zeros((len(functions), region.width, region.width))
        for cluster, group, Z in zip(self.clusters, self.groups, followers, strict=True):
            block = functions[:, cluster][:, :, cluster]
            C[:, np.array(group, dtype=int)[:, None], group] = np.swapaxes(Z, 1, 2) @ block @ Z
        coefficients = region.coefficients(C)
        finite[finite] = self._bounded(coefficients[finite])
        best = self._best(coefficients[finite])
        values[finite] = np.sum(coefficients[finite] * best, axis=1)
        t, T = region.block(best), np.zeros((len(best), self.n, self.n))
        for cluster, group, Z in zip(self.clusters, self.groups, followers, strict=True):
            block = t[:, group][:, :, group]
            T[:, np.array(cluster)[:, None], cluster] = Z[finite] @ block @ np.swapaxes(Z[finite], 1, 2)
        members[finite] = T
        return values, members

    def _follow(self, functions: Array) -> tuple[list[Array], NDArray[np.bool_]]:
        """Best unlimited directions for the limited ones: ``T = Z t Z'``, Z (q, r, b) for each cluster.

        With U the unlimited directions, X their coupling to the limited ones and t the limited block, T_UU >= X' t X
        and nothing else: the supremum of the quadratic in X is finite where ``U' C U`` is negative semidefinite and
        its null space takes no part in the coupling. Second answer, (q,): whether it is finite.
        """
        finite: NDArray[np.bool_] = np.ones(len(functions), dtype=bool)
        followers: list[Array] = []
        for cluster, (bound, free) in zip(self.clusters, self.bases, strict=True):
            C = functions[:, cluster][:, :, cluster]
            lam, V = np.linalg.eigh(free.T @ C @ free)
            unit = bound / np.where(np.linalg.norm(bound, axis=0) > 0, np.linalg.norm(bound, axis=0), 1.0)
            coupling = np.swapaxes(V, 1, 2) @ (free.T @ C @ bound)
            touched = np.abs(np.swapaxes(V, 1, 2) @ (free.T @ C @ unit)).max(axis=2, initial=0.0) > ROUND_OFF
            finite &= ~np.any((lam > ROUND_OFF) | ((lam > -ROUND_OFF) & touched), axis=1)
            falling = lam < -ROUND_OFF
            response = coupling * np.where(falling, -1 / np.where(falling, lam, 1.0), 0.0)[:, :, None]
            followers.append(bound + free @ (V @ response))
        return followers, finite

    def _bounded(self, coefficients: Array) -> NDArray[np.bool_]:
        """True where equations and limits keep each function from growing for ever, (q,)."""
        escape = self._escape
        if escape is None:
            return np.ones(len(coefficients), dtype=bool)
        gains = [
            _programme(c, escape, np.zeros(len(escape)), box=1.0) @ c / max(1.0, np.abs(c).max())
            for c in coefficients @ self.region.open.T
        ]
        return np.array(gains) <= ROUND_OFF

    @cached_property
    def _escape(self) -> Array | None:
        """Rows that are nonnegative along directions of no end, (rows, k); None where there are none such.

        Only equations leave the question open. A limit lets T grow only where it does not weigh it at all.
        """
        region = self.region
        if self.signs is None or not len(region.open):
            return None
        rows = [sign.slopes[0] for sign in region.signs]
        rows += [np.einsum("iik->k", limit.slopes)[None] for limit in region.limits]
        escape = np.vstack(rows)
        total = escape[: len(region.signs)].sum(axis=0)
        farthest = _programme(total, escape, np.zeros(len(escape)), box=1.0) @ total
        return escape if farthest > NEGLIGIBLE else None

    def _best(self, coefficients: Array) -> Array:
        """Unknowns at which bounded functions are largest, (q, m)."""
        region = self.region
        if self._escape is not None:
            # Neither a limit nor the function itself need hold what the function does not feel.
            away = -np.sum([sign.slopes for sign in region.signs], axis=0)
            region = region._replace(limits=[*region.limits, Affine(np.full((1, 1), 1 / NEGLIGIBLE), away)])
        best = np.tile(region.start, (len(coefficients), 1))
        slopes = coefficients @ region.open.T
        moving = np.abs(slopes).max(axis=1, initial=0.0) > ROUND_OFF * np.abs(coefficients).max(axis=1, initial=0.0)
        if not np.any(moving):
            return best
        if not self.fixed and self.signs is None and len(region.limits) == 1 and len(region.limits[0].at_start) == 1:
            best[moving] = self._one_limit(coefficients[moving])
            return best
        c = slopes[moving]
        parts = [*region.signs, *region.limits]
        if all(len(part.at_start) == 1 for part in parts):
            at_start, rows = _rows(parts, c.shape[1])
            z = np.array([_programme(one / np.abs(one).max(), rows, at_start) for one in c])
        else:
            z = _barrier(c, _room(region))
        best[moving] += z @ region.open
        best[np.abs(best) < 1e-14] = 0.0
        return best

    def _one_limit(self, coefficients: Array) -> Array:
        """With the scaled ``trace(t) <= 1`` alone all the trace goes to the largest eigenvalue, or nowhere."""
        k, m = self.region.indices
        # An eigenvector over two blocks is one in each: T without its cross part does as well.
        lam, V = np.linalg.eigh(self.region.block(coefficients / np.where(k == m, 1, 2)))
        T = (lam[:, -1] > 0)[:, None, None] * V[:, :, -1:] @ np.swapaxes(V[:, :, -1:], 1, 2)
        return np.asarray(T[:, k, m])


def _varying(at_start: Array, slopes: Array) -> Affine:
    """The same condition on the directions that vary: what is constant acts through its Schur complement."""
    size = len(at_start)
    U, s, _ = np.linalg.svd(slopes.reshape(size, -1))
    rank = int(np.count_nonzero(s > ROUND_OFF))
    V, W = U[:, :rank], U[:, rank:]
    tie = V.T @ at_start @ W
    constant = V.T @ at_start @ V - tie @ np.linalg.pinv(W.T @ at_start @ W, rcond=ROUND_OFF, hermitian=True) @ tie.T
    return Affine(constant, np.einsum("ia,ijk,jb->abk", V, slopes, V))


def _programme(function: Array, rows: Array, at_start: Array, box: float = np.inf) -> Array:
    """The z with the largest ``function @ z`` where ``at_start + rows @ z >= 0`` and |z| <= box."""
    answer = scipy.optimize.linprog(
        -function / (np.abs(function).max() or 1.0), A_ub=-rows, b_ub=at_start, bounds=(-box, box),
        options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
    )  # fmt: skip
    if answer.status != 0:
        raise RuntimeError(f"an extreme of the modal-mass cone was not found: {answer.message}")
    return np.asarray(answer.x)


class _Room(NamedTuple):
    """Rows ``at_start + rows @ z >= 0`` and matrix blocks, and a z that meets all with room to spare."""

    at_start: Array
    rows: Array
    blocks: list[Affine]
    inside: Array


def _room(region: Region) -> _Room:
    """The region for the barrier method: conditions on one number, on matrices, and a start inside all of them."""
    # T falls towards zero along what is open: that leaves room under the limits, if anything does.
    falling = -0.5 * region.open @ region.start
    least = lambda parts, z: min((np.linalg.eigvalsh(p.at_start + p.slopes @ z)[0] for p in parts), default=1.0)  # noqa: E731
    stay = np.zeros_like(falling)
    starts = [z for z in (falling, stay) if least(region.signs, z) > 0]
    inside = max(starts, key=lambda z: float(least(region.limits, z)))
    parts = [*region.signs]
    for p in region.limits:
        parts.append(Affine(p.at_start + max(0.0, ROUND_OFF - least([p], inside)) * np.eye(len(p.at_start)), p.slopes))
    return _Room(*_rows(parts, inside.size), [p for p in parts if len(p.at_start) > 1], inside)


def _rows(parts: Sequence[Affine], k: int) -> tuple[Array, Array]:
    """Start (rows,) and slopes (rows, k) of the conditions on one number each."""
    single = [p for p in parts if len(p.at_start) == 1]
    return np.array([p.at_start[0, 0] for p in single]), np.array([p.slopes[0, 0] for p in single]).reshape(-1, k)


def _barrier(functions: Array, room: _Room) -> Array:
    """The z at which each of the functions, (q, k), is largest, to `EXACT` of its range."""
    nowhere = np.zeros((1, functions.shape[1]))
    centre = _centred(nowhere, room, room.inside[None])
    _, root, _ = _derivatives(room, centre)
    # The ellipsoid of the Hessian lies inside the region and fills it up to a factor of its order. No direction
    # counts for more than the order one that the unknowns are scaled to.
    metric = root[0].T @ root[0] + np.eye(functions.shape[1])
    extent = np.sqrt(np.sum(functions * np.linalg.solve(metric, functions.T).T, axis=1))
    scaled = functions / extent[:, None]
    z = np.repeat(centre, len(functions), axis=0)
    order = len(room.rows) + sum(len(block.at_start) for block in room.blocks)
    weight = 1.0
    while order > EXACT * weight:  # the gap on the central path is order / weight
        weight *= 8
        z = _centred(weight * scaled, room, z)
    return z


def _centred(pull: Array, room: _Room, z: Array) -> Array:
    """Points of the central path, maxima of ``pull @ z`` + log det of all slacks, by Newton's method."""
    for _ in range(200):
        gradient, root, spread = _derivatives(room, z)
        # The Hessian is root' root; near a corner only its triangular factor has a condition to compute with.
        triangle = np.linalg.qr(root, mode="r")
        half = np.linalg.solve(np.swapaxes(triangle, 1, 2), (pull + gradient)[:, :, None])
        if np.sum(half**2, axis=1).max() < 1e-4:  # squared Newton decrement: near enough to the central path
            return z
        step = np.linalg.solve(triangle, half)[:, :, 0]
        rates = spread(step)
        # The exact maximum along the step, which is concave: bisection of its derivative up to the boundary.
        low = np.zeros(len(z))
        high = np.minimum(1 / np.maximum(-rates.min(axis=1), 1e-9), 1e9)
        for _ in range(50):
            middle = (low + high) / 2
            rising = np.sum(pull * step, axis=1) + np.sum(rates / (1 + middle[:, None] * rates), axis=1) > 0
            low, high = np.where(rising, middle, low), np.where(rising, high, middle)
        z = z + low[:, None] * step
    raise RuntimeError("an extreme of the modal-mass cone was not found: the barrier method does not settle")


def _derivatives(room: _Room, z: Array) -> tuple[Array, Array, Callable[[Array], Array]]:
    """Of log det of all slacks: gradient (q, k), root (q, r, k) of the negative Hessian, and rates along a step."""
    relative = room.rows / (room.at_start + z @ room.rows.T)[:, :, None]
    gradient, roots, whitened = relative.sum(axis=1), [relative], []
    for block in room.blocks:
        inverse = np.linalg.inv(np.linalg.cholesky(block.at_start + np.einsum("qk,ijk->qij", z, block.slopes)))
        slopes = np.einsum("qai,ijk,qbj->qabk", inverse, block.slopes, inverse, optimize=True)
        gradient = gradient + np.einsum("qaak->qk", slopes)
        roots.append(slopes.reshape(len(z), -1, z.shape[1]))
        whitened.append(slopes)

    def rates(step: Array) -> Array:
        parts = [np.einsum("qrk,qk->qr", relative, step)]
        parts += [np.linalg.eigvalsh(np.einsum("qabk,qk->qab", slopes, step)) for slopes in whitened]
        return np.concatenate(parts, axis=1)

    return gradient, np.concatenate(roots, axis=1), rates
