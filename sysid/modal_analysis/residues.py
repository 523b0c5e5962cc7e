"""Residues of given poles: weighted linear least squares of the relative accelerations, or of the base force."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.measurement.measurement import Measurement
from sysid.measurement.whole import factors_of_runs
from sysid.modal_analysis.pole_functions import Basis, Beside, OfRun, PoleFunctions, orthonormal, unit_columns
from sysid.modal_analysis.response import columns, gains, gains_and_slopes, gains_with_velocity, stacked
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import CANDIDATES, NEGLIGIBLE, ROUND_OFF, beyond_chance

_LAGS = range(4)  # distances of lines that may share their noise; none: their power


@dataclass(frozen=True, eq=False)
class ResidueFit:
    """Records fitted on given poles.

    Attributes
    ----------
    basis : Basis
        Orthonormal basis of the functions of the poles.
    residues : (m, inputs, channels)
    spread : (m, inputs, columns)
        Residues that one unit of each column of the basis makes: scatter of the residues is ``spread @ spread'``.
    data : (rows, channels)
        The records.
    answered : (columns, channels)
        Products of the basis with the data.
    size : float
        Sum of squares of the records.
    """

    basis: Basis
    residues: Array
    spread: Array
    data: Array
    answered: Array
    size: float

    @cached_property
    def left(self) -> Array:
        """Records less the contributions of the poles, (rows, channels)."""
        return self.data - self.basis.times(self.answered)

    @cached_property
    def whitened(self) -> Array:
        """Residues in units of what white noise of unit variance would scatter them by, (m, inputs, channels).

        The sum of squares of pole k is what the squared error would rise by without it.
        """
        factor = np.linalg.cholesky(np.einsum("kir,kjr->kij", self.spread, self.spread))
        return np.linalg.solve(factor, self.residues)

    @cached_property
    def squared_error(self) -> float:
        """Sum of squares of what is left."""
        return self._difference if self._is_large else float(np.vdot(self.left, self.left))

    @property
    def Q(self) -> Array:  # noqa: N802
        """Orthonormal basis (rows, columns) of a test whose runs share all functions."""
        assert not self.basis.by_run
        return self.basis.shared

    def beside(self, functions: PoleFunctions) -> tuple[Beside, Array]:
        """What the fit leaves of other functions, and their products with what is left of the data, (columns, c)."""
        beside = self.basis.beside(functions)
        of_shared = beside.shared.T @ (self.data if self._is_large else self.left)
        return beside, beside.products(of_shared, self.left) if beside.by_run else of_shared

    @cached_property
    def _difference(self) -> float:
        return self.size - float(np.vdot(self.answered, self.answered))

    @property
    def _is_large(self) -> bool:
        """True where round-off in differences of squares does not matter to what is left, which need not be formed."""
        return self._difference > NEGLIGIBLE * self.size

    @property
    def gain(self) -> Array:
        """Rise of the squared error without each pole, (m,)."""
        return np.sum(self.whitened**2, axis=(1, 2))

    def rise_with_one_less(self, poles: NDArray[np.intp]) -> float:
        """Least rise of the squared error with one pole less for these, all others unchanged.

        A pole has one function of frequency for each input, whatever its frequency.
        """
        spread = self.spread[poles].reshape(-1, self.spread.shape[-1])
        beta = self.residues[poles].reshape(len(spread), -1)
        _, triangle = np.linalg.qr(spread.T)
        both = np.linalg.solve(triangle.T, beta)
        kept = len(both) - self.residues.shape[1]
        return float(np.sum(np.linalg.svd(both, compute_uv=False)[kept:] ** 2))

    def ranks(self, noise: float, n_sensors: int, n_base: int) -> NDArray[np.intp]:
        """Number of modes at each pole, (m,): singular values of its residue that stand out of noise of this variance.

        At least one, and no more than sensors or base directions.
        """
        s = np.linalg.svd(self.whitened.reshape(len(self.whitened), -1, n_sensors), compute_uv=False)
        # Unknowns of a further mode, at most.
        needed = np.count_nonzero(s**2 > noise * beyond_chance(n_sensors + n_base, CANDIDATES), axis=1)
        return np.clip(needed, 1, min(n_sensors, n_base))


class Records:
    """Weighted relative accelerations of a test, or its base force; real parts above imaginary ones.

    Each record is ``sum over inputs of residue · gain · base``. Where each run moves the base in
    one direction of its own with unit acceleration, all runs have the same basis, and every pair of sensor and
    direction is one channel of a test with a single input.
    """

    def __init__(self, test: Measurement, *, force: bool = False) -> None:
        self.freq = test.freq
        self.lines = 2 * np.pi * test.freq[test.freq > 0]  # rad/s, above zero
        record, std = (test.force, test.force_std) if force else (test.relative, test.response_std)
        assert record is not None
        self.n_sensors, self.n_base = record.shape[1], test.inputs.shape[1]
        self.unit = test.whole is None and test.has_unit_runs
        # Runs that share functions of frequency weigh channels alike.
        channel, line = factors_of_runs(std, record.shape, together=not self.unit)
        relative = record * channel[..., None]
        if self.unit:
            size = np.exp(np.log(line).mean(axis=1, keepdims=True))  # of each run
            shared = np.exp(np.log(line / size).mean(axis=0))
            self.driven = 1
            blocks = [(shared[None].astype(complex), (relative * size[:, None] * shared).reshape(-1, test.freq.size))]
            self.channel = (size * channel).ravel()
        else:
            self.moving, self.driven = independent_inputs(test)
            base = np.einsum("di,rdf->rif", self.moving, test.inputs * line[:, None])
            blocks = list(zip(base, relative * line[:, None], strict=True))
            self.channel = channel[0]
        self.blocks = blocks
        # Whole records of other lengths have zeros at the lines of one another, which tell nothing.
        used = [np.any(inputs != 0, axis=0) | np.any(records != 0, axis=0) for inputs, records in blocks]
        self.run, self.line = np.nonzero(used)
        self.base = np.concatenate([inputs[:, lines] for (inputs, _), lines in zip(blocks, used, strict=True)], axis=1)
        blocks_of_data = [records[:, lines] for (_, records), lines in zip(blocks, used, strict=True)]
        self.data = stacked(np.concatenate(blocks_of_data, axis=1))
        self.size = float(np.sum(self.data**2))

    def basis(self, gains: ComplexArray, inputs: int | None = None) -> Array:
        """Columns of gains (k, n_freq) times the first so many inputs, all by default, (rows, k * inputs)."""
        block = gains[:, None, self.line] * self.base[None, :inputs]
        return stacked(block.reshape(-1, self.line.size))

    @cached_property
    def singular(self) -> tuple[Array, Array]:
        """Singular values (k,) of all records as a matrix of rows by channels, and its right vectors (k, channels)."""
        return _singular(self.data)

    def principal(self, count: int) -> list[tuple[ComplexArray, ComplexArray, ComplexArray]]:
        """Base (inputs, n_freq), motion at the ends, and so many principal channels (c, n_freq) of each block."""
        out = []
        for inputs, channels in self.blocks:
            base, ends = inputs[: self.driven], inputs[self.driven :]
            moving = independent(base[None]).T @ base  # a run moves the base in fewer directions than all together
            sizes, right = self.singular if len(self.blocks) == 1 else _singular(stacked(channels))
            keep = np.flatnonzero(sizes > 1e-14 * sizes[0])[:count]
            out.append((moving, ends[np.any(ends, axis=1)], right[keep] @ channels))
        return out

    def functions(self, omega: Array, ratios: Array, *, velocity: bool = False) -> PoleFunctions:
        """Columns of ``g`` for each input; with `velocity` those of ``i w / w_k g`` too, as further inputs."""
        every = gains_with_velocity(self.freq, omega, ratios) if velocity else [gains(self.freq, omega, ratios)]
        return self.of_poles(list(every))

    def of_poles(self, functions: list[ComplexArray]) -> PoleFunctions:
        """Columns of functions of poles, (m, n_freq) each, the first for all inputs and a further one for the base's.

        Velocities of the motion at the ends are combinations of what is there already.
        """
        rows, m = len(self.data), len(functions[0])
        shared = [self.basis(functions[0], self._shared), *(self.basis(f, self.driven) for f in functions[1:])]
        count, r = len(self.base), self.driven
        inputs = np.concatenate([np.arange(self._shared), count + np.arange(r * (len(functions) - 1))])
        by_run = []
        for both, at in self._ends:
            lines = both[: both.size // 2]
            columns = functions[0][:, None, self.line[lines]] * self.base[np.ix_(at, lines)]
            by_run.append(OfRun(both, at, stacked(columns.reshape(-1, lines.size))))
        return PoleFunctions(
            np.concatenate([part.reshape(rows, m, -1) for part in shared], axis=2).reshape(rows, -1), inputs, by_run
        )

    def pole_slopes(self, omega: Array, ratios: Array, *, velocity: bool) -> PoleFunctions:
        """Derivatives of the columns of `functions` by log w_k, then by log zeta_k, as those of 2m poles."""
        g, by_pole = gains_and_slopes(self.freq, omega, ratios)
        turned = 2j * np.pi * self.freq / np.tile(omega, 2)[:, None] * (by_pole - np.concatenate([g, np.zeros_like(g)]))
        return self.of_poles([by_pole, turned][: 1 + velocity])

    @property
    def _shared(self) -> int:
        """Inputs that are not of one run among several."""
        return self.driven if len(self.blocks) > 1 else len(self.base)

    @cached_property
    def _ends(self) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
        """Rows of each run in motion at its ends, and the inputs that this motion makes."""
        of_ends, found = self.base[self._shared :] != 0, []
        for run, rows in enumerate(self.rows_of_runs):
            at = self._shared + np.flatnonzero(np.any(of_ends[:, self.run == run], axis=1))
            if at.size:
                found.append((rows, at))
        return found

    def fit(self, omega: Array, ratios: Array, *, velocity: bool = False) -> ResidueFit:
        """Best real residues of `functions`."""
        return _least_squares(self.functions(omega, ratios, velocity=velocity), self.data, self.size)

    def leverage(self, omega: Array, ratios: Array) -> Array:
        """Share of each line's own part in what poles and free residues of both kinds make of it, (n_freq,)."""
        Q = np.linalg.qr(unit_columns(self.functions(omega, ratios, velocity=True).dense())[0])[0]
        return self.largest(np.sum(Q**2, axis=1).reshape(2, -1).mean(axis=0))

    def largest(self, values: Array) -> Array:
        """The largest of values of the lines of all runs, (lines,), at each frequency, (n_freq,)."""
        found = np.zeros(self.freq.size, values.dtype)
        np.maximum.at(found, self.line, values)
        return found

    def noise(self, left: Array, unknowns: int, *, least: float = ROUND_OFF) -> float:
        """Variance of a real number of the records about a fit of so many unknowns, as it affects smooth functions."""
        products, chance = _autocorrelation(self.in_runs(left))
        factor = _correlation_factor(products, chance, left.shape[1], self.lengths, unknowns)
        return self.variance(factor * float(np.sum(left**2)), unknowns, least=least)

    def variance(self, squared_error: float, unknowns: int, *, least: float = ROUND_OFF) -> float:
        """Share of one real number of the records in a squared error that a fit of so many unknowns leaves."""
        freedom = max(self.data.size - unknowns, 1)
        return max(squared_error / freedom, least**2 * self.size / self.data.size)

    @property
    def lengths(self) -> NDArray[np.intp]:
        """Number of lines of each run."""
        return np.bincount(self.run, minlength=len(self.blocks))

    @property
    def rows_of_runs(self) -> list[NDArray[np.intp]]:
        """Rows of each run: real parts of its lines, then imaginary ones."""
        lines = np.split(np.arange(self.line.size), np.cumsum(self.lengths)[:-1])
        return [np.concatenate([one, one + self.line.size]) for one in lines]

    def in_runs(self, rows: Array) -> ComplexArray:
        """Rows of the records, real parts above imaginary ones, as complex lines (runs, lines, columns).

        Each run's own lines one after the other, and zeros behind those of shorter ones.
        """
        real, imaginary = rows.reshape(2, -1, rows.shape[1])
        return by_run(real + 1j * imaginary, self.run, self.lengths)

    def by_sensor(self, residues: Array) -> Array:
        """Residues (m, inputs, channels) of `fit` in the test's own units, (m, n_sensors, d).

        Directions in which the base does not move have none.
        """
        if self.unit:
            plain = (residues / self.channel).reshape(len(residues), self.n_base, self.n_sensors)
            return plain.transpose(0, 2, 1)
        return np.einsum("mic,di->mcd", residues / self.channel, self.moving)


class SubsetFits:
    """Fits of the records on subsets of given poles, all from one QR factorisation of the functions of these poles.

    With ``X = Q R`` for all poles, a subset's fit of the records is that of ``Q' data`` on columns of R: its rows are
    as many as columns of X, not as lines. What Q leaves is the same for all subsets.

    Parameters
    ----------
    records : Records
    omega, ratios : (m,)
        All poles.
    velocity : bool
        As in `Records.functions`.

    Attributes
    ----------
    size : int
        Number of all poles.
    per_pole : int
        Real parameters that come with a pole: residues, frequency and damping ratio.
    """

    def __init__(self, records: Records, omega: Array, ratios: Array, *, velocity: bool = False) -> None:
        functions = records.functions(omega, ratios, velocity=velocity)
        basis, R, _ = orthonormal(functions)
        self.records, self.size = records, omega.size
        self.per_pole = functions.per_pole * records.data.shape[1] + 2
        by_pole = functions.in_order([R.T]).T  # no gain depends on the scale of columns
        self._columns = by_pole.reshape(len(R), omega.size, -1)
        self._answered = basis.answers(records.data)
        left = records.data - basis.times(self._answered)
        self._size = float(np.vdot(self._answered, self._answered))
        self._outside = float(np.sum(left**2))
        # Products of errors `left + Q z` with their neighbours in each run: constant, linear, quadratic in z; by lag.
        self._constant, self._chance = _autocorrelation(records.in_runs(left))  # chance as in the fit on all poles
        self._runs = [_of_errors(*basis.of_run(rows), left[rows]) for rows in records.rows_of_runs]

    def worth(self, kept: NDArray[np.intp]) -> tuple[Array, float]:
        """Rise of the squared error of the poles `kept` without each, over the noise, (len(kept),).

        Returns
        -------
        worth : (len(kept),)
            In units of the variance of the noise about the fit on these poles.
        squared_error : float
            Of this fit.
        """
        X = self._columns[:, kept].reshape(len(self._columns), -1)
        fit = _least_squares(PoleFunctions(X, np.arange(X.shape[1] // kept.size)), self._answered, self._size)
        z = fit.left
        squares = z @ z.T
        squared_error = self._outside + float(np.trace(squares))
        each = [
            np.einsum("lkc,kc->l", linear, z[at]) + np.einsum("lij,ij->l", quadratic, squares[np.ix_(at, at)])
            for at, linear, quadratic in self._runs
        ]
        products = self._constant + np.array(each).T
        unknowns, records = kept.size * self.per_pole, self.records
        factor = _correlation_factor(products, self._chance, records.data.shape[1], records.lengths, unknowns)
        return fit.gain / records.variance(factor * squared_error, unknowns), squared_error


def _of_errors(Q: Array, at: NDArray[np.intp], left: Array) -> tuple[NDArray[np.intp], ComplexArray, ComplexArray]:
    """Numbers `at` of columns Q of one run, and sums of products of errors ``left + Q z`` with their neighbours.

    Those linear in z, (lags, columns, channels), and quadratic ones, (lags, columns, columns).
    """
    basis, ours = ((rows[: len(rows) // 2] + 1j * rows[len(rows) // 2 :]) for rows in (Q, left))
    linear = [_products(basis, ours, lag) + _products(ours, basis, lag).T for lag in _LAGS]
    return at, np.stack(linear), np.stack([_products(basis, basis, lag) for lag in _LAGS])


def _autocorrelation(error: ComplexArray) -> tuple[ComplexArray, Array]:
    """Sums of products of errors (runs, n_freq, channels) with their neighbours, (lags, runs), and chance in them.

    Products at two lines are independent where the noise is white, whatever channels share and however lines differ:
    the variance of their sum, relative to the squared power of the run, is that of their squares.
    """
    before = [error[:, : max(error.shape[1] - lag, 0)].conj() for lag in _LAGS]
    each = [np.einsum("rfc,rfc->rf", error[:, lag:], early) for lag, early in zip(_LAGS, before, strict=True)]
    sums = np.stack([one.sum(axis=1) for one in each])
    squares = np.stack([np.sum(np.abs(one) ** 2, axis=1) for one in each])
    power = sums[0].real ** 2
    return sums, squares / np.where(power > 0, power, 1.0)


def _products(first: ComplexArray, second: ComplexArray, lag: int) -> ComplexArray:
    """Sums over the lines of one run of products with those that stand `lag` lines before, (of first, of second)."""
    return first[lag:].T @ second[: max(len(second) - lag, 0)].conj()


def _least_squares(functions: PoleFunctions, data: Array, size: float) -> ResidueFit:
    """Fit of data (rows, channels), whose sum of squares is `size`, on functions of poles."""
    basis, R, size_of_column = orthonormal(functions)
    y = basis.answers(data)
    inverse = scipy.linalg.solve_triangular(R, np.eye(R.shape[0]), check_finite=False)
    inverse /= size_of_column[:, None]
    inverse = functions.in_order([inverse])
    inputs = functions.per_pole
    beta = (inverse @ y).reshape(-1, inputs, data.shape[1])
    return ResidueFit(basis, beta, inverse.reshape(len(beta), inputs, -1), data, y, size)


def line_correlation(error: ComplexArray, unknowns: int = 0) -> float:
    """Factor by which errors weigh more on smooth functions of frequency as neighbouring lines share them.

    One for white noise. Windows of averaged spectra smear each error over some lines: of H1 with Hann's it is 1.9.
    Products of neighbours have the phase ``exp(2 pi i f tau)`` of a lag f, tau the time at which the error sits in its
    run; sums over the lines of a run, which share it, count by their modulus.

    Parameters
    ----------
    error : (channels, runs, n_freq) complex
        Lines at which a run has nothing but zeros are none of its own.
    unknowns : int
        Real numbers of the fit that leaves it.
    """
    run, line = np.nonzero(np.any(error != 0, axis=0))
    lengths = np.bincount(run, minlength=error.shape[1])
    products, chance = _autocorrelation(by_run(error[:, run, line].T, run, lengths))
    return _correlation_factor(products, chance, error.shape[0], lengths, unknowns)


def by_run(lines: ComplexArray, run: NDArray[np.intp], lengths: NDArray[np.intp]) -> ComplexArray:
    """Lines of all runs (lines, columns), each of a `run`, as (runs, lines, columns) with zeros behind short ones."""
    found = np.zeros((lengths.size, lengths.max(initial=0), lines.shape[1]), complex)
    found[run, np.arange(run.size) - (np.cumsum(lengths) - lengths)[run]] = lines
    return found


def _correlation_factor(
    products: ComplexArray, variance: Array, channels: int, lines: NDArray[np.intp], unknowns: int
) -> float:
    """One, and twice the correlation of errors at each lag up to the first that may be chance.

    `products` are sums over channels and lines, (lags, runs), and `variance` that of white noise in them over the
    squared power of the run: squared moduli over it are exponential; they are taken off. A fit of white noise leaves
    errors ``I - H``, whose sums are at most those of ``trace(H)``, half the unknowns, over all complex numbers.
    """
    power = products[0].real
    moved = power > 0
    if lines.max(initial=0) <= 2 * len(_LAGS) - 2 or not np.any(moved):
        return 1.0
    share = unknowns / max(2 * channels * lines[moved].sum() - unknowns, 1)
    fits = 100  # of one search, each with its own errors
    chance = beyond_chance(2 * moved.sum(), fits * (len(_LAGS) - 1)) / 2
    factor = 1.0
    for sums, level in zip(np.abs(products[1:, moved]) / power[moved], variance[1:, moved], strict=True):
        beyond = np.maximum(sums - share, 0) ** 2
        if np.sum(np.divide(beyond, level, out=np.zeros_like(level), where=level > 0)) <= chance:
            break
        factor += 2 * float(np.sqrt(np.maximum(sums**2 - level, 0)) @ power[moved] / np.sum(power))
    return factor


def independent(base: ComplexArray) -> Array:
    """Combinations D (d, r) of base records (runs, d, n_freq) that are independent inputs ``D' u_0``.

    Each direction counts in units of its own size. Responses to r < d inputs are taken to be due to the directions
    that move: residues R by base direction follow as ``R D'``.
    """
    flat, size = unit_columns(stacked(columns(base)))
    left, s, _ = np.linalg.svd(flat.T, full_matrices=False)
    return left[:, s > ROUND_OFF * s[0]] / size[:, None]


def independent_inputs(test: Measurement) -> tuple[Array, int]:
    """Combinations D (inputs, r) of a test's inputs, and how many of them are of the base; the others stand alone."""
    base, d = independent(test.base), test.n_base
    ends = np.linalg.norm(test.inputs[:, d:], axis=(0, 2))
    both = np.zeros((d + ends.size, base.shape[1] + ends.size))
    both[:d, : base.shape[1]] = base
    both[d:, base.shape[1] :] = np.diag(1 / ends)
    return both, base.shape[1]


def _singular(matrix: Array) -> tuple[Array, Array]:
    """Singular values and right singular vectors, as rows; the left ones, which are long, are not formed."""
    small = np.linalg.qr(matrix, mode="r") if matrix.shape[0] > matrix.shape[1] else matrix
    return np.linalg.svd(small, full_matrices=False)[1:]


def linear_residues(test: Measurement, omega: Array, ratios: Array) -> tuple[Array, float]:
    """Residues of given poles by linear least squares, whatever their rank.

    Parameters
    ----------
    test : Measurement
    omega, ratios : (m,)
        Circular frequencies, rad/s, and damping ratios; no two modes with one pole.

    Returns
    -------
    residues : (m, n_sensors, d)
    residual : float
        Relative residual that they leave: no modal model with these poles has a smaller one.
    """
    records = Records(test)
    fit = records.fit(omega, ratios)
    return records.by_sensor(fit.residues), float(np.sqrt(fit.squared_error / records.size))


def force_residual_left(test: Measurement, omega: Array, ratios: Array, *, velocity: bool = False) -> float:
    """Relative residual of the base force with its own residues and rigid-body mass free at given poles."""
    return force_residues(test, omega, ratios, velocity=velocity)[1]


def force_residues(test: Measurement, omega: Array, ratios: Array, *, velocity: bool) -> tuple[Array, float]:
    """Free residues of the base force, and the relative residual that they leave.

    Returns
    -------
    residues : (1 + 2m, d, d)
        Of the base itself, of ``g_k`` and of ``s / w_k g_k`` (zero without `velocity`).
    residual : float
    """
    records = Records(test, force=True)
    g = gains_with_velocity(test.freq, omega, ratios)[: 1 + velocity].reshape(-1, test.freq.size)
    basis, size = unit_columns(records.basis(np.concatenate([np.ones((1, test.freq.size)), g])))
    Q, R = np.linalg.qr(basis)
    answered = Q.T @ records.data
    beta = np.linalg.lstsq(R, answered, rcond=np.finfo(float).eps * len(basis))[0] / size[:, None]
    known = records.by_sensor(beta.reshape(1 + len(g), -1, beta.shape[1]))
    residues = np.zeros((1 + 2 * omega.size, *known.shape[1:]))
    residues[: len(known)] = known
    return residues, float(np.linalg.norm(records.data - Q @ answered) / np.sqrt(records.size))
