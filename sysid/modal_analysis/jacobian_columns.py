"""Columns of a Jacobian by the few spectra that they are made of, and their products over the lines."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sysid.modal_analysis.modal_model import NormalEquations
from sysid.modal_analysis.response import real_times
from sysid.structure.structure import Array, ComplexArray


class Layer(NamedTuple):
    """One entry of each of some columns of a Jacobian: ``values[:, channel] * spectra[spectrum]``, (k,) and (k, c)."""

    column: NDArray[np.intp]
    spectrum: NDArray[np.intp]
    values: Array


class Columns(NamedTuple):
    """Columns of a run's Jacobian by its spectra, each the sum of its entries in all layers.

    `unknowns` (k,) are those that show in this run. The first layer has an entry of each.
    """

    unknowns: NDArray[np.intp]
    layers: list[Layer]

    def seen(self, weights: ComplexArray, spectra: ComplexArray) -> ComplexArray:
        """Sums of all columns (k, L) over the channels, with weights (c, L)."""
        first, *others = self.layers
        out = real_times(first.values, weights)
        out *= spectra[first.spectrum]
        for column, spectrum, values in others:
            out[column] += real_times(values, weights) * spectra[spectrum]
        return out

    def products(self, sums: Sums, scale: Array) -> NormalEquations:
        """Products of the Jacobian from those of its spectra, for outputs of these inverse deviations, (c,)."""
        normal, gradient = -sums.hidden, np.zeros(self.unknowns.size)
        for column, spectrum, values in self.layers:
            gradient[column] += np.sum(values * sums.cross[spectrum], axis=1)
            if normal.size == 0:
                continue
            for other, beside, theirs in self.layers:
                normal[np.ix_(column, other)] += (scale**2 * values) @ theirs.T * sums.gram[np.ix_(spectrum, beside)]
        return NormalEquations(normal, gradient, sums.chi2)


class Sums(NamedTuple):
    """Products over some lines of a run, of which those of the Jacobian are made.

    Of its spectra (s, s), of these with errors by their covariance (s, c), of what the noise of the base hides of the
    columns (k, k), and ``e' S^-1 e``; the first and the third are empty where only a gradient is asked for.
    """

    gram: Array
    cross: Array
    hidden: Array
    chi2: float

    def plus(self, other: Sums) -> Sums:
        """Those of the lines of both."""
        return Sums(
            self.gram + other.gram, self.cross + other.cross, self.hidden + other.hidden, self.chi2 + other.chi2
        )  # fmt: skip


class Summed(Columns):
    """Columns that are summed channel by channel: what comes of their sums are products of the Jacobian already."""

    def products(self, sums: Sums, scale: Array) -> NormalEquations:
        """See `Columns`."""
        return NormalEquations(sums.gram, sums.cross, sums.chi2)


class Moves(NamedTuple):
    """Columns (k,) that all channels feel: their unknowns, the modes that are loaded, and the loads (k, L)."""

    unknowns: NDArray[np.intp]
    modes: NDArray[np.intp]
    loads: ComplexArray
