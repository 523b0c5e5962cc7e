r"""Cramér-Rao bound of a base-shake test with base force, at the true structure.

Nothing of the identification is used: the unknowns are the modal model's, theta = (Phi, Gamma, log w, log zeta, M_rb),
and the Jacobian of

.. math:: a = \sum_k \phi_k g_k \gamma_k u_0'', \qquad f_0 = \Big(\sum_k \gamma_k' g_k \gamma_k + M_{rb}\Big) u_0''

is written out column by column. With circular noise of ``E|e|² = std²`` the information is ``2 / std² Re(J^H J)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import sysid


@dataclass(frozen=True, eq=False)
class CramerRao:
    """Least standard deviations that an unbiased estimate can have.

    Attributes
    ----------
    natural_frequencies : (n,)
        Hz.
    damping_ratios : (n,)
    mass, stiffness, damping : (n, n)
        Entries of M_SS, K_SS and C.
    effective_masses : (n, d, d)
    rigid_body_mass : (d, d)
    covariance : (p, p)
        Of theta: Phi row by row (n, n), Gamma row by row (n, d), log w, log zeta, the upper triangle of M_rb.
    """

    natural_frequencies: np.ndarray
    damping_ratios: np.ndarray
    mass: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    effective_masses: np.ndarray
    rigid_body_mass: np.ndarray
    covariance: np.ndarray


def cramer_rao(structure: sysid.Structure, test: sysid.Measurement) -> CramerRao:
    """Bound for `structure` in a test of it that holds the base force and one standard deviation a kind of record.

    Parameters
    ----------
    structure : sysid.Structure
        Its degrees of freedom are the sensors; modal damping.
    test : sysid.Measurement
        Its lines, base motion and standard deviations are used, its records are not.
    """
    information = fisher_information(structure, test)
    scale = np.sqrt(np.diag(information))  # participations and log w differ by many orders
    covariance = np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)
    covariance = (covariance + covariance.T) / 2
    n, d = structure.n, structure.n_base
    omega, zeta, Phi, Gamma = _modes(structure)
    at = _slices(n, d)
    P = np.linalg.inv(Phi)
    unit = np.eye(n)

    def std(jacobian: np.ndarray, part: slice) -> np.ndarray:
        """Standard deviations of quantities whose derivatives by the unknowns of `part` come last."""
        shape = jacobian.shape[:-1]
        flat = jacobian.reshape(-1, jacobian.shape[-1])
        return np.sqrt(np.einsum("ip,pq,iq->i", flat, covariance[part, part], flat)).reshape(shape)

    def congruence(middle: np.ndarray, by_log_w: np.ndarray, by_log_zeta: np.ndarray) -> np.ndarray:
        """Derivatives of ``P' diag(middle) P``: dP = -P dPhi P, and those of the diagonal by log w and log zeta."""
        A = (P.T * middle) @ P
        by_phi = -np.einsum("ka,jb->jkab", P, A)  # dA = -(P' dPhi' A) + its transpose
        by_phi = by_phi + np.swapaxes(by_phi, 2, 3)
        outer = np.einsum("ka,kb->kab", P, P)
        parts = [by_phi.reshape(n * n, n, n), np.zeros((n * d, n, n)), outer * by_log_w[:, None, None]]
        parts += [outer * by_log_zeta[:, None, None]]
        return np.moveaxis(np.concatenate(parts), 0, -1)

    modal = slice(0, at["zeta"].stop)
    loss = 2 * zeta * omega
    nothing = np.zeros(n)
    effective = np.einsum("kl,ia,kb->kabli", unit, np.eye(d), Gamma)
    effective = (effective + np.swapaxes(effective, 1, 2)).reshape(n, d, d, n * d)
    rigid = np.zeros((d, d))
    rigid[np.triu_indices(d)] = np.sqrt(np.diag(covariance)[at["rigid"]])
    return CramerRao(
        natural_frequencies=std(np.diag(omega / (2 * np.pi)), at["omega"]),
        damping_ratios=std(np.diag(zeta), at["zeta"]),
        mass=std(congruence(np.ones(n), nothing, nothing), modal),
        stiffness=std(congruence(omega**2, 2 * omega**2, nothing), modal),
        damping=std(congruence(loss, loss, loss), modal),
        effective_masses=std(effective, at["gamma"]),
        rigid_body_mass=np.maximum(rigid, rigid.T),
        covariance=covariance,
    )


def fisher_information(structure: sysid.Structure, test: sysid.Measurement) -> np.ndarray:
    """Information (p, p) about theta; the records of one sensor depend on its own row of Phi only."""
    assert test.force is not None and test.response_std is not None and test.force_std is not None
    n, d = structure.n, structure.n_base
    omega, zeta, Phi, Gamma = _modes(structure)
    at = _slices(n, d)
    w = 2 * np.pi * test.freq
    g = w**2 / (omega[:, None] ** 2 - w**2 + 2j * (zeta * omega)[:, None] * w)
    loss = 2j * (zeta * omega)[:, None] * w
    u = test.base  # (runs, d, lines)
    push = np.einsum("kj,rjf->krf", Gamma, u)
    # What each mode adds to a unit of phi_k, and its slopes.
    q = g[:, None] * push
    by_gamma = np.einsum("kf,rjf->kjrf", g, u).reshape(n * d, *u[:, 0].shape)
    by_omega = (-(g**2) / w**2 * (2 * omega[:, None] ** 2 + loss))[:, None] * push
    by_zeta = (-(g**2) / w**2 * loss)[:, None] * push
    shared = np.concatenate([by_gamma, by_omega, by_zeta]).reshape(n * d + 2 * n, -1)
    mode_of = np.concatenate([np.repeat(np.arange(n), d), np.arange(n), np.arange(n)])

    information = np.zeros((at["rigid"].stop, at["rigid"].stop))
    for i in range(n):
        own = np.arange(i * n, (i + 1) * n)
        where = np.concatenate([own, np.arange(at["gamma"].start, at["zeta"].stop)])
        J = np.concatenate([q.reshape(n, -1), Phi[i, mode_of][:, None] * shared])
        J = J / test.response_std[:, i].reshape(-1)
        information[np.ix_(where, where)] += 2 * (J.conj() @ J.T).real

    pairs = list(zip(*np.triu_indices(d), strict=True))
    for i in range(d):
        J = Gamma[mode_of, i][:, None] * shared
        # f_i holds gamma_ki twice: in the push, and as the mode's own share of the base force.
        J[np.arange(n) * d + i] += q.reshape(n, -1)
        rigid = np.zeros((len(pairs), u.shape[0], w.size), dtype=complex)
        for p, (a, b) in enumerate(pairs):
            if i in (a, b):
                rigid[p] = u[:, b if i == a else a]
        J = np.concatenate([J, rigid.reshape(len(pairs), -1)]) / test.force_std[:, i].reshape(-1)
        where = np.arange(at["gamma"].start, at["rigid"].stop)
        information[np.ix_(where, where)] += 2 * (J.conj() @ J.T).real
    return information


def _modes(structure: sysid.Structure) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    return (
        2 * np.pi * structure.natural_frequencies,
        structure.damping_ratios,
        structure.mode_shapes,
        structure.participation,
    )


def unknowns_of(structure: sysid.Structure, like: sysid.Structure) -> np.ndarray:
    """Theta of a structure, (p,), each mode with the sign that is nearer to that of the structure `like`."""
    omega, zeta, Phi, Gamma = _modes(structure)
    signs = np.where(np.sum(Phi * like.mode_shapes, axis=0) < 0, -1.0, 1.0)
    rigid = structure.rigid_body_mass[np.triu_indices(structure.n_base)]
    return np.concatenate([(Phi * signs).ravel(), (Gamma.T * signs).T.ravel(), np.log(omega), np.log(zeta), rigid])


def _slices(n: int, d: int) -> dict[str, slice]:
    """Where each kind of unknown stands in theta."""
    sizes = {"phi": n * n, "gamma": n * d, "omega": n, "zeta": n, "rigid": d * (d + 1) // 2}
    ends = np.cumsum(list(sizes.values()))
    return {name: slice(int(end - size), int(end)) for (name, size), end in zip(sizes.items(), ends, strict=True)}
