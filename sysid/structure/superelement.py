"""Forms of a structure that answer its base alone: the Craig-Bampton form, and residual modes beside its own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.errors import InputError, check_positive_definite, lowest_eigenvalue, refuse, shaped_array
from sysid.structure.thresholds import EXACT

Array = NDArray[np.floating[Any]]
ComplexArray = NDArray[np.complexfloating[Any]]


@dataclass(frozen=True, eq=False)
class ResidualModes:
    """Modes beyond the band of a test, r of them: in the band they add what all modes beyond it add together.

    They are poles of a fit, and no modes of the structure: their frequencies, ratios and masses mean nothing by
    themselves.

    Attributes
    ----------
    natural_frequencies : (r,)
        Hz.
    damping_ratios : (r,)
    shapes : (n_sensors, r)
        kg^-1/2.
    participation : (r, d)
        kg^1/2 (kg^1/2 m for a rotation of the base).
    static : int
        So many, the last, stand at frequencies that are held in the fit: they hold the answer, nearly static, of all
        modes above the band.
    coupling : (r, n + r), optional
        Loads of these modes by velocities of the n degrees of freedom of their structure, then of themselves, where
        dampers couple them: what stands off the diagonal of the damping; kg^1/2/s, then rad/s. Static ones answer the
        structure's modes, whose frequencies, shapes and loads are those that they have with it: see `in_band`.

    Raises
    ------
    InputError
        Where shapes do not agree, a frequency is not positive or a damping ratio negative.

    References
    ----------
    D. J. Ewins, Modal Testing: Theory, Practice and Application (2000), section 4.5 (residuals of modes outside the
    range of analysis).
    """

    natural_frequencies: Array
    damping_ratios: Array
    shapes: Array
    participation: Array
    static: int = 0
    coupling: Array | None = None

    def __post_init__(self) -> None:
        for name, *shape in (("natural_frequencies", "r"), ("damping_ratios", "r"), ("shapes", "n_sensors", "r"),
                             ("participation", "r", "d")):  # fmt: skip
            object.__setattr__(self, name, shaped_array(f"residual {name}", getattr(self, name), *shape))
        counts = {self.damping_ratios.size, self.shapes.shape[1], len(self.participation)}
        refuse(
            (
                counts != {self.count},
                f"residual modes: {self.count} frequencies, but {sorted(counts)} ratios, shapes, loads",
            ),
            (np.any(self.natural_frequencies <= 0), "the frequency of a residual mode is not positive"),
            (np.any(self.damping_ratios < 0), "the damping ratio of a residual mode is negative"),
            (not 0 <= self.static <= self.count, f"{self.static} of {self.count} residual modes cannot be static"),
        )

    @classmethod
    def none(cls, n_sensors: int, n_base: int) -> ResidualModes:
        """No modes."""
        return cls(np.zeros(0), np.zeros(0), np.zeros((n_sensors, 0)), np.zeros((0, n_base)))

    @property
    def count(self) -> int:
        """Number r of modes."""
        return int(self.natural_frequencies.size)

    @property
    def omega(self) -> Array:
        """Circular frequencies, rad/s, (r,)."""
        return 2 * np.pi * self.natural_frequencies

    def above(self, modes: Array) -> tuple[Array, Array, Array]:
        """Couplings of static modes with motions (n, m), their frequencies and loss, rad/s: (s, m), (s,), (s, s)."""
        assert self.coupling is not None
        at, n = slice(self.count - self.static, None), len(modes)
        loss = np.diag(2 * self.damping_ratios * self.omega) + self.coupling[:, n:]
        return self.coupling[at, :n] @ modes, self.omega[at], loss[at, at]

    def scaled(self, factor: float | Array) -> ResidualModes:
        """The same answer of the sensors, by modes of `factor`, one or (r,), times the participation."""
        participation = np.reshape(factor, (-1, 1)) * self.participation
        return replace(self, shapes=self.shapes / factor, participation=participation)

    def without_mass(self, totals: Array) -> ResidualModes:
        """The same answer of the sensors, by modes of a millionth of the totals (d,), where nothing weighs them."""
        size = np.linalg.norm(self.participation / np.sqrt(totals), axis=1)
        return self.scaled(1e-3 / np.maximum(size, np.finfo(float).tiny))

    def motion(self, freq: Array) -> ComplexArray:
        """Modal accelerations at lines in Hz per unit base acceleration, (r, d, n_freq)."""
        g = modal_gains(2 * np.pi * freq, self.omega, self.damping_ratios)
        return self.participation[:, :, None] * g[:, None]


def modal_gains(w: Array, omega: Array, ratios: Array) -> ComplexArray:
    """Relative acceleration of modes per unit load, ``w² / (w_k² - w² + 2 i zeta_k w_k w)``, (m, L); all in rad/s."""
    return np.asarray(w**2 / (omega[:, None] ** 2 - w**2 + 2j * (ratios * omega)[:, None] * w), dtype=complex)


def in_band(omega: Array, loss: Array, coupling: Array, above: Array, loss_above: Array) -> tuple[Array, Array, Array]:
    """Modes as a band shows them, of modes that dampers couple with static ones: (m,), turns T (m, m), loss (m, m).

    A static mode at W answers velocities of the others, and its answer acts on them by a damper again:
    ``w² c c' / (W² - w²)``, nearly as mass would. Its size is that of the static mode's own scale, which hardly shows.
    So modes are told with it: those p of ``S(w) = W_m² - w² + w² c c' / (W² - w²)`` with ``S(w_k) p_k = 0`` and unit
    mass ``-p' dS/d(w²) p``. With u = c / (W² - w_k²) the whole has, in their coordinates, the further mass W² u u', the
    stiffness (w² u) (w² u)' and the loss (w u) z (w u)' (`unturned`): T' S T less these is ``w_k² - w²``, exactly.

    Parameters
    ----------
    omega, loss : (m,), (m, m)
        rad/s.
    coupling : (r, m)
        By dampers with the static modes, rad/s.
    above, loss_above : (r,), (r, r)
        Static modes, rad/s.

    Raises
    ------
    LinAlgError
        Where not all modes keep a mass.
    """
    m, r = omega.size, above.size
    # With q = c p / (W² - w²) beside p the problem is linear.
    A = np.block([[np.diag(omega**2), np.zeros((m, r))], [-coupling, np.diag(above**2)]])
    lam, x = scipy.linalg.eig(A, np.block([[np.eye(m), -coupling.T], [np.zeros((r, m)), np.eye(r)]]))
    p, q = np.split(x.real, [m])
    size = np.sum(p**2, axis=0) - np.sum((above[:, None] * q) ** 2, axis=0)
    kept = np.flatnonzero((lam.imag == 0) & (lam.real > 0) & (size > 0))
    if kept.size != m:
        raise np.linalg.LinAlgError("dampers couple modes and static ones as strongly as their masses do")
    kept = kept[np.argsort(lam[kept].real)]
    found, T = np.sqrt(lam[kept].real), p[:, kept] / np.sqrt(size[kept])
    T = T * np.where(np.diag(T) < 0, -1.0, 1.0)
    moved = coupling @ T / (above[:, None] ** 2 - found**2) * found
    return found, T, T.T @ loss @ T - moved.T @ loss_above @ moved


def unturned(omega: Array, loss: Array, coupling: Array, above: Array, loss_above: Array) -> tuple[Array, Array, Array]:
    """The modes that `in_band` gives those told, up to signs: (m,), turns into them (m, m), and their loss (m, m)."""
    u = coupling / (above[:, None] ** 2 - omega**2)
    mass, spring = above[:, None] * u, u * omega**2
    lam, V = scipy.linalg.eigh(np.diag(omega**2) + spring.T @ spring, np.eye(omega.size) + mass.T @ mass)
    return np.sqrt(lam), V, V.T @ (loss + (u * omega).T @ loss_above @ (u * omega)) @ V


@dataclass(frozen=True, eq=False)
class CraigBampton:
    """A structure in modal coordinates q (n) and base motions u_0 (d): ``M z'' + C z' + K z = [0; f_0]``, z = [q; u_0].

    The coordinates of residual modes, where they are kept, are the last of q, so that n is their number too.

    Attributes
    ----------
    mass, stiffness, damping : (n + d, n + d)
        ``[[I, Gamma], [Gamma', M_rb]]``, ``diag(w², 0)`` and the modal damping, ``diag(2 zeta w, 0)`` where it is
        classical; modes mass-normalised, in ascending order of frequency.
    recovery : (n_sensors, n + d)
        ``[Phi, G]``: takes z to the absolute motion of the sensors.
    """

    mass: Array
    stiffness: Array
    damping: Array
    recovery: Array


def checked_rigid_motion(mass: Array, stiffness: Array, n: int) -> Array:
    """Check mass and stiffness of a structure of n degrees of freedom; give G of these, (n, d)."""
    for name, matrix in (("mass", mass), ("stiffness", stiffness)):
        check_positive_definite(f"the structure's block of {name} ({n} x {n})", matrix[:n, :n])
    lowest = lowest_eigenvalue(mass)
    if lowest < -EXACT:
        raise InputError(
            f"mass is not positive semidefinite: its lowest eigenvalue is {lowest:.3g} of its diagonal; "
            "the base rows need M_00 >= M_S0' M_SS^-1 M_S0"
        )
    G = -scipy.linalg.cho_solve(scipy.linalg.cho_factor(stiffness[:n, :n]), stiffness[:n, n:])
    expected = G.T @ stiffness[:n, :n] @ G
    size = np.sqrt(np.abs(np.diag(expected)))
    # A base direction that strains nothing has no stiffness to compare with.
    allowed = 1e-6 * np.outer(size, size) + 1e-10 * np.max(np.abs(stiffness))
    residue = np.abs(stiffness[n:, n:] - expected)
    if np.any(residue > allowed):
        worst = 1e-6 * np.max(residue / allowed)
        raise InputError(
            f"stiffness does not let the base move as a rigid body: K_00 differs from G' K_SS G by {worst:.3g} "
            "(relative); K must have the null space [G; I] (are its last n_base rows those of the base?)"
        )
    return G
