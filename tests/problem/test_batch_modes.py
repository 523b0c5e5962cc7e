"""Modes of many candidates at once are those of each candidate's structure."""

import numpy as np

import sysid
from sysid.problem.batch import batch_modes

N, D = 4, 2
G = np.array([[1.0, 0.0], [0.0, 1.0], [0.6, 0.8], [1.0, 0.0]])


def matrices(count):
    """M over sensors and base, and K_SS, of candidates that are structures."""
    rng = np.random.default_rng(0)
    of_mass = np.tril(rng.normal(size=(count, N + D, N + D))) + 2 * np.eye(N + D)
    of_stiffness = np.tril(rng.normal(size=(count, N, N))) + 3 * np.eye(N)
    half = of_mass[:, :N, :N] @ of_stiffness
    return of_mass @ of_mass.swapaxes(1, 2), half @ half.swapaxes(1, 2)


def parts(M, K):
    """Values of the expressions: H, [L^-1, L^-1 B], the rigid-body mass, L^-1 M_S0 and M_00."""
    L = np.linalg.cholesky(M[:, :N, :N])
    inverse = np.linalg.inv(L)
    rigid = np.vstack([G, np.eye(D)])
    B = M[:, :N, :N] @ G + M[:, :N, N:]
    return [
        inverse @ K @ inverse.swapaxes(1, 2), np.concatenate([inverse, inverse @ B], axis=2), rigid.T @ M @ rigid,
        inverse @ M[:, :N, N:], M[:, N:, N:],
    ]  # fmt: skip


def test_frequencies_residues_and_rigid_body_mass_are_those_of_the_structure():
    M, K = matrices(3)
    lam, modes = batch_modes(*parts(M, K))
    for i in range(3):
        whole = np.block([[K[i], -K[i] @ G], [-G.T @ K[i], G.T @ K[i] @ G]])
        structure = sysid.Structure(M[i], whole, np.full(N, 0.01), n_base=D)
        np.testing.assert_allclose(np.sqrt(lam[i]), 2 * np.pi * structure.natural_frequencies, rtol=1e-10)
        made = np.einsum("kc,kd->kcd", modes.shapes[i], modes.loads[i])
        expected = np.einsum("ck,kd->kcd", structure.normal_modes, structure.participation)
        np.testing.assert_allclose(made, expected, atol=1e-10)
        np.testing.assert_allclose(modes.rigid_body_mass[i], structure.rigid_body_mass, rtol=1e-10, atol=1e-10)


def test_a_candidate_that_is_no_number_or_has_too_light_a_base_leaves_the_others_alone():
    M, K = matrices(4)
    lam, expected = batch_modes(*parts(M, K))
    H, *others = parts(M, K)
    H[1, 2, 0] = np.nan
    others[-1][2] *= 0.0
    found, modes = batch_modes(H, *others)
    for made, right in ((found, lam), (modes.shapes, expected.shapes), (modes.loads, expected.loads)):
        assert np.all(np.isnan(made[1:3]))
        np.testing.assert_array_equal(made[[0, 3]], right[[0, 3]])
