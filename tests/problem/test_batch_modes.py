"""Modes of many candidates at once are those of each candidate's structure."""

import numpy as np

import sysid
from sysid.problem.batch_modes import batch_modes

N, D = 4, 2
G = np.array([[1.0, 0.0], [0.0, 1.0], [0.6, 0.8], [1.0, 0.0]])


def factors(count):
    """Lower-triangular factors of M and of H."""
    rng = np.random.default_rng(0)
    of_mass = np.tril(rng.normal(size=(count, N + D, N + D))) + 2 * np.eye(N + D)
    return of_mass, np.tril(rng.normal(size=(count, N, N))) + 3 * np.eye(N)


def test_residues_and_rigid_body_mass_are_those_of_the_structure():
    of_mass, of_stiffness = factors(3)
    modes = batch_modes(np.moveaxis(of_mass, 0, -1), of_stiffness, G)
    for i, (L_M, L_H) in enumerate(zip(of_mass, of_stiffness, strict=True)):
        half = L_M[:N, :N] @ L_H
        K = half @ half.T
        structure = sysid.Structure(
            L_M @ L_M.T, np.block([[K, -K @ G], [-G.T @ K, G.T @ K @ G]]), np.full(N, 0.01), n_base=D
        )
        made = np.einsum("kc,kd->kcd", modes.shapes[i], modes.loads[i])
        expected = np.einsum("ck,kd->kcd", structure.normal_modes, structure.participation)
        np.testing.assert_allclose(made, expected, atol=1e-10)
        np.testing.assert_allclose(modes.rigid_body_mass[i], structure.rigid_body_mass, rtol=1e-10, atol=1e-10)


def test_a_candidate_that_is_no_number_leaves_the_others_alone():
    of_mass, of_stiffness = factors(3)
    expected = batch_modes(np.moveaxis(of_mass, 0, -1), of_stiffness, G)
    of_stiffness[1, 2, 0] = np.nan
    modes = batch_modes(np.moveaxis(of_mass, 0, -1), of_stiffness, G)
    assert np.all(np.isnan(modes.shapes[1])) and np.all(np.isnan(modes.loads[1]))
    np.testing.assert_array_equal(modes.shapes[[0, 2]], expected.shapes[[0, 2]])
    np.testing.assert_array_equal(modes.loads[[0, 2]], expected.loads[[0, 2]])
