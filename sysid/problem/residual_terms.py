r"""The answer of modes beyond the lines beside a model's own modes: linear, and eliminated by least squares.

At poles beyond the lines, that are held, any residues R_p (n_sensors, d) are added to the accelerations, and symmetric
ones D_p (d, d) to a measured base force:

.. math:: a \mathrel{+}= \sum_p R_p g_p \ddot u_0, \qquad f_0 \mathrel{+}= \sum_p D_p g_p \ddot u_0, \qquad
    g_p = \frac{\omega^2}{\omega_p^2 - \omega^2 + 2 i \zeta_p \omega_p \omega}

Far below its pole g is a multiple of w², the static answer of all modes above. Whatever the model leaves of the records
is projected off these functions, channel by channel, in the weights of the objective: its norm is then that of the best
residues, and its derivatives by the model's unknowns are exact (G. H. Golub, V. Pereyra, SIAM J. Numer. Anal. 10 (1973)
413-432).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
import scipy

from sysid.measurement.measurement import Measurement
from sysid.measurement.whole import products
from sysid.modal_analysis.modal_fit import STATIC_POLE, separate_poles
from sysid.modal_analysis.pole_functions import unit_columns
from sysid.modal_analysis.residues import Records
from sysid.modal_analysis.response import ABOVE, columns, gains, misfits, records_of, weights_of_test
from sysid.modal_analysis.spectra_modes import misses_static
from sysid.models.model import Geometry
from sysid.structure.structure import Array, ComplexArray, Structure
from sysid.structure.superelement import ResidualModes
from sysid.structure.thresholds import NEGLIGIBLE, round_off


@dataclass(frozen=True, eq=False)
class ResidualTerms:
    """Residues of a test at poles that are held, rad/s and damping ratios (p,).

    `shift`, 1/s, is that of the complex frequencies ``s = shift + i w`` at which the records are given.
    """

    test: Measurement
    omega: Array
    ratios: Array
    shift: float = 0.0

    @classmethod
    def of_geometry(cls, geometry: Geometry, *, free: bool, asked: bool, found: bool) -> ResidualTerms:
        """Terms of a test that a model with these degrees of freedom is fitted to; without poles where it has none.

        They come where they are `asked` for. Of a model whose modes are `free` the lowest poles of the records are its
        own; others above the lines make terms too, where they are `found` anyway, as does what grows as w² beside them.
        """
        modal, test = geometry.modal, geometry.test
        none = cls(test, np.zeros(0), np.zeros(0))
        if not (asked or (free and (found or modal.by_modes))):
            return none
        ratios = geometry.pole_ratios
        omega = geometry.poles.omega if ratios.size else ratios
        first = geometry.n if free else 0
        above = omega[first:] > 2 * np.pi * test.freq[-1]
        if free and modal.by_modes and np.any(above):
            separate = np.intersect1d(separate_poles(modal.modes)[0], first + np.flatnonzero(above))
            return cls(test, omega[separate], ratios[separate])
        more = asked or np.any(above) or _grows_as_static(geometry, omega, ratios)
        return cls.above(test, omega[first:], ratios[first:]) if more else none

    @classmethod
    def above(cls, test: Measurement, omega: Array, ratios: Array) -> ResidualTerms:
        """At those of the poles of a test that are not far above its lines, else at one near them; and at one above.

        The last two are chosen: what a mode anywhere above adds in the lines is nearly a sum of what these add.
        """
        last, (far, damping) = 2 * np.pi * test.freq[-1], STATIC_POLE
        near = (omega > last) & (omega < np.sqrt(far) * last)  # what is farther the chosen one stands for
        if not np.any(near):
            omega, ratios, near = np.array([ABOVE * last]), np.array([damping]), np.array([True])
        return cls(test, np.append(omega[near], far * last), np.append(ratios[near], damping))

    def of(self, test: Measurement, shift: float = 0.0) -> ResidualTerms:
        """The same of another test, or at other complex frequencies."""
        return self if test is self.test and shift == self.shift else replace(self, test=test, shift=shift)

    @cached_property
    def functions(self) -> ComplexArray:
        """``g_p u_j`` of all poles and base directions, (p d, runs, n_freq)."""
        g, u = gains(self.test.freq, self.omega, self.ratios, self.shift), self.test.base
        return np.einsum("pf,rdf->pdrf", g, u).reshape(-1, len(u), g.shape[1])

    @property
    def by_channel(self) -> bool:
        """True where each channel has residues of its own, if any, and weighs its lines as others of its record do."""
        alike = all(len(products(std, record.shape)) == 1 for record, std in records_of(self.test))
        return self.omega.size == 0 or (alike and (self.test.force is None or self.test.n_base == 1))

    @cached_property
    def _columns(self) -> list[list[Array]]:
        """Columns of each record, real parts above imaginary ones: of accelerations by channel."""
        functions = self.functions.reshape(len(self.functions), -1)
        n, d = self.test.n_sensors, self.test.n_base
        weights = [weight / scale for weight, scale in weights_of_test(self.test, weighted=True)]
        found = [[_as_rows(functions[:, None] * weights[0][i]) for i in range(n)]]
        if self.test.force is not None:
            parts = functions.reshape(-1, d, functions.shape[1])
            pairs = np.transpose(np.tril_indices(d))
            symmetric = np.zeros((len(parts), len(pairs), d, functions.shape[1]), dtype=complex)
            for k, (i, j) in enumerate(pairs):
                symmetric[:, k, i], symmetric[:, k, j] = parts[:, j], parts[:, i]
            found.append([_as_rows(symmetric.reshape(-1, d, functions.shape[1]) * weights[1])])
        return found

    @cached_property
    def _bases(self) -> list[scipy.sparse.csc_array]:
        """Orthonormal columns that span those of each record, rows as those of `response.residual`."""
        bases = []
        for groups in self._columns:
            channels = len(groups)
            parts = [_range_of(group) for group in groups]
            rows = [np.arange(len(part)) * channels + i for i, part in enumerate(parts)]
            across = np.cumsum([0, *(part.shape[1] for part in parts)])
            places = [
                np.broadcast_arrays(row[:, None], np.arange(first, first + part.shape[1]))
                for row, part, first in zip(rows, parts, across[:-1], strict=True)
            ]
            at = tuple(np.concatenate([place[k].ravel() for place in places]) for k in (0, 1))
            values = np.concatenate([part.ravel() for part in parts])
            bases.append(scipy.sparse.csc_array((values, at), (sum(map(len, parts)), across[-1])))
        return bases

    @property
    def size(self) -> int:
        """Number of numbers that are fitted."""
        return sum(int(basis.shape[1]) for basis in self._bases) if self.omega.size else 0

    def without(self, number: int, misfit: ComplexArray) -> ComplexArray:
        """Weighted misfits of a record, 0 of accelerations, 1 of the force, less what the best residues explain.

        Misfits and answer are (channels, runs * n_freq, k), each of the k by itself.
        """
        if not self.omega.size:
            return misfit
        basis, (channels, lines, count) = self._bases[number], misfit.shape
        rows = np.moveaxis(misfit, 0, 1).reshape(-1, count)
        rows = np.concatenate([rows.real, rows.imag])
        real, imag = np.split(rows - basis @ (basis.T @ rows), 2)
        return np.moveaxis((real + 1j * imag).reshape(lines, channels, count), 1, 0)

    def without_in(self, rows: ca.MX) -> ca.MX:
        """The same of the rows of `response.residual`, as an expression."""
        if not self.omega.size:
            return rows
        basis = ca.DM(scipy.sparse.block_diag(self._bases, format="csc"))
        return rows - basis @ (basis.T @ rows)

    def fitted(self, structure: Structure) -> ResidualModes:
        """The residues that explain best what a structure without residual modes leaves, as residual modes.

        As many at each pole as base directions. D_p is positive semidefinite; without a force they carry no mass.
        """
        test, d = self.test, self.test.n_base
        if not self.omega.size:
            return ResidualModes.none(test.n_sensors, d)
        both = zip(misfits(test, structure), weights_of_test(test, weighted=True), strict=True)
        left = [weight / scale * columns(one) for (one, _), (weight, scale) in both]
        of_channel = zip(self._columns[0], left[0], strict=True)
        residues = np.array([_solved(group, _as_rows(row[None, None])[:, 0]) for group, row in of_channel])
        shapes = residues.reshape(len(residues), -1, d)  # (n_sensors, p, d)
        totals = np.diag(structure.rigid_body_mass)
        roots = np.tile(np.eye(d), (self.omega.size, 1, 1))
        if test.force is not None:
            found = self._masses(_as_rows(left[1][None])[:, 0], np.sqrt(totals))
            roots = np.linalg.cholesky(found + _LEAST * np.diag(totals)).swapaxes(1, 2)  # D = Gamma' Gamma
        modes = ResidualModes(  # as many at each pole as base directions
            np.repeat(self.omega, d) / (2 * np.pi), np.repeat(self.ratios, d),
            np.einsum("npd,pdk->npk", shapes, np.linalg.inv(roots)).reshape(len(shapes), -1), roots.reshape(-1, d),
            self.omega.size * d,
        )  # fmt: skip
        return modes if test.force is not None else modes.without_mass(totals)

    def _masses(self, left: Array, unit: Array, rounds: int = 100) -> Array:
        """D_p, (p, d, d), positive semidefinite, that explain best what is left of the force, in rows; `unit` (d,).

        Sums of ``v v'`` by non-negative least squares, with further v where the slope by D is most negative, until chi²
        could hardly fall (M. Jaggi, Proc. 30th Int. Conf. Machine Learning (2013) 427-435).
        """
        rows, columns = np.tril_indices(self.test.n_base)
        Q, R = np.linalg.qr(self._columns[1][0])
        R, wanted = R * np.tile(unit[rows] * unit[columns], self.omega.size), Q.T @ left
        free = self._symmetric(_solved(R, wanted))
        directions = np.linalg.eigh(free)[1].swapaxes(1, 2)  # (p, k, d)
        for _ in range(rounds):
            atoms = directions[..., rows] * directions[..., columns]
            design = np.einsum("epq,pkq->epk", R.reshape(len(R), *free.shape[:1], -1), atoms)
            share = scipy.optimize.nnls(design.reshape(len(R), -1), wanted)[0].reshape(atoms.shape[:2])
            entries = np.einsum("pk,pkq->pq", share, atoms).ravel()
            miss = R @ entries - wanted
            slope = self._symmetric((R.T @ miss) * np.tile(np.where(rows == columns, 1.0, 0.5), self.omega.size))
            lowest, vectors = np.linalg.eigh(slope)
            gain = -np.sum(np.minimum(lowest[:, 0], 0.0) * np.einsum("pii->p", np.abs(free)))
            if gain <= NEGLIGIBLE * (left @ left):
                break
            directions = np.concatenate([directions, vectors[:, None, :, 0]], axis=1)
        return self._symmetric(entries) * np.outer(unit, unit)

    def _symmetric(self, entries: Array) -> Array:
        """Matrices (p, d, d) of their free entries, (p pairs,)."""
        rows, columns = np.tril_indices(self.test.n_base)
        D = np.zeros((self.omega.size, self.test.n_base, self.test.n_base))
        D[:, rows, columns] = D[:, columns, rows] = entries.reshape(self.omega.size, -1)
        return D


_LEAST = 1e-6  # of the rigid-body mass, that residual modes have in each direction at least


def _grows_as_static(geometry: Geometry, omega: Array, ratios: Array) -> bool:
    """True where as many modes as a model has leave of the lines of a test what modes above add far below them."""
    test = geometry.test
    inside = (omega >= 2 * np.pi * test.freq[0]) & (omega <= 2 * np.pi * test.freq[-1])
    if geometry.modal.by_modes or not np.any(inside) or geometry.natural_frequencies.size < geometry.n:
        return False
    return misses_static(test, Records(test), omega, ratios)


def _as_rows(parts: ComplexArray) -> Array:
    """Columns (rows, k) of records (k, channels, lines): all channels of a line together, real above imaginary."""
    flat = parts.swapaxes(1, 2).reshape(len(parts), -1).T
    return np.concatenate([flat.real, flat.imag])


def _range_of(group: Array) -> Array:
    """Orthonormal columns that span those of a group."""
    U, s, _ = np.linalg.svd(unit_columns(group)[0], full_matrices=False)
    return U[:, s > round_off(s.size) * s[0]]


def _solved(group: Array, left: Array) -> Array:
    """Coefficients of the columns of a group, by least squares; the shortest where they depend on each other."""
    scaled, size = unit_columns(group)
    return np.asarray(np.linalg.lstsq(scaled, left, rcond=round_off(size.size))[0]) / size
