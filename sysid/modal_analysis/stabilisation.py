"""Independent check of the modes: stabilisation diagram (pLSCF) and complex mode indicator function, as numbers.

The polyreference least-squares complex frequency-domain method fits a right matrix fraction ``B(z) A(z)^-1`` with
real coefficients, d x d in the denominator, to the FRFs of relative acceleration, for a rising order. Poles of the
structure recur at every order, poles that fit noise do not. The method has nothing in common with vector fitting.

The field takes ``z = exp(i w dt)``. Any analytic map of frequency takes poles to poles, and the one used here
maps log w onto the circle instead: modes of one damping ratio are then equally far inside it wherever they lie, and the
lowest modes of a wide band are not crowded together next to z = 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.pole_functions import unit_columns
from sysid.modal_analysis.response import gains, stacked
from sysid.modal_analysis.vector_fitting import BESIDE
from sysid.structure.structure import Array, ComplexArray

LEVELS = ("new", "frequency", "frequency, damping", "frequency, damping, shape")  # what is stable
_SAME_FREQUENCY, _SAME_RATIO, _SAME_SHAPE = 0.01, 0.05, 0.98
_DAMPED = 0.2  # a pole with more damping than this is not shown
_GAP = 0.1  # of the half circle, free at either end: a polynomial fits a smooth function badly up to where it wraps
_WIDER = 5  # powers by which numerators reach beyond the denominator at either end: all that modes outside the band add
_SPANNED = 1e-4  # least singular value of the base's motion against its largest: less makes no FRF


@dataclass(frozen=True, eq=False)
class Stabilisation:
    """Poles at every order, one entry a pole; the orders ascend, and the frequencies within each.

    Attributes
    ----------
    order : (p,) of int
        Modes that the fitted model has room for.
    frequency : (p,)
        Hz.
    ratio : (p,)
        Damping ratio, a fraction.
    stable : (p,) of int
        What some pole of the order before agrees in, as an index into `LEVELS`: 0 nothing, 1 the frequency within
        1 %, 2 also the damping ratio within 5 %, 3 also the mode shape (MAC above 0.98).
    """

    order: NDArray[np.integer[Any]]
    frequency: Array
    ratio: Array
    stable: NDArray[np.integer[Any]]


def stabilisation(test: Measurement, *, max_order: int | None = None) -> Stabilisation:
    """Poles of pLSCF models of rising order; unstable and strongly damped ones (above 20 %) are left out.

    Parameters
    ----------
    test : Measurement
        Its runs span the base directions at every line (see `relative_frf`).
    max_order : int, optional
        Modes of the largest model; by default ten more than twice the number of sensors, at most 40 more than the
        sensors and at most 100, less where the lines do not carry it.

    Raises
    ------
    InputError
        No FRF follows from the runs, or the lines are too few for `max_order`.

    References
    ----------
    P. Guillaume, P. Verboven, S. Vanlanduit, H. Van der Auweraer, B. Peeters, Proc. IMAC XXI (2003). B. Peeters,
    H. Van der Auweraer, P. Guillaume, J. Leuridan, Shock and Vibration 11 (2004) 395-409. B. Cauberghe, P. Guillaume,
    P. Verboven, S. Vanlanduit, E. Parloo, Mech. Syst. Signal Process. 19 (2005) 989-1014: why the lowest coefficient
    is the one to fix.

    Examples
    --------
    >>> import numpy as np
    >>> import sysid
    >>> from sysid.modal_analysis.stabilisation import stabilisation
    >>> stiffness = 3200.0 * np.array([[1, -1], [-1, 1]])
    >>> one = sysid.Structure(np.diag([2.0, 0.0]), stiffness, [0.01], n_base=1)  # 6.366 Hz
    >>> diagram = stabilisation(sysid.simulate(one, np.linspace(3, 12, 200)))
    >>> stable = diagram.stable == 3
    >>> print(f"{diagram.frequency[stable][-1]:.3f} Hz, {diagram.ratio[stable][-1]:.4f}")
    6.366 Hz, 0.0100
    """
    lines = test.freq > 0
    freq, H = test.freq[lines], relative_frf(test)[..., lines]
    d = test.n_base
    degrees = _degrees(H.shape, max_order)
    start, step = _GAP * np.pi, (1 - 2 * _GAP) * np.pi / np.log(freq[-1] / freq[0])
    system = _reduced_system(start + step * np.log(freq / freq[0]), H, int(degrees[-1]))
    rows: list[tuple[Array, Array, Array, Array]] = []
    before: tuple[Array, Array, Array] = np.zeros(0), np.zeros(0), np.zeros((test.n_sensors, 0))
    for degree in degrees:
        size = d * (degree + 1)
        z, participation = _poles(system[:size, :size], d)  # triangular: zeros below
        frequency = freq[0] * np.exp((np.angle(z) - start) / step)
        decay = -np.log(np.abs(z)) / step  # of log w_k, hence arcsin zeta_k
        inside = (frequency > (1 - BESIDE) * freq[0]) & (frequency < (1 + BESIDE) * freq[-1])
        kept = np.flatnonzero(inside & (decay > 0) & (decay < np.arcsin(_DAMPED)))
        kept = kept[np.argsort(frequency[kept])]
        frequency, ratio = frequency[kept], np.sin(decay[kept])
        found = frequency, ratio, _shapes(freq, H, frequency, ratio, participation[kept])
        rows.append((np.full(kept.size, degree * d // 2), frequency, ratio, _level(found, before)))
        before = found
    order, frequency, ratio, level = (np.concatenate(column) for column in zip(*rows, strict=True))
    return Stabilisation(order.astype(int), frequency, ratio, level.astype(int))


def cmif(test: Measurement) -> Array:
    """Complex mode indicator function: singular values of the FRFs of relative acceleration at each line.

    Every mode is a peak of the largest; where two peak at one line, two modes are there.

    Parameters
    ----------
    test : Measurement
        Its runs span the base directions at every line (see `relative_frf`).

    Returns
    -------
    ndarray, shape (k, n_freq)
        Descending, k the lesser of n_sensors and d. Per unit base acceleration, a rotation's being 1 rad/s².

    Raises
    ------
    InputError
        No FRF follows from the runs.

    References
    ----------
    C. Y. Shih, Y. G. Tsuei, R. J. Allemang, D. L. Brown, Mech. Syst. Signal Process. 2 (1988) 367-377.
    """
    return singular_values(relative_frf(test))


def singular_values(record: ComplexArray) -> Array:
    """Singular values at each line of a record (rows, columns, n_freq), descending, (k, n_freq)."""
    values: Array = np.linalg.svd(np.moveaxis(record, -1, 0), compute_uv=False)
    return values.T


def relative_frf(test: Measurement) -> ComplexArray:
    """Relative acceleration of the sensors per unit base acceleration, (n_sensors, d, n_freq).

    Raises
    ------
    InputError
        The runs do not move the base in all d directions at some line.
    """
    size = np.sqrt(np.mean(np.abs(test.base) ** 2, axis=(0, 2)))
    base = np.moveaxis(test.base, -1, 0) / np.where(size > 0, size, 1.0)
    spread = np.linalg.svd(base, compute_uv=False)
    spanned = test.n_runs >= test.n_base and bool(np.all(spread[:, -1] > _SPANNED * spread[:, 0]))
    if not spanned:
        runs = "the one run does" if test.n_runs == 1 else f"the {test.n_runs} runs do"
        raise InputError(
            f"{runs} not move the base in {test.n_base} independent directions at every line, so that no FRF follows: "
            "add runs in other directions"
        )
    answer = np.linalg.pinv(base) @ np.moveaxis(test.relative, -1, 0)
    return np.moveaxis(answer / size[:, None], 0, -1).swapaxes(0, 1)


def _degrees(shape: tuple[int, ...], max_order: int | None) -> NDArray[np.integer[Any]]:
    """Polynomial degrees to fit: a denominator d x d of degree p has d p poles, hence room for d p / 2 modes."""
    n, d, lines = shape
    carried = d * (max(lines - 1 - 2 * _WIDER, 0) * n // (n + d)) // 2  # two equations an unknown
    if max_order is not None and max_order > carried:
        raise InputError(f"max_order = {max_order}: {lines} lines of {n} sensors carry at most {carried} modes")
    top = min(2 * n + 10, n + 40, 100, carried) if max_order is None else max_order
    degrees = np.unique(2 * np.arange(2, top + 1) // d)
    degrees = degrees[degrees * d >= 4]
    # At most so many rows of the diagram, further from each other where there would be more: those of many sensors
    # take time.
    degrees = degrees[:: -max(1, -(-degrees.size // (40 if n < 20 else 20)))][::-1]
    if degrees.size == 0:
        raise InputError(
            f"no stabilisation diagram: {lines} lines of {n} sensors and order {top} give no model of two modes or more"
        )
    return degrees


def _reduced_system(theta: Array, H: ComplexArray, degree: int) -> Array:
    """Equations of the denominator's coefficients alone, (rows, d * (degree + 1)), triangular.

    ``system @ [A_0; A_1; ...]`` is the error of ``B - H A`` with the best numerators, all of the same width; the
    leading columns are those of the lower orders.
    """
    numerators = np.exp(1j * theta[:, None] * np.arange(-_WIDER, degree + 1 + _WIDER))
    # Real and imaginary parts, as unknowns are real. Q of all rows stays in reflections: the first entries of Q' y are
    # what the numerators explain of y, the others what they leave.
    (reflections, tau), _ = scipy.linalg.qr(stacked(numerators.T), mode="raw")
    powers = np.exp(1j * theta[:, None] * np.arange(degree + 1))
    rows = []
    for sensor in H:
        products = stacked((powers[:, :, None] * sensor.T[:, None, :]).reshape(theta.size, -1).T)
        turned = scipy.linalg.lapack.dormqr("L", "T", reflections, tau, products, 64 * products.shape[1])[0]
        rows.append(np.linalg.qr(turned[numerators.shape[1] :], mode="r"))
    return np.asarray(np.linalg.qr(np.vstack(rows), mode="r"))


def _poles(system: Array, d: int) -> tuple[ComplexArray, Array]:
    """Poles z (d * degree,) of the least-squares denominator, and their participations, one row a pole.

    Participations are turned to be as real as can be. With the lowest coefficient fixed to the identity, poles that
    fit noise come out unstable (|z| > 1) and can be recognised.
    """
    A = np.linalg.lstsq(system[:, d:], -system[:, :d], rcond=None)[0].reshape(-1, d, d)
    size = d * len(A)
    # The reversed polynomial y^p + A_1 y^(p-1) + ..., y = 1/z, transposed: its vectors are the rows u with u A(z) = 0.
    companion = np.eye(size, k=-d)
    companion[:d] = -np.hstack([coefficient.T for coefficient in A])
    y, vectors = np.linalg.eig(companion)
    z: ComplexArray = np.reciprocal(np.where(y == 0, np.finfo(float).tiny, y), dtype=complex)
    rows = vectors[:d].T
    turn = np.exp(-0.5j * np.angle(np.sum(rows**2, axis=1)))
    return z, (rows * turn[:, None]).real


def _shapes(freq: Array, H: ComplexArray, frequency: Array, ratio: Array, participation: Array) -> Array:
    """Mode shapes (n_sensors, m) of given poles and participations (m, d), to scale, by linear least squares; real.

    Modes on either side of the band count as their constant and their w² term.
    """
    m, (_, d, _) = frequency.size, H.shape
    g = gains(freq, 2 * np.pi * frequency, ratio)
    design = np.zeros((d, freq.size, m + 2 * d), complex)
    design[:, :, :m] = np.einsum("kd,kf->dfk", participation, g)
    for j in range(d):
        design[j, :, m + j] = 1.0
        design[j, :, m + d + j] = (freq / freq[-1]) ** 2
    basis, _ = unit_columns(stacked(design.reshape(d * freq.size, -1).T))
    rank = np.finfo(float).eps * len(basis)  # as NumPy's, by a pivoted QR, which takes a third of the time of an SVD
    answer: Array = scipy.linalg.lstsq(basis, stacked(H.reshape(len(H), -1)), rank, lapack_driver="gelsy")[0][:m]
    return answer.T


def _level(found: tuple[Array, Array, Array], before: tuple[Array, Array, Array]) -> Array:
    """Index into `LEVELS` of each pole (frequency, ratio, shape) against those of the order before."""
    (frequency, ratio, shapes), (old_frequency, old_ratio, old_shapes) = found, before
    same_frequency = np.abs(old_frequency / frequency[:, None] - 1) < _SAME_FREQUENCY
    same_ratio = same_frequency & (np.abs(old_ratio / ratio[:, None] - 1) < _SAME_RATIO)
    size = np.outer(np.linalg.norm(shapes, axis=0), np.linalg.norm(old_shapes, axis=0))
    same_shape = same_ratio & ((shapes.T @ old_shapes) ** 2 > _SAME_SHAPE * size**2)
    level: Array = np.sum([same.any(axis=1) for same in (same_frequency, same_ratio, same_shape)], axis=0, dtype=float)
    return level
