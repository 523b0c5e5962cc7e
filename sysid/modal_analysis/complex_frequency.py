r"""A test at complex frequencies: its peaks are wider, so that a fit converges from farther away.

The misfit of a lightly damped structure has a minimum for every way in which peaks can be mistaken for others, and each
is as wide as a peak. So a search begins with the response at complex frequencies :math:`s = \sigma + i\omega`,
where all peaks are wider by :math:`\sigma`, and takes smaller and smaller shifts to the records themselves. What the
records would be there follows from their poles and residues, whatever model is fitted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.residues import Records, force_residues
from sysid.modal_analysis.response import columns, gains_with_velocity, weights_of
from sysid.modal_analysis.vector_fitting import Monitor, poles_of_any_damping
from sysid.structure.structure import Array, ComplexArray

_LEAST = 1e-5  # least level of noise; a smaller one would leave priors no weight
BEYOND = 0.3  # of the lowest and of the highest frequency, how far the lines reach


@dataclass(frozen=True, eq=False)
class PolesAndResidues:
    """Poles and residues of a test, from which its records follow at any complex frequency.

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
        """Poles and residues of a test; None where no pole is found. The monitor is called as by `find_poles`."""
        records = Records(test)
        omega, ratios = poles_of_any_damping(records, monitor=monitor)
        if omega.size == 0:
            return None
        order = np.argsort(omega)
        return cls.at(test, records, omega[order], ratios[order])

    @classmethod
    def at(cls, test: Measurement, records: Records, omega: Array, ratios: Array) -> PolesAndResidues:
        """Free residues of a test at given poles, (m,) each, ascending; `records` are those of its accelerations."""
        # Residues in quadrature too, where the lines suffice for them.
        many = records.data.shape[0] > 4 * omega.size * records.n_base
        fit = records.fit(omega, ratios, velocity=many)
        inputs, channels = records.base.shape[0], records.data.shape[1]
        both = np.zeros((omega.size, 2, inputs, channels))
        both[:, : 1 + many] = fit.residues.reshape(omega.size, -1, inputs, channels)
        # Directions that the base moves in, each counted by its size.
        weight = np.sum(np.abs(columns(test.base)) ** 2, axis=1, keepdims=True)
        directions = np.eye(test.n_base) if records.unit else np.linalg.qr(weight * records.moving)[0]
        of_response = left = float(np.sqrt(fit.squared_error / records.size))
        force = None
        if test.force is not None:
            force, of_force = force_residues(test, omega, ratios, velocity=many)
            left = float(np.hypot(of_response, force_share(test) * of_force))
        residues, quadrature = records.by_sensor(both[:, 0]), records.by_sensor(both[:, 1])
        return cls(omega, ratios, residues, quadrature, force, directions, of_response, left)

    def response(self, freq: Array, shift: float) -> ComplexArray:
        """Relative accelerations for unit base motion at ``s = shift + 2 pi i freq``, (n_sensors, d, n_freq)."""
        g, velocity = gains_with_velocity(freq, self.omega, self.ratios, shift)
        return np.einsum("ksd,kf->sdf", self.residues, g) + np.einsum("ksd,kf->sdf", self.quadrature, velocity)

    def records(self, freq: Array, base: ComplexArray, shift: float = 0.0) -> tuple[ComplexArray, ComplexArray | None]:
        """Relative accelerations and, where it was measured, force for base records (runs, d, n_freq)."""
        relative = np.einsum("sdf,rdf->rsf", self.response(freq, shift), base)
        if self.force is None:
            return relative, None
        functions = [np.ones((1, freq.size)), *gains_with_velocity(freq, self.omega, self.ratios, shift)]
        return relative, np.einsum("ked,kf,rdf->ref", self.force, np.concatenate(functions), base, optimize=True)

    def contributions(self, base: ComplexArray, modes: NDArray[np.intp]) -> ComplexArray:
        """Share of each mode in accelerations and force at base motion (runs, d), (modes, runs, n_sensors [+ d])."""
        parts = [self.residues[modes] + 1j * self.quadrature[modes]]
        if self.force is not None:
            parts.append(self.force[1 + modes] + 1j * self.force[1 + self.omega.size + modes])
        return np.einsum("ksd,rd->krs", np.concatenate(parts, axis=1), base)

    def smoothed(self, test: Measurement, share: float, highest: float = np.inf, lines: int = 80) -> Smoothed:
        """The test, at so many lines, `highest` Hz at most, with a shift of this share of its mean frequency.

        It has one run for each independent base motion.
        """
        shift = share * float(np.exp(np.log(self.omega).mean()))
        ends = self.omega[[0, -1]] / (2 * np.pi)
        highest = min((1 + BEYOND) * ends[1], highest)
        lowest = max((1 - BEYOND) * min(ends[0], highest), 1e-3 * ends[1])  # poles may all be above the lines
        freq = np.linspace(lowest, highest, lines)
        base = np.repeat(self.inputs.T[:, :, None], freq.size, axis=2).astype(complex)
        relative, force = self.records(freq, base, shift)
        absolute = relative + np.einsum("sd,rdf->rsf", test.rigid_body, base)
        smooth = Measurement(freq, base, absolute, rigid_body=test.rigid_body, force=force, base_axes=test.base_axes)
        return Smoothed(smooth, shift)


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

    From the stated noise, or else from what free residues at the poles of the data leave.

    Parameters
    ----------
    test : Measurement
    monitor : callable, optional
        Called as `find_poles` does while the poles are looked for.
    """
    if test.response_std is not None:
        weight, scale = weights_of(test.relative, test.response_std)
        std = weight * columns(test.response_std.astype(complex)).real
        return max(float(np.sqrt(np.mean(std**2) / 2)) / scale, _LEAST)
    poles = PolesAndResidues.of(test, monitor=monitor)
    if poles is None:
        return _LEAST
    # Free residues and poles fit a part of the noise.
    free = 2 * poles.omega.size * (1 + poles.inputs.shape[1] * test.n_sensors)
    measured = 2 * test.response.size
    return max(poles.of_accelerations / float(np.sqrt(max(measured - free, 0.25 * measured))), _LEAST)
