r"""Cramér-Rao bound of a test of a structure with modes beyond the lines, at the true structure.

Unknown are the modes in the lines, some poles above them, the static residuals of all other modes, and the rigid-body
mass; of records also two numbers a pole and run for the motion at their end (`Draw.ends`):

.. math:: a = G u_0'' + w^2 E_1 u_0'' + \sum_k \phi_k A_k, \qquad
    f_0 = M_{rb} u_0'' + w^2 D_1 u_0'' + \sum_k \gamma_k' A_k, \qquad
    A_k = \frac{w^2 \gamma_k u_0'' + \alpha_k + i w \beta_k}{w_k^2 - w^2 + 2 i \zeta_k w_k w}.

With circular noise of covariance S a line, of which that of the base is a part (its true motion is unknown too and
eliminated), the information is ``2 Re(J^H S^-1 J)`` (Kay, Fundamentals of Statistical Signal Processing, vol. 1,
section 15.7). Derivatives J are written out; those of what follows from the unknowns are complex steps (Squire and
Trapp, SIAM Review 40 (1998) 110-112). As many poles above the lines are taken as Akaike's criterion asks for: until
modes without one, beyond what the other unknowns make up for to first order, add less to chi² than a pole has unknowns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from benchmarks.band.simulated_tests import Draw, transfer
from benchmarks.band.structures import Continuous
from benchmarks.records.simulated import Modes

CHUNK = 1000  # lines whitened at once
STEP = 1e-30


@dataclass(frozen=True, eq=False)
class Bound:
    """True values in the band, and the least standard deviations that an unbiased estimate can have.

    Attributes
    ----------
    values, std : dict
        "natural_frequencies" (m,), Hz, "damping_ratios" (m,), "effective_masses" (m, d, d), "mode_shapes" (m, sensors)
        of the sensors `dofs`; where these are m also "mass" and "stiffness" (m, m) on them.
    dofs : (m,)
        Sensors by pivoted QR of the shapes; all of them where there are fewer than modes.
    poles : int
        Above the lines, that are unknown too.
    """

    values: dict[str, np.ndarray]
    std: dict[str, np.ndarray]
    dofs: np.ndarray
    poles: int

    @property
    def of_mass(self) -> float:
        """Largest deviation of an entry of M over the root of its two diagonal entries; infinite without M."""
        if "mass" not in self.std:
            return np.inf
        size = np.sqrt(np.diag(self.values["mass"]))
        return float(np.max(self.std["mass"] / np.outer(size, size)))


@dataclass(frozen=True)
class Layout:
    """Places of the unknowns: Phi row by row, E_1 row by row, then what all channels share.

    Attributes
    ----------
    sensors, modes, d, runs : int
        `modes` counts the poles above the lines too; `runs` those with motion at their ends.
    """

    sensors: int
    modes: int
    d: int
    runs: int

    @property
    def ends(self) -> np.ndarray:
        """Ends of Phi, E_1, Gamma, log w, log zeta, M_rb and D_1 (upper triangles), motion at the ends of runs."""
        s, m, d, triangle = self.sensors, self.modes, self.d, self.d * (self.d + 1) // 2
        return np.cumsum([s * m, s * d, m * d, m, m, triangle, triangle, 2 * m * self.runs])

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return int(self.ends[-1])


def bound(structure: Continuous, draw: Draw) -> Bound:
    """Bound of one draw, with the poles above the lines that it asks for."""
    modes, d = structure.modes, len(structure.base)
    for poles in range(len(modes.omega) - structure.count):
        count = structure.count + poles
        layout = Layout(len(modes.shapes), count, d, len(draw.base) if np.any(draw.ends) else 0)
        known = information(modes, draw, layout)
        scale = np.sqrt(np.diag(known)[:-1])
        inverse = np.linalg.inv(known[:-1, :-1] / np.outer(scale, scale))
        across = known[-1, :-1] / scale
        left = float(known[-1, -1] - across @ inverse @ across)
        if left < layout.sensors + d + 2:
            break
    return _of_quantities(structure, layout, inverse / np.outer(scale, scale), poles)


def _of_quantities(structure: Continuous, layout: Layout, covariance: np.ndarray, poles: int) -> Bound:
    modes, m, d = structure.modes, structure.count, layout.d
    dofs = scipy.linalg.qr(modes.shapes[:, :m].T, mode="r", pivoting=True)[1][:m]
    ends, k = layout.ends, np.arange(m)
    at = np.concatenate([
        (dofs[:, None] * layout.modes + k).ravel(), ends[1] + np.arange(m * d), ends[2] + k, ends[3] + k,
    ])  # fmt: skip
    theta = np.concatenate([
        modes.shapes[dofs, :m].ravel(), modes.gamma[:m].ravel(), np.log(modes.omega[:m]), np.log(modes.zeta[:m]),
    ])  # fmt: skip

    def quantities(x: np.ndarray) -> dict[str, np.ndarray]:
        phi, gamma, log_omega, log_zeta = np.split(x, np.cumsum([len(dofs) * m, m * d, m]))
        return in_band(np.exp(log_omega), np.exp(log_zeta), gamma.reshape(m, d), phi.reshape(-1, m))

    slopes = complex_steps(quantities, theta)
    part = covariance[np.ix_(at, at)]
    std = {name: np.sqrt(np.einsum("p...,pq,q...->...", J, part, J, optimize=True)) for name, J in slopes.items()}
    return Bound({name: value.real for name, value in quantities(theta).items()}, std, dofs, poles)


def in_band(omega: np.ndarray, zeta: np.ndarray, gamma: np.ndarray, phi: np.ndarray) -> dict[str, np.ndarray]:
    """What modes (m,), rad/s, are worth: participations (m, d), shapes (dofs, m); M and K where dofs are m.

    M = Phi^-T Phi^-1 and K = Phi^-T W² Phi^-1 (O'Callahan, Avitabile and Riemer, Proc. 7th IMAC, 1989: SEREP).
    """
    effective = np.einsum("ki,kj->kij", gamma, gamma)
    found = {"natural_frequencies": omega / (2 * np.pi), "damping_ratios": zeta, "effective_masses": effective}
    found["mode_shapes"] = phi.T
    if phi.shape[0] == phi.shape[1]:
        P = np.linalg.inv(phi)
        found |= {"mass": P.T @ P, "stiffness": (P.T * omega**2) @ P}
    return found


def complex_steps(function: Callable[[np.ndarray], dict[str, np.ndarray]], x: np.ndarray) -> dict[str, np.ndarray]:
    """Derivatives of real analytic functions, those by each unknown first."""
    steps = [function(x + 1j * STEP * unit) for unit in np.eye(x.size)]
    return {name: np.stack([step[name].imag for step in steps]) / STEP for name in steps[0]}


def information(modes: Modes, draw: Draw, layout: Layout) -> np.ndarray:
    """Information about the unknowns; last row and column: of what modes without a pole add to w² E_1 and w² D_1."""
    total = np.zeros((layout.size + 1, layout.size + 1))
    for run in range(len(draw.base)):
        for first in range(0, draw.omega.size, CHUNK):
            _add_lines(total, modes, draw, layout, run, slice(first, first + CHUNK))
    return total


def _add_lines(total: np.ndarray, modes: Modes, draw: Draw, layout: Layout, run: int, lines: slice) -> None:
    """Add the information of some lines of one run, channel by channel, less what noise of the base takes."""
    w = draw.omega[lines]
    own, noisy = draw.own_std[run], np.any(draw.base_std)
    h = np.concatenate(transfer(modes, w)) * draw.base_std[:, None]  # (channels, d, lines)
    seen = np.zeros((layout.size + 1, len(draw.base_std), w.size), dtype=complex) if noisy else None
    for channel, (at, J) in enumerate(derivatives(modes, draw, layout, run, lines)):
        weighted = J / own[channel] ** 2
        total[np.ix_(at, at)] += 2 * (J.view(float) @ weighted.view(float).T)
        if seen is not None:
            seen[at] += h[channel].conj() * weighted[:, None]
    if seen is not None:
        # Woodbury: S^-1 = D^-1 - D^-1 h (I + h^H D^-1 h)^-1 h^H D^-1
        inner = np.eye(len(draw.base_std)) + np.einsum("cif,c,cjf->fij", h.conj(), own**-2.0, h, optimize=True)
        whitened = np.linalg.solve(np.linalg.cholesky(inner), np.moveaxis(seen, -1, 0).swapaxes(1, 2))
        flat = whitened.reshape(-1, layout.size + 1)
        parts = np.concatenate([flat.real, flat.imag])  # products of real numbers take an eighth of the time
        total -= 2 * (parts.T @ parts)


def derivatives(
    modes: Modes, draw: Draw, layout: Layout, run: int, lines: slice
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Of the spectra of each channel: the numbers of the unknowns that it depends on, and its derivatives by them."""
    w, U = draw.omega[lines], draw.base[run][:, lines]
    s, m, d = layout.sensors, layout.modes, layout.d
    ends = layout.ends
    omega, zeta = modes.omega[:, None], modes.zeta[:, None]
    den = omega**2 - w**2 + 2j * zeta * omega * w
    push = w**2 * (modes.gamma @ U)
    A = (push[:m] + draw.ends[run, :m] @ np.array([np.ones(w.size), 1j * w])) / den[:m]
    loss = 2j * zeta[:m] * omega[:m] * w
    by_gamma = (w**2 / den[:m])[:, None] * U
    shared = [by_gamma.reshape(m * d, -1), -A * (2 * omega[:m] ** 2 + loss) / den[:m], -A * loss / den[:m]]
    places, owners = [np.arange(ends[1], ends[4])], [np.repeat(np.arange(m), d), np.arange(m), np.arange(m)]
    if layout.runs:
        shared += [omega[:m] / den[:m], 1j * w / den[:m]]
        places.append(ends[6] + 2 * m * run + np.arange(2 * m))
        owners += [np.arange(m), np.arange(m)]
    common, place, owner = np.concatenate(shared), np.concatenate(places), np.concatenate(owners)
    rest = push[m:] * (1 / den[m:] - 1 / omega[m:] ** 2)
    static = w**2 * U
    found = []
    for i in range(s):
        at = np.concatenate([i * m + np.arange(m), ends[0] + i * d + np.arange(d), place, [layout.size]])
        J = np.concatenate([A, static, modes.shapes[i, owner][:, None] * common, (modes.shapes[i, m:] @ rest)[None]])
        found.append((at, J))
    rows, columns = np.triu_indices(d)
    for e in range(d):
        J = modes.gamma[owner, e][:, None] * common
        J[np.arange(m) * d + e] += A  # a participation moves its mode, and passes its force on
        # An entry of a triangle stands for both halves.
        other = np.where(rows == e, columns, rows)
        mine = ((rows == e) | (columns == e))[:, None]
        at = np.concatenate([place, np.arange(ends[4], ends[6]), [layout.size]])
        tail = (modes.gamma[m:, e] @ rest)[None]
        found.append((at, np.concatenate([J, mine * U[other], mine * static[other], tail])))
    return found
