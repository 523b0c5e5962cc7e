"""A structure as numbers: mass, stiffness, damping, and every response that follows from them."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError, as_float, check_frequencies, refuse, shaped_array, symmetric_array, whole_number
from sysid.structure.amplitude import FittedLaw, follow_laws, laws_from_tree, laws_to_tree
from sysid.structure.sensor import checked_sensors, sensors_from_tree, sensors_to_tree
from sysid.structure.simulation import ModalModel, fitted_state, modal_accelerations
from sysid.structure.superelement import CraigBampton, ResidualModes, checked_rigid_motion, modal_gains, unturned
from sysid.structure.thresholds import EXACT

if TYPE_CHECKING:
    from scipy.signal import StateSpace

Array = NDArray[np.floating[Any]]
ComplexArray = NDArray[np.complexfloating[Any]]


class Structure:
    r"""A linear structure on a moving base.

    The degrees of freedom are partitioned ``[S, 0]``: `n` of the structure first, then `d` of the
    base. With ``G = -K_SS^-1 K_S0`` and ``v = u_S - G u_0`` the motion relative to the base obeys

    .. math:: M_{SS} \ddot v + C \dot v + K_{SS} v = -B \ddot u_0, \qquad B = M_{SS} G + M_{S0}.

    Parameters
    ----------
    mass, stiffness : array_like, shape (n + d, n + d)
        Symmetric, kg and N/m (kg m, kg m² and N, N m where a rotation is involved). ``M_SS`` and
        ``K_SS`` positive definite, ``M`` positive semidefinite, and ``K`` with the rigid-body
        motions ``[G; I]`` as its null space (a statically determinate base).
    damping_ratios : array_like, shape (n,), optional
        Fractions of critical damping, in ascending order of frequency.
    n_base : int
        Number `d` of base directions.
    damping_matrix : array_like, shape (n, n), optional
        Symmetric viscous damping on the relative motion, N s/m. Exactly one of `damping_ratios`
        and `damping_matrix` is given.
    rigid_body : array_like, shape (n_sensors, d), optional
        Motion of the sensors for unit base motion. By default it follows from the stiffness and `recovery`. Without
        `recovery`, a stated one that disagrees is an error; with it, the stated one counts, as modes that are left out
        make the product inexact.
    recovery : array_like, shape (n_sensors, n), optional
        Takes the degrees of freedom to the sensors; the identity by default.
    sensors : sequence of Sensor, optional
        Descriptions of the sensors, for tables and figures.
    residual : ResidualModes, optional
        What answers in the band with the structure's own modes; none by default.
    laws : sequence of FittedLaw, optional
        Of modes that follow their own amplitude. Mass, stiffness, damping, modes and responses to spectra are those at
        rest; `simulate` and `simulate_force` follow the laws, and `at_level` gives the structure at a level.

    Attributes
    ----------
    mass, stiffness : (n + d, n + d)
    damping : (n, n)
        Physical damping on the relative motion; from ratios it is
        ``M Phi diag(2 zeta w) Phi' M`` (Cerini et al. 2024, eq. 33).
    damping_ratios : (n,)
        As given, or ``diag(Phi' C Phi) / 2 w``.
    modal_damping_matrix : (n, n)
        ``Phi' C Phi``, rad/s: diagonal where the damping is classical.
    modal_damping : bool
        Whether ratios were given, so that responses are modal sums; else they are direct solves.
    natural_frequencies : (n,)
        Hz, ascending, of the structure on a fixed base.
    mode_shapes : (n_sensors, n)
        Mass-normalised, at the sensors.
    normal_modes : (n, n)
        The same at the degrees of freedom: ``mode_shapes = recovery @ normal_modes``.
    rigid_body_dofs : (n, d)
        G, motion of the degrees of freedom for unit base motion.
    participation : (n, d)
        ``Phi' B``, one row a mode.
    effective_masses : (n, d, d)
        ``gamma_k' gamma_k`` of each mode.
    rigid_body_mass : (d, d)
        ``[G; I]' M [G; I]``, that of the residual modes included.
    residual : ResidualModes

    Raises
    ------
    InputError
        Where a matrix is not what the list above demands; the message says by how much.

    Notes
    -----
    Frequencies are in Hz, spectra follow ``exp(+i w t)``.

    Examples
    --------
    >>> import numpy as np
    >>> import sysid
    >>> m, k = 2.0, 800.0
    >>> one = sysid.Structure(np.diag([m, 0.0]), k * np.array([[1, -1], [-1, 1]]), [0.01], n_base=1)
    >>> bool(np.isclose(one.natural_frequencies[0], np.sqrt(k / m) / (2 * np.pi)))
    True
    """

    def __init__(
        self,
        mass: ArrayLike,
        stiffness: ArrayLike,
        damping_ratios: ArrayLike | None = None,
        *,
        n_base: int,
        damping_matrix: ArrayLike | None = None,
        rigid_body: ArrayLike | None = None,
        recovery: ArrayLike | None = None,
        sensors: Sequence[Any] | None = None,
        residual: ResidualModes | None = None,
        laws: Sequence[FittedLaw] = (),
    ) -> None:
        self.mass = symmetric_array("mass", mass, "n + d", EXACT)
        self.stiffness = symmetric_array("stiffness", stiffness, "n + d", EXACT)
        if self.mass.shape != self.stiffness.shape:
            raise InputError(f"mass is {self.mass.shape} but stiffness is {self.stiffness.shape}; both are (n+d, n+d)")
        size = len(self.mass)
        self.n_base = whole_number("n_base", n_base, at_least=1)
        self.n = n = size - self.n_base
        if n < 1:
            raise InputError(
                f"n_base = {n_base} leaves {n} structural degrees of freedom of {size}; at least one of each is needed"
            )
        self.rigid_body_dofs: Array = checked_rigid_motion(self.mass, self.stiffness, n)

        lam, phi = scipy.linalg.eigh(self.stiffness[:n, :n], self.mass[:n, :n])
        self._omega = np.sqrt(lam)
        # A mode's sign is arbitrary: the entry of largest magnitude is made positive, so that the
        # same structure always prints the same shapes.
        self.normal_modes: Array = phi * np.sign(phi[np.argmax(np.abs(phi), axis=0), np.arange(n)])
        self.natural_frequencies: Array = self._omega / (2 * np.pi)
        self._set_damping(damping_ratios, damping_matrix)
        self._set_laws(laws)

        self.recovery: Array = np.eye(n) if recovery is None else shaped_array("recovery", recovery, "n_sensors", n)
        self.rigid_body: Array = self._sensor_rigid_body(rigid_body, recovery is not None)
        self.sensors = checked_sensors(sensors)
        if self.sensors is not None and len(self.sensors) != self.n_sensors:
            raise InputError(f"{len(self.sensors)} sensors are described but the structure has {self.n_sensors}")
        self._set_residual(residual or ResidualModes.none(self.n_sensors, self.n_base))

        G = self.rigid_body_dofs
        B = self.mass[:n, :n] @ G + self.mass[:n, n:]
        rigid = np.vstack([G, np.eye(self.n_base)])
        self.mode_shapes: Array = self.recovery @ self.normal_modes
        self.participation: Array = self.normal_modes.T @ B
        self.effective_masses: Array = np.einsum("ki,kj->kij", self.participation, self.participation)
        self.rigid_body_mass: Array = rigid.T @ self.mass @ rigid
        self._coupling = B

    def _set_residual(self, residual: ResidualModes) -> None:
        theirs, ours = (len(residual.shapes), residual.participation.shape[1]), (self.n_sensors, self.n_base)
        words = "the residual modes are of {} sensors and {} base directions, the structure of {} and {}"
        refuse((theirs != ours, words.format(*theirs, *ours)))
        if residual.coupling is not None:
            shaped_array("residual coupling", residual.coupling, residual.count, self.n + residual.count)
        self.residual = residual
        # Frequencies, turns and loss of the modes without the answer of static residual ones.
        self._turned: tuple[Array, Array, Array] = self._omega, np.eye(self.n), self.modal_damping_matrix
        if residual.coupling is not None:
            self._turned = unturned(self._omega, self.modal_damping_matrix, *residual.above(self.normal_modes))

    def with_residual(self, residual: ResidualModes) -> Structure:
        """The same structure with these residual modes in the place of its own."""
        other = copy(self)
        other._set_residual(residual)
        return other

    def with_laws(self, laws: Sequence[FittedLaw]) -> Structure:
        """The same structure with modes that follow their amplitude."""
        other = copy(self)
        other._set_laws(laws)
        return other

    def _set_laws(self, laws: Sequence[FittedLaw]) -> None:
        self.laws: tuple[FittedLaw, ...] = ()
        for law in laws:
            mode, other = (law.mode_among(self.natural_frequencies, followed=one) for one in (False, True))
            if mode is None or other is None:
                frequency = law.frequency if mode is None else law.followed
                what = f"the structure has no mode near {frequency:.4g} Hz, which the law is of"
                raise InputError(f"laws: {what}: leave the law out (with_laws), or keep its mode")
            self.laws += (replace(law, mode=mode, level_of=other),)
        twice = len({law.mode for law in self.laws}) < len(self.laws)
        refuse((twice, "laws: two of them are of one mode, the nearest in frequency: keep one"))

    def at_level(self, level: float) -> Structure:
        """The linear structure that moves as this one does where its modes with a law move at a level, m/s².

        ``K(A) = K - (w0² - w(A)²) M phi phi' M`` and likewise C: the mass stays. Modes without a law stay too.
        """
        level = as_float("level", level, "m/s², >= 0", at_least=0)
        K, C = self.stiffness.copy(), self.damping.copy()
        for law in self.laws:
            k = law.mode
            row = self.normal_modes[:, k] @ self.mass[: self.n, : self.n]
            both = np.append(row, -row @ self.rigid_body_dofs)
            of_stiffness, of_damping = law.changes_at(level, self._omega[k], self.damping_ratios[k])
            K, C = K + of_stiffness * np.outer(both, both), C + of_damping * np.outer(row, row)
        tree = {**self.to_tree(), "laws": None, "stiffness": K, "damping_ratios": None, "damping_matrix": C}
        return Structure.from_tree(tree)

    def to_tree(self) -> dict[str, Any]:
        """Arguments of the constructor as a dictionary of numbers and arrays, for `from_tree`."""
        return {
            "mass": self.mass, "stiffness": self.stiffness,
            # Which of the two was given; the other follows from it.
            "damping_ratios": self.damping_ratios if self.modal_damping else None,
            "damping_matrix": None if self.modal_damping else self.damping,
            "n_base": self.n_base, "recovery": self.recovery, "rigid_body": self.rigid_body,
            "sensors": sensors_to_tree(self.sensors), "residual": vars(self.residual) if self.residual.count else None,
            "laws": laws_to_tree(self.laws),
        }  # fmt: skip

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> Structure:
        """Structure from a dictionary that `to_tree` made, exact to the bit."""
        residual, laws = tree.get("residual"), laws_from_tree(tree.get("laws"))  # structures of before have none
        residual = residual and ResidualModes(**residual)
        return cls(**{**tree, "sensors": sensors_from_tree(tree["sensors"]), "residual": residual, "laws": laws})

    @property
    def n_sensors(self) -> int:
        """Number of sensors, the rows of `recovery`."""
        return int(self.recovery.shape[0])

    @property
    def dof_sensors(self) -> NDArray[np.intp]:
        """The sensor that records each degree of freedom alone, (n,); -1 where there is none."""
        R = self.recovery
        alone = (np.abs(R - 1) < 1e-6) & (np.abs(R).sum(axis=1, keepdims=True) < 1 + 1e-6)
        return np.where(alone.any(axis=0), alone.argmax(axis=0), -1)

    @property
    def at_sensors(self) -> bool:
        """True where the degrees of freedom are the sensors, one each and in their order."""
        return not self.residual.count and np.array_equal(self.recovery, np.eye(self.n_sensors))

    @property
    def dof_modes(self) -> NDArray[np.intp]:
        """The mode whose coordinate a degree of freedom is, (n,); -1 where several modes move it."""
        size = np.abs(self.normal_modes)
        one = np.isclose(size.max(axis=1), np.linalg.norm(size, axis=1), rtol=1e-9)
        return np.where(one, size.argmax(axis=1), -1)

    @property
    def effective_mass_percent(self) -> Array:
        """Effective mass of each mode in each base direction, in % of the rigid-body mass, (n, d)."""
        rigid = np.diag(self.rigid_body_mass)
        return 100 * self.participation**2 / np.where(rigid > 0, rigid, np.inf)

    def __repr__(self) -> str:
        low, high = self.natural_frequencies[[0, -1]]
        return f"<Structure: n = {self.n}, d = {self.n_base}, {low:.4g} to {high:.4g} Hz>"

    def relative_acceleration(self, freq: ArrayLike) -> ComplexArray:
        """Acceleration of the sensors relative to the base, per unit base acceleration.

        Parameters
        ----------
        freq : array_like, shape (n_freq,)
            Hz.

        Returns
        -------
        ndarray, complex, shape (n_sensors, d, n_freq)
        """
        lines = check_frequencies(freq, increasing=False)
        if self.residual.coupling is not None:
            return np.asarray(np.tensordot(self._all_shapes, self._modal_model.motion(lines), 1), dtype=complex)
        beyond = np.tensordot(self.residual.shapes, self.residual.motion(lines), 1)
        return np.tensordot(self.recovery, self._relative(lines), 1) + beyond

    def transmissibility(self, freq: ArrayLike) -> ComplexArray:
        """Absolute acceleration of the sensors per unit base acceleration, (n_sensors, d, n_freq)."""
        return self.relative_acceleration(freq) + self.rigid_body[:, :, None]

    def base_force(self, freq: ArrayLike) -> ComplexArray:
        """Force of the base on the structure per unit base acceleration (apparent mass), kg.

        ``f_0 = B' a + M_rb``: exact for any damping that acts on the relative motion.

        Returns
        -------
        ndarray, complex, shape (d, d, n_freq)
            [force direction, base direction, line].
        """
        lines, beyond = check_frequencies(freq, increasing=False), self.residual
        if beyond.coupling is not None:
            every = np.tensordot(self._modal_model.participation.T, self._modal_model.motion(lines), 1)
            return np.asarray(every + self.rigid_body_mass[:, :, None], dtype=complex)
        own = np.tensordot(self._coupling.T, self._relative(lines), 1)
        others: ComplexArray = np.einsum("ki,kjf->ijf", beyond.participation, beyond.motion(lines))
        others += own + self.rigid_body_mass[:, :, None]
        return others

    def simulate(self, base: ArrayLike, sample_rate: float, *, initial: ArrayLike | None = None) -> Array:
        """Absolute accelerations of the sensors in time, under a base acceleration given by samples.

        Parameters
        ----------
        base : array_like, shape (d, n_samples)
            Base acceleration, m/s².
        sample_rate : float
            Hz.
        initial : array_like, shape (2, n), optional
            Modal displacements and velocities at the first sample (kg^1/2 m, kg^1/2 m/s), as `initial_state` finds
            them; of a known relative motion v they are ``normal_modes.T @ M_SS @ v``. Where not given, the structure
            is at rest relative to the base.

        Returns
        -------
        ndarray, shape (n_sensors, n_samples)

        Raises
        ------
        InputError
            Where shapes disagree or there are fewer than two samples.

        Notes
        -----
        Exact for a base acceleration that is the natural spline of degree 11 through its samples, for any damping
        matrix. What is band-limited loses ``1 - sinc(x)^12 / sum_k sinc(x - k)^12`` of its amplitude, x = frequency /
        sample rate: 0.76 % at 2.5 samples a period, 0.024 % at 3, 0.0002 % at 4. The error of the base force may be
        several times larger, as it is a small difference of large forces. The spline is less exact over some ten
        samples at either end. Resample a record with fewer samples a period to a higher rate first.

        Examples
        --------
        >>> import numpy as np
        >>> K = 800.0 * np.array([[1, -1], [-1, 1]])
        >>> one = Structure(np.diag([2.0, 0.0]), K, [0.5], n_base=1)
        >>> rising = np.ones((1, 200))  # after a step of the base acceleration the mass follows
        >>> bool(np.isclose(one.simulate(rising, 50.0)[0, -1], 1.0))
        True
        """
        motion, modal = self._in_time(base, sample_rate, initial)
        return self._all_shapes @ modal + self.rigid_body @ motion

    def simulate_force(self, base: ArrayLike, sample_rate: float, *, initial: ArrayLike | None = None) -> Array:
        """Force of the base on the structure in time, (d, n_samples), N; see `simulate`."""
        motion, modal = self._in_time(base, sample_rate, initial)
        return self._modal_model.participation.T @ modal + self.rigid_body_mass @ motion

    def initial_state(self, base: ArrayLike, response: ArrayLike, sample_rate: float) -> Array:
        """Modal displacements and velocities at the first sample that explain records best, in least squares.

        Parameters
        ----------
        base : array_like, shape (d, n_samples)
            Base acceleration, m/s².
        response : array_like, shape (n_sensors, n_samples)
            Absolute accelerations of the sensors, m/s².
        sample_rate : float
            Hz.

        Returns
        -------
        ndarray, shape (2, n)
            `initial` of `simulate`. A mode that no sensor sees is at rest.
        """
        samples = np.shape(base)[-1] if np.ndim(base) else 0
        measured = shaped_array("response", response, self.n_sensors, samples)
        left = measured - self.simulate(base, sample_rate)
        return fitted_state(self._modal_model, self._all_shapes, left, sample_rate, self.n) @ self._turned[1].T

    @property
    def _modal_model(self) -> ModalModel:
        """The structure's own modes, turned, then the residual ones."""
        beyond, (omega, turn, loss) = self.residual, self._turned
        loss = scipy.linalg.block_diag(loss, np.diag(2 * beyond.damping_ratios * beyond.omega))
        if beyond.coupling is not None:
            across, among = np.split(beyond.coupling, [self.n], axis=1)
            across = across @ self.normal_modes @ turn
            loss += np.block([[np.zeros((self.n, self.n)), across.T], [across, among]])
        participation = np.vstack([turn.T @ self.participation, beyond.participation])
        return ModalModel(np.concatenate([omega, beyond.omega]), loss, participation)

    @property
    def _all_shapes(self) -> Array:
        """The same modes at the sensors, (n_sensors, n + r)."""
        return np.hstack([self.mode_shapes @ self._turned[1], self.residual.shapes])

    def _in_time(self, base: ArrayLike, sample_rate: float, initial: ArrayLike | None) -> tuple[Array, Array]:
        """Base acceleration and modal accelerations, (n + r, n_samples); residual modes begin at rest."""
        motion = shaped_array("base", base, self.n_base, "n_samples")
        rate = as_float("sample_rate", sample_rate)
        refuse(
            (motion.shape[1] < 2, f"base has {motion.shape[1]} samples; at least two are needed"),
            (rate <= 0, f"sample_rate = {rate:g} Hz; it must be positive"),
        )
        state = np.zeros((2, self.n + self.residual.count))
        if initial is not None:
            state[:, : self.n] = np.linalg.solve(self._turned[1], shaped_array("initial", initial, 2, self.n).T).T
        modal = modal_accelerations(self._modal_model, motion, rate, state)
        poles, n = np.stack([self._omega, self.damping_ratios]), self.n
        follow_laws(modal, self.laws, poles, self.mode_shapes, self.participation @ motion, rate, state[:, :n])
        return motion, modal

    def to_state_space(self) -> StateSpace:
        """Continuous-time state space from base accelerations to absolute sensor accelerations.

        Returns
        -------
        scipy.signal.StateSpace
            2 (n + r) states ``[v, v']`` (the relative motion of the degrees of freedom, then of the residual modes), d
            inputs, n_sensors outputs.
        """
        from scipy.signal import StateSpace

        whole, R = self._modal_model, np.hstack([self.recovery, self.residual.shapes])
        turn = scipy.linalg.block_diag(self.normal_modes @ self._turned[1], np.eye(self.residual.count))
        back = np.linalg.inv(turn)
        spring, loss = turn * whole.omega**2 @ back, turn @ whole.damping @ back
        acceleration = np.hstack([-spring, -loss])
        feed = -turn @ whole.participation
        A = np.vstack([np.hstack([np.zeros_like(spring), np.eye(len(spring))]), acceleration])
        return StateSpace(A, np.vstack([np.zeros_like(feed), feed]), R @ acceleration, R @ feed + self.rigid_body)

    def to_craig_bampton(self, *, residual_vectors: bool = True) -> CraigBampton:
        """Fixed-base modal coordinates, those of residual modes last, beside the base's own degrees of freedom.

        The response to base motion depends on the structure through this form alone; with the base force measured, a
        test determines all of it, whatever the number of sensors.

        Parameters
        ----------
        residual_vectors : bool
            Keep the coordinates of residual modes; without them the form has the modes that are told, alone.

        References
        ----------
        R. R. Craig, M. C. C. Bampton, AIAA J. 6 (1968) 1313-1319.
        """
        alone = ModalModel(self._omega, self.modal_damping_matrix, self.participation)
        omega, loss, gamma = self._modal_model if residual_vectors else alone
        base = np.zeros((self.n_base, self.n_base))
        return CraigBampton(
            mass=np.block([[np.eye(omega.size), gamma], [gamma.T, self.rigid_body_mass]]),
            stiffness=scipy.linalg.block_diag(np.diag(omega**2), base),
            damping=scipy.linalg.block_diag(loss, base),
            recovery=np.hstack([self._all_shapes if residual_vectors else self.mode_shapes, self.rigid_body]),
        )

    def _relative(self, freq: Array) -> ComplexArray:
        """Relative acceleration of the degrees of freedom, (n, d, n_freq), exact to round-off."""
        omega = 2 * np.pi * freq
        if self.modal_damping:
            g = modal_gains(omega, self._omega, self.damping_ratios)
            return (self.normal_modes[:, None] * self.participation.T) @ g
        n, w = self.n, omega[:, None, None]
        dynamic = -(w**2) * self.mass[:n, :n] + 1j * w * self.damping + self.stiffness[:n, :n]
        return np.moveaxis(np.linalg.solve(dynamic, w**2 * self._coupling), 0, -1).astype(complex, copy=False)

    def _set_damping(self, ratios: ArrayLike | None, matrix: ArrayLike | None) -> None:
        n = self.n
        if (ratios is None) == (matrix is None):
            raise InputError("give exactly one of damping_ratios (n,) and damping_matrix (n, n)")
        self.modal_damping = ratios is not None
        if ratios is not None:
            self.damping_ratios: Array = shaped_array("damping_ratios", ratios, n)
            if np.any(self.damping_ratios < 0):
                raise InputError(f"damping ratio {self.damping_ratios.min():.3g} is negative")
            modal = np.diag(2 * self.damping_ratios * self._omega)
            momentum = self.mass[:n, :n] @ self.normal_modes
            self.damping: Array = momentum @ modal @ momentum.T
        else:
            assert matrix is not None
            self.damping = symmetric_array("damping_matrix", matrix, n, EXACT)
            modal = self.normal_modes.T @ self.damping @ self.normal_modes
            if np.linalg.eigvalsh(modal)[0] < -EXACT * np.abs(modal).max():
                raise InputError("damping_matrix is not positive semidefinite: the structure would feed energy in")
            self.damping_ratios = np.diag(modal) / (2 * self._omega)
        self.modal_damping_matrix: Array = modal

    def _sensor_rigid_body(self, given: ArrayLike | None, recovered: bool) -> Array:
        implied = self.recovery @ self.rigid_body_dofs
        if given is None:
            return implied
        stated = shaped_array("rigid_body", given, *implied.shape)
        if recovered:
            return stated
        worst = np.max(np.abs(stated - implied))
        if worst > 1e-6 * max(1.0, float(np.max(np.abs(implied)))):
            raise InputError(
                f"rigid_body differs from -K_SS^-1 K_S0 by up to {worst:.3g}; leave it out, or check axes and signs"
            )
        return implied
