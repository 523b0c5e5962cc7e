r"""A test as it would look with more decay: wide peaks, in which a model far from the truth still finds its way.

The misfit of a lightly damped structure has a minimum for every way in which peaks can be mistaken for others, and each
is as wide as a peak. So a search begins with the response at complex frequencies :math:`s = \sigma + i\omega`,
where all peaks are wider by :math:`\sigma`, and takes smaller and smaller shifts to the records themselves. What the
records would be there follows from their poles and residues, whatever model is fitted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.residues import Records, force_residual_left
from sysid.modal_analysis.response import columns, gains, weights_of
from sysid.modal_analysis.vector_fitting import Monitor, poles_of_any_damping
from sysid.structure.structure import Array, ComplexArray

_LINES = 80
_LEAST = 1e-5  # a smaller level of noise would leave no weight to what is known beside the records
_DEPENDENT = 1e-9  # of the largest singular value of the base records
_BEYOND = 0.3  # of the lowest and of the highest frequency, how far the lines reach


@dataclass(frozen=True, eq=False)
class PolesAndResidues:
    """What stands for a test at any complex frequency.

    Attributes
    ----------
    omega, ratios : (m,)
    residues, quadrature : (m, n_sensors, d)
        Of ``g_k`` and of ``s / w_k g_k``.
    force : (1 + 2m, d, d) or None
        Of a measured base force: of the base's own acceleration, then of the same functions.
    inputs : (d, r)
        Orthonormal directions in which the base moves.
    of_accelerations, residual : float
        Relative residual of the accelerations that they leave; the same with that of the force, where it was measured.
    """

    omega: Array
    ratios: Array
    residues: Array
    quadrature: Array
    force: Array | None
    inputs: Array
    of_accelerations: float
    residual: float

    @classmethod
    def of(cls, test: Measurement, *, monitor: Monitor | None = None) -> PolesAndResidues | None:
        """Those of a test; None where it shows none. The monitor is called as `find_poles` does."""
        records = Records(test)
        omega, ratios = poles_of_any_damping(records, monitor=monitor)
        if omega.size == 0:
            return None
        order = np.argsort(omega)
        omega, ratios = omega[order], ratios[order]
        # Residues in quadrature too, where the lines suffice for them.
        many = records.data.shape[0] > 4 * omega.size * records.n_base
        fit = records.fit(omega, ratios, velocity=many)
        both = fit.residues.reshape(omega.size, 2 if many else 1, -1, fit.residues.shape[-1])
        parts = [records.by_sensor(both[:, i]) for i in range(both.shape[1])]
        inputs = np.eye(test.n_base) if records.unit else _moved(test)
        quadrature = parts[1] if many else np.zeros_like(parts[0])
        own = left = float(np.sqrt(fit.squared_error / records.size))
        if test.force is not None:
            left = float(np.hypot(left, force_share(test) * force_residual_left(test, omega, ratios, velocity=many)))
        force = None if test.force is None else _force_residues(test, omega, ratios, many)
        return cls(omega, ratios, parts[0], quadrature, force, inputs, own, left)

    def base_force(self, freq: Array, shift: float) -> ComplexArray | None:
        """Base force likewise, (d, d, n_freq); None where it was not measured."""
        if self.force is None:
            return None
        g = gains(freq, self.omega, self.ratios, shift)
        turned = (shift + 2j * np.pi * freq) / self.omega[:, None] * g
        return np.einsum("kij,kf->ijf", self.force, np.concatenate([np.ones((1, freq.size)), g, turned]))

    def response(self, freq: Array, shift: float) -> ComplexArray:
        """Relative accelerations for unit base motion at ``s = shift + 2 pi i freq``, (n_sensors, d, n_freq)."""
        g = gains(freq, self.omega, self.ratios, shift)
        turned = (shift + 2j * np.pi * freq) / self.omega[:, None] * g
        return np.einsum("ksd,kf->sdf", self.residues, g) + np.einsum("ksd,kf->sdf", self.quadrature, turned)

    def smoothed(self, test: Measurement, share: float) -> Smoothed:
        """The test with a shift of this share of its mean frequency, one run for each independent base motion."""
        shift = share * float(np.exp(np.log(self.omega).mean()))
        ends = self.omega[[0, -1]] / (2 * np.pi)
        freq = np.linspace(max((1 - _BEYOND) * ends[0], 1e-3 * ends[1]), (1 + _BEYOND) * ends[1], _LINES)
        base = np.repeat(self.inputs.T[:, :, None], freq.size, axis=2).astype(complex)
        relative = np.einsum("sdf,rdf->rsf", self.response(freq, shift), base)
        absolute = relative + np.einsum("sd,rdf->rsf", test.rigid_body, base)
        made = self.base_force(freq, shift)
        force = None if made is None else np.einsum("edf,rdf->ref", made, base)
        smooth = Measurement(freq, base, absolute, rigid_body=test.rigid_body, force=force, base_axes=test.base_axes)
        return Smoothed(smooth, shift)


def _force_residues(test: Measurement, omega: Array, ratios: Array, velocity: bool) -> Array:
    """Free residues of the base force, (1 + 2m, d, d): of the base itself, of ``g_k`` and of ``s / w_k g_k``."""
    records = Records(test, force=True)
    g = gains(test.freq, omega, ratios)
    turned = [2j * np.pi * test.freq / omega[:, None] * g] if velocity else []
    basis = records.basis(np.concatenate([np.ones((1, test.freq.size)), g, *turned]))
    size = np.maximum(np.linalg.norm(basis, axis=0), np.finfo(float).tiny)
    beta = np.linalg.lstsq(basis / size, records.data, rcond=None)[0] / size[:, None]
    known = records.by_sensor(beta.reshape(1 + (1 + velocity) * omega.size, -1, beta.shape[1]))
    return np.concatenate([known, np.zeros((1 + 2 * omega.size - len(known), *known.shape[1:]))])


def _moved(test: Measurement) -> Array:
    """Orthonormal directions in which the base moves, (d, r)."""
    flat = columns(test.base)
    size = np.linalg.norm(flat, axis=1, keepdims=True)
    scaled = flat / np.where(size > 0, size, 1.0)
    left, s, _ = np.linalg.svd(np.hstack([scaled.real, scaled.imag]), full_matrices=False)
    return np.linalg.qr(size * left[:, s > _DEPENDENT * s[0]])[0]


def force_share(test: Measurement) -> float:
    """Size of a weighted force record in the misfit, that of the accelerations being 1."""
    if test.response_std is None or test.force_std is None:
        return 1.0
    assert test.force is not None
    return weights_of(test.force, test.force_std)[1] / weights_of(test.relative, test.response_std)[1]


@dataclass(frozen=True, eq=False)
class Smoothed:
    """Records at complex frequencies ``s = shift + i w``, in the form of a test at real ones."""

    test: Measurement
    shift: float


def noise_level(test: Measurement, *, monitor: Monitor | None = None) -> float:
    """Standard deviation of each real number of a test's relative, weighted residual.

    Of the stated noise where one is stated, else of what free residues at the poles of the data leave.

    Parameters
    ----------
    test : Measurement
    monitor : callable, optional
        Called as `find_poles` does while the poles are looked for.
    """
    if test.response_std is not None:
        weight, scale = weights_of(test.relative, test.response_std)
        std = np.asarray(weight) * columns(test.response_std.astype(complex)).real
        return max(float(np.sqrt(np.mean(std**2) / 2)) / scale, _LEAST)
    poles = PolesAndResidues.of(test, monitor=monitor)
    if poles is None:
        return _LEAST
    # The free residues and the poles have taken their share of the noise.
    free = 2 * poles.omega.size * (1 + poles.inputs.shape[1] * test.n_sensors)
    measured = 2 * test.response.size
    return max(poles.of_accelerations / float(np.sqrt(max(measured - free, 0.25 * measured))), _LEAST)
