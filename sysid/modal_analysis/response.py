"""The frequency-domain residual as CasADi expressions, bilinear in mode shapes and participations."""

from __future__ import annotations

import casadi as ca
import numpy as np

from sysid.measurement.measurement import Measurement
from sysid.measurement.whole import factors_of_runs, separable
from sysid.structure.structure import Array, ComplexArray, Structure

ABOVE = 1.3  # times the last line: a pole there fits what w² leaves of modes beyond, near the last line


def columns(record: ComplexArray) -> ComplexArray:
    """All runs side by side: (runs, channels, n_freq) → (channels, runs * n_freq)."""
    return np.moveaxis(record, 0, 1).reshape(record.shape[1], -1)


def stacked(record: ComplexArray) -> Array:
    """Channels (c, rows) as columns, real parts above imaginary ones, (2 rows, c)."""
    return np.vstack([record.real.T, record.imag.T])


def parts_of(record: ComplexArray) -> tuple[ca.DM, ca.DM]:
    """Real and imaginary part; zeros are structural, so that real unit runs cost no imaginary arithmetic."""
    flat = columns(record)
    return ca.sparsify(ca.DM(flat.real)), ca.sparsify(ca.DM(flat.imag))


def modal_gains(omega: ca.MX, ratios: ca.MX, freq: Array, shift: float = 0.0) -> tuple[ca.MX, ca.MX]:
    """Real and imaginary part of ``g_k = w² / (w_k² - w² + 2 i zeta_k w_k w)``, (m, n_freq) each (eq. 14).

    With `shift`, 1/s, at ``s = shift + i w`` in the place of ``i w``.
    """
    w = ca.DM(2 * np.pi * freq).T
    squared = ca.repmat(w**2, omega.numel(), 1)
    detuning = omega**2 @ ca.DM.ones(1, freq.size) - squared
    loss = (2 * ratios * omega) @ w
    if not shift:
        size = squared / (detuning**2 + loss**2)
        return size * detuning, -size * loss
    detuning = detuning + shift**2 + 2 * shift * (ratios * omega) @ ca.DM.ones(1, freq.size)
    loss, turned = loss + 2 * shift * ca.repmat(w, omega.numel(), 1), 2 * shift * ca.repmat(w, omega.numel(), 1)
    size, squared = 1 / (detuning**2 + loss**2), squared - shift**2
    return size * (squared * detuning - turned * loss), -size * (squared * loss + turned * detuning)


def modal_motion(base: ComplexArray, gamma: ca.MX, gains: tuple[ca.MX, ca.MX]) -> tuple[ca.MX, ca.MX]:
    """Real and imaginary part of ``q_k = g_k gamma_k u``, (m, runs * n_freq) each.

    Parameters
    ----------
    base : (runs, d, n_freq) complex
    gamma : (m, d)
    gains : (m, n_freq) each
        Of `modal_gains`.
    """
    g_re, g_im = (ca.repmat(part, 1, len(base)) for part in gains)
    push_re, push_im = (gamma @ part for part in parts_of(base))
    return g_re * push_re - g_im * push_im, g_re * push_im + g_im * push_re


def residual(
    test: Measurement, phi: ca.MX, gamma: ca.MX, omega: ca.MX, ratios: ca.MX, rigid_body_mass: ca.MX, *,
    weighted: bool = False, shift: float = 0.0,
) -> ca.MX:  # fmt: skip
    """Relative residuals, stacked: their sum of squares is the squared relative error of each record.

    Parameters
    ----------
    test : Measurement
    phi : (n, m)
        Mode shapes at the sensors.
    gamma : (m, d)
        Participations.
    omega, ratios : (m, 1)
        Circular frequencies, rad/s, and damping ratios.
    rigid_body_mass : (d, d), kg
        Read only where the test has a force.
    weighted : bool
        Channels and lines weigh by their stated noise, and accelerations and force by each other's where both are
        stated.
    shift : float, 1/s
        Of the complex frequencies from the imaginary axis, see `modal_gains`.

    Returns
    -------
    MX, a column
        ``(A_estimated - A_target) / ‖A_target‖`` (eq. 15), real then imaginary parts, then the
        same of the base force.
    """
    u_re, u_im = parts_of(test.base)
    q_re, q_im = modal_motion(test.base, gamma, modal_gains(omega, ratios, test.freq, shift))
    force = gamma.T @ q_re + rigid_body_mass @ u_re, gamma.T @ q_im + rigid_body_mass @ u_im
    every = zip(records_of(test), weights_of_test(test, weighted=weighted), strict=True)
    pieces = [
        ca.DM(weight / scale) * (predicted - recorded)
        for parts, ((record, _), (weight, scale)) in zip(((phi @ q_re, phi @ q_im), force), every, strict=False)
        for predicted, recorded in zip(parts, parts_of(record), strict=True)
    ]
    return ca.vertcat(*(ca.vec(ca.densify(piece)) for piece in pieces))


def weighted_error(test: Measurement, structure: Structure) -> float:
    """Norm of `residual` of a structure, its records weighed by stated noise."""
    both = zip(misfits(test, structure), weights_of_test(test, weighted=True), strict=True)
    return float(
        np.linalg.norm([np.linalg.norm(weight * columns(left)) / scale for (left, _), (weight, scale) in both])
    )


def error_of_accelerations(test: Measurement, structure: Structure) -> float:
    """`weighted_error` of the relative accelerations alone."""
    weight, scale = weights_of(test.relative, test.response_std)
    return float(np.linalg.norm(weight * columns(test.predict(structure) - test.relative))) / scale


def of_residual_modes(test: Measurement, structure: Structure) -> tuple[ComplexArray, ComplexArray]:
    """Relative accelerations (runs, n_sensors, n_freq) and force (runs, d, n_freq) of a structure's residual modes."""
    modes = structure.residual
    motion = np.einsum("kdf,rdf->rkf", modes.motion(test.freq), test.base)
    return modes.shapes @ motion, modes.participation.T @ motion


def residual_share(test: Measurement, structure: Structure) -> float:
    """Share of the relative accelerations that the residual modes of a structure add, of all in the test."""
    return float(np.linalg.norm(of_residual_modes(test, structure)[0]) / np.linalg.norm(test.relative))


def records_of(test: Measurement) -> list[tuple[ComplexArray, Array | None]]:
    """The relative accelerations and, where it was measured, the base force, each with its stated deviations."""
    records = [(test.relative, test.response_std)]
    return records if test.force is None else [*records, (test.force, test.force_std)]


def states_noise(test: Measurement) -> bool:
    """True where the noise of all `records_of` a test is stated."""
    return all(std is not None for _, std in records_of(test))


def predicted(test: Measurement, structure: Structure) -> list[ComplexArray]:
    """Prediction of relative accelerations and, where it was measured, of the force by a structure."""
    return [test.predict(structure), *([] if test.force is None else [test.predict_force(structure)])]


def misfits(test: Measurement, structure: Structure) -> list[tuple[ComplexArray, Array | None]]:
    """What a structure leaves of the `records_of` a test, each with its stated deviations."""
    both = zip(records_of(test), predicted(test, structure), strict=True)
    return [(record - fitted, std) for (record, std), fitted in both]


def weights_of_test(test: Measurement, *, weighted: bool) -> list[tuple[Array, float]]:
    """`weights_of` the `records_of` a test.

    Where the noise of both is stated, both have the size of the accelerations, so that they weigh by their noise alone.
    """
    found = [weights_of(record, std if weighted else None) for record, std in records_of(test)]
    if weighted and test.response_std is not None and test.force_std is not None:
        found = [(weight, found[0][1]) for weight, _ in found]
    return found


def weights_of_numbers(std: Array | None, shape: tuple[int, int, int]) -> Array:
    """Weights of a record's numbers, `products` of channels and lines, as `columns` has them."""
    channel, line = factors_of_runs(std, shape)
    return (channel.T[..., None] * line).reshape(shape[1], -1)


def weights_of(record: ComplexArray, std: Array | None) -> tuple[Array, float]:
    """`weights_of_numbers` of a record, and the size of the weighted record."""
    weight = weights_of_numbers(std, record.shape)
    return weight, float(np.linalg.norm(weight * columns(record)))


def weighed_mass(test: Measurement, omega: Array, ratios: Array) -> Array:
    """Rigid-body mass (d, d) that follows from the base force, its modal part free at the given poles; kg.

    Lines weigh by what is stated of the force's noise.
    """
    _, _, found = _weighed(test, omega, ratios)
    return found[: test.n_base].T


def weighed_mass_std(test: Measurement, omega: Array, ratios: Array) -> Array:
    """Standard deviation of the diagonal of `weighed_mass`, (d,), by what the fit leaves of the force."""
    design, force, found = _weighed(test, omega, ratios)
    left = np.sum((force - design @ found) ** 2, axis=0) / max(len(design) - design.shape[1], 1)
    size = np.linalg.norm(design, axis=0)
    size[size == 0] = 1.0
    d = test.n_base
    return np.sqrt(left) * np.linalg.norm(np.linalg.pinv(design / size), axis=1)[:d] / size[:d]


def _weighed(test: Measurement, omega: Array, ratios: Array) -> tuple[Array, Array, Array]:
    """Motion of the base and of the modes as columns, the force likewise, and how much of each makes up the force."""
    assert test.force is not None
    weight = separable(test.force_std, test.force.shape)[1].ravel()
    u = columns(test.base)
    modal = np.tile(gains(test.freq, omega, ratios), test.n_runs)[:, None] * u
    design = stacked(weight * np.concatenate([u, modal.reshape(-1, u.shape[1])]))
    force = stacked(weight * columns(test.force))
    return design, force, np.linalg.lstsq(design, force, rcond=None)[0]


def gains(freq: Array, omega: Array, ratios: Array, shift: float = 0.0) -> ComplexArray:
    """Numbers of ``g_k = w² / (w_k² - w² + 2 i zeta_k w_k w)`` at lines in Hz, (m, n_freq); `shift` as above."""
    s = shift + 2j * np.pi * freq
    return -(s**2) / (omega[:, None] ** 2 + s**2 + 2 * (ratios * omega)[:, None] * s)


def coupled_flexibility(freq: Array, omega: Array, ratios: Array, coupling: Array) -> ComplexArray:
    """Inverse of ``w_k² - w² + i w (2 zeta_k w_k + Z)`` of modes that dampers couple, (m, m, n_freq), s²/rad².

    Z (m, m), rad/s, is `coupling`, with zeros on its diagonal. Modal motions are w² times that times their loads.
    """
    s = 2j * np.pi * freq[:, None, None]
    dynamic = np.diag(omega**2) + s**2 * np.eye(omega.size) + s * (np.diag(2 * ratios * omega) + coupling)
    return np.ascontiguousarray(np.moveaxis(np.linalg.inv(dynamic), 0, -1))


def modes_above(freq: Array, last: float) -> Array:
    """Functions w² and of a pole not far above the last line, Hz, which modes above the lines add, (2, n_freq)."""
    s = freq / last
    return np.stack([s**2, s**2 / (ABOVE**2 - s**2)])


def gains_with_velocity(freq: Array, omega: Array, ratios: Array, shift: float = 0.0) -> ComplexArray:
    """`gains`, then ``s / w_k`` times them, with ``s = shift + i w``, (2, m, n_freq)."""
    g = gains(freq, omega, ratios, shift)
    return np.stack([g, (shift + 2j * np.pi * freq) / omega[:, None] * g])


def gains_and_slopes(freq: Array, omega: Array, ratios: Array) -> tuple[ComplexArray, ComplexArray]:
    """`gains` (m, n_freq), and their derivatives by log w_k, then by log zeta_k, (2m, n_freq)."""
    s = 2j * np.pi * freq
    loss = (2 * ratios * omega)[:, None] * s
    over = 1 / ((omega**2)[:, None] + s**2 + loss)
    g = -(s**2) * over
    by = -g * over
    return g, np.concatenate([by * (2 * (omega**2)[:, None] + loss), by * loss])


def motion_and_slopes(
    freq: Array, omega: Array, ratios: Array, gamma: Array, base: ComplexArray, ends: ComplexArray | float = 0.0
) -> ComplexArray:
    """Modal motions ``q_k = g_k (gamma_k u + ends_k)`` and their derivatives, which are written nowhere else.

    Parameters
    ----------
    freq : (L,), Hz
    omega, ratios : (m,)
        Circular frequencies, rad/s, and damping ratios.
    gamma : (m, d)
        Participations.
    base : (d, L)
        Motion u of the base.
    ends : (m, L), optional
        Load of each mode by its motion at the ends of the record.

    Returns
    -------
    (m + m d + 2 m, L)
        q; its derivatives by gamma, mode by mode; by log w_k; by log zeta_k.
    """
    g, slopes = gains_and_slopes(freq, omega, ratios)
    load = real_times(gamma, base) + ends
    by_pole = slopes.reshape(2, *g.shape) * load
    return np.concatenate([g * load, (g[:, None] * base).reshape(-1, freq.size), *by_pole])


def motion_curvature(
    freq: Array, omega: Array, ratios: Array, gamma: Array, base: ComplexArray, pull: ComplexArray
) -> Array:
    """Second derivatives of the modal motions, summed over the lines: ``Re conj(pull_k) q_k''``.

    Parameters
    ----------
    freq, omega, ratios, gamma, base :
        As in `motion_and_slopes`.
    pull : (m, L)

    Returns
    -------
    (m, d + 2, d + 2)
        By the participations of each mode, log w_k and log zeta_k.
    """
    d, s = gamma.shape[1], 2j * np.pi * freq
    stiff, loss = (omega**2)[:, None], (2 * ratios * omega)[:, None] * s
    over = 1 / (stiff + s**2 + loss)
    by = np.stack([(2 * stiff + loss) * over, loss * over])  # slopes of the denominator, over itself
    weight = pull.conj() * -(s**2) * over
    out = np.zeros((len(omega), d + 2, d + 2))
    out[:, d:, :d] = -((by * weight) @ base.T).real.swapaxes(0, 1)
    out[:, :d, d:] = out[:, d:, :d].swapaxes(1, 2)
    turned = weight * real_times(gamma, base)
    twice = {(0, 0): (4 * stiff + loss) * over, (0, 1): by[1], (1, 1): by[1]}
    for (a, b), bend in twice.items():
        out[:, d + a, d + b] = out[:, d + b, d + a] = np.sum((turned * (2 * by[a] * by[b] - bend)).real, axis=1)
    return out


def real_times(matrix: Array, rows: ComplexArray) -> ComplexArray:
    """A real matrix times rows (k, L) in real arithmetic: half of what a complex product would take."""
    return np.asarray((np.ascontiguousarray(matrix) @ np.ascontiguousarray(rows).view(float)).view(complex))
