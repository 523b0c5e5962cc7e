"""Ends of the entries of mass and stiffness over the modal-mass cone."""

import numpy as np
import pytest
from scipy.optimize import linprog

import sysid
from sysid import FullMass, KnownMass, LumpedMass, Measurement, SpectralStiffness, Structure
from sysid.assessment.determination import determine, intervals, open_masses
from sysid.assessment.modal_mass_cone import _cone, _known
from sysid.finding import cautions
from sysid.problem.problem import Problem

FREQ = np.linspace(1, 70, 60)


def problem_of(structure, mass, *, force=False, stiffness=None, test=None):
    test = sysid.simulate(structure, FREQ, force=force) if test is None else test
    return Problem(test, mass=mass, stiffness=stiffness or SpectralStiffness(structure.natural_frequencies))


def extremes(problem, structure):
    """Members at the lower and upper ends of each entry of M_SS, then of K_SS, (2, n, n, n, n)."""
    cone = _cone(
        problem.prepared, structure, _known(problem.prepared, structure, problem.measurement.residual(structure))
    )
    P = np.linalg.inv(structure.normal_modes)
    for rows in (P, P * 2 * np.pi * structure.natural_frequencies[:, None]):
        n, unit = structure.n, (rows / np.linalg.norm(rows, axis=0)).T
        C = unit[:, None, :, None] * unit[None, :, None, :]
        C = ((C + np.swapaxes(C, 2, 3)) / 2).reshape(-1, n, n)
        _, members = cone.largest(np.concatenate([-C, C]))
        yield members.reshape(2, n, n, n, n)


def answers_of(structure, T):
    """M_SS, K_SS, C and B of the member T of the cone."""
    P, omega = np.linalg.inv(structure.normal_modes), 2 * np.pi * structure.natural_frequencies
    loss = np.sqrt(2 * structure.damping_ratios * omega)
    M = P.T @ T @ P
    K = (P.T * omega) @ T @ (omega[:, None] * P)
    C = (P.T * loss) @ T @ (loss[:, None] * P)
    return M, K, C, P.T @ T @ structure.participation


def check_ends(problem, structure, *, freq=FREQ):
    """Truth inside, and every finite end the entry of a member that answers as the structure does; the intervals."""
    found = intervals(problem.prepared, structure, None)
    n = structure.n
    own, unit = (structure.mass[:n, :n], structure.stiffness[:n, :n]), answers_of(structure, np.eye(n))
    w = 2 * np.pi * freq[:, None, None]
    # Of the degrees of freedom: the sensors, or those that the sensors follow.
    answer = np.linalg.pinv(structure.recovery) @ np.moveaxis(structure.relative_acceleration(freq), -1, 0)
    for which, (ends, matrix, members) in enumerate(
        zip((found.mass, found.stiffness), own, extremes(problem, structure), strict=True)
    ):
        assert np.array_equal(ends, np.swapaxes(ends, 1, 2))
        assert np.all(ends[0] <= matrix) and np.all(ends[1] >= matrix)
        for side, i, j in np.ndindex(ends.shape):
            end = ends[side, i, j]
            if not np.isfinite(end):
                continue
            size = max(np.abs(ends[:, i, j][np.isfinite(ends[:, i, j])]).max(), 1e-9 * np.abs(matrix).max())
            M, K, C, B = answers_of(structure, members[side, i, j])
            assert abs((M, K)[which][i, j] - end) < 1e-6 * size
            # A modal mass of zero is the limit of small ones, so that M may be singular: what must hold is the
            # equation of motion of the measured accelerations.
            force = (-(w**2) * M + 1j * w * C + K) @ answer
            size = np.linalg.norm(w**2 * M @ answer) + np.linalg.norm(K @ answer)
            assert np.linalg.norm(force - w**2 * B) <= 1e-9 * size
            M, K, C, B = (m / 2 for m in map(sum, zip((M, K, C, B), unit, strict=True)))
            if i == j:
                a = np.linalg.solve(-(w**2) * M + 1j * w * C + K, w**2 * B)
                assert np.linalg.norm(a - answer) < 1e-9 * np.linalg.norm(answer)
    return found


def check_samples(structure, found, rng, *, draw, draws=300):
    """No random member is outside; `draw` gives T."""
    T, P = np.array([draw(rng) for _ in range(draws)]), np.linalg.inv(structure.normal_modes)
    for rows, ends in ((P, found.mass), (P * 2 * np.pi * structure.natural_frequencies[:, None], found.stiffness)):
        entries = rows.T @ T @ rows
        slack = 1e-7 * np.abs(entries).max(axis=(1, 2), keepdims=True)
        assert np.all(entries >= ends[0] - slack) and np.all(entries <= ends[1] + slack)


def diagonal(n, limits):
    """Random t >= 0 on the boundary of ``limits @ t <= 1``, many of them zero."""

    def draw(rng):
        t = rng.exponential(size=n) * (rng.random(n) < 0.5) + 1e-9
        return np.diag(t / (limits @ t).max())

    return draw


def weights(problem, structure):
    """Share of each unit of modal mass in each direction's stated total, (d, n): method.md, section 2, written out."""
    P, geometry = np.linalg.inv(structure.mode_shapes), problem.geometry
    push, totals = structure.participation, np.broadcast_to(problem.mass.total_mass, geometry.d)
    delta = push - P @ structure.rigid_body
    rows = []
    for i in range(geometry.d):
        if problem.mass.healing == "rigid_body":
            share = push[:, i] ** 2
        else:
            mine = [j for j in range(geometry.n) if geometry.directions[j] == i]
            share = np.sum(P[:, mine] ** 2, axis=1) + delta[:, i] ** 2
        rows.append(share / max(totals[i], share.sum()))
    return np.array(rows)


@pytest.fixture
def full(random_structure):
    return random_structure(np.random.default_rng(0), n=4, d=2)


@pytest.fixture
def lumped(random_case):
    return random_case(np.random.default_rng(0), "lumped", n=4, d=2)[0]


class TestIntervals:
    @pytest.mark.parametrize("healing", ["trace", "rigid_body"])
    def test_the_three_storey_building(self, healing):
        """Majcher 2025 with a full mass and its total, one inequality: the extremes are those of 0 and c_k b / a_k."""
        m, k = np.array([10.724, 10.134, 20.32]), 2100.0
        K = k * np.array([[2.0, -1, 0], [-1, 2, -1], [0, -1, 1]])
        K_S0 = -K @ np.ones((3, 1))
        full = np.block([[K, K_S0], [K_S0.T, np.array([[k]])]])
        M = np.diag([*m, 0.0])
        ratios = sysid.Structure(
            M, full, n_base=1, damping_matrix=0.077466 * np.diag(m) + 0.00094753 * K
        ).damping_ratios
        truth = Structure(M, full, ratios, n_base=1)
        lines = np.linspace(0.2, 6, 60)
        test = sysid.simulate(truth, lines)
        problem = problem_of(truth, FullMass(m.sum(), healing=healing), test=test)
        assert not determine(problem.prepared, truth, None).determined
        found = check_ends(problem, truth, freq=lines)
        assert np.all(np.isfinite(found.mass)) and np.all(np.isfinite(found.stiffness))
        P, w = np.linalg.inv(truth.mode_shapes), 2 * np.pi * truth.natural_frequencies
        push, delta = truth.participation[:, 0], truth.participation[:, 0] - P.sum(axis=1)
        a = push**2 if healing == "rigid_body" else np.sum(P**2, axis=1) + delta**2
        for rows, ends in ((P, found.mass), (P * w[:, None], found.stiffness)):
            for i, j in np.ndindex(3, 3):
                reach = rows[:, i] * rows[:, j] * m.sum() / a
                expected = [min(0.0, reach.min()), max(0.0, reach.max())]
                assert np.allclose(ends[:, i, j], expected, rtol=1e-9, atol=1e-9 * np.abs(reach).max())

    @pytest.mark.parametrize("healing", ["trace", "rigid_body"])
    @pytest.mark.parametrize(("n", "d"), [(2, 1), (3, 2), (5, 3)])
    def test_random_structures_with_totals(self, random_structure, n, d, healing):
        rng = np.random.default_rng(n)
        truth = random_structure(rng, n=n, d=d)
        totals = FullMass(healing=healing).total(problem_of(truth, FullMass()).geometry, truth.mass)
        for share in (1.0, 0.8):  # a stated total below what the structure has is not held against it
            problem = problem_of(truth, FullMass(share * totals, healing=healing))
            found = check_ends(problem, truth)
            limits = weights(problem, truth)
            check_samples(truth, found, rng, draw=diagonal(n, limits))
            p = np.linalg.inv(truth.mode_shapes)[:, [0, -1]].prod(axis=1)
            expected = [s * linprog(s * p, A_ub=limits, b_ub=np.ones(d)).fun for s in (1, -1)]
            assert np.allclose(found.mass[:, 0, -1], expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())

    @pytest.mark.parametrize("d", [2, 3])
    def test_a_known_rigid_body_mass_bounds_in_every_direction(self, random_structure, d):
        rng = np.random.default_rng(d)
        truth = random_structure(rng, n=4, d=d)
        problem = problem_of(truth, FullMass())
        object.__setattr__(problem, "mass", FullMass(truth.rigid_body_mass, healing="rigid_body"))
        found = check_ends(problem, truth)
        if d == 2:  # a scan over all directions of the base
            angle = np.linspace(0, np.pi, 1500, endpoint=False)
            u = np.array([np.cos(angle), np.sin(angle)])
            rows = (truth.participation @ u).T ** 2 / np.einsum("ia,ij,ja->a", u, truth.rigid_body_mass, u)[:, None]
            p = np.linalg.inv(truth.mode_shapes)[:, [0, 2]].prod(axis=1)
            expected = [s * linprog(s * p, A_ub=rows, b_ub=np.ones(len(rows))).fun for s in (1, -1)]
            assert np.allclose(found.mass[:, 0, 2], expected, rtol=1e-5)

        def draw(rng):
            t = rng.exponential(size=4) * (rng.random(4) < 0.6) + 1e-9
            most = np.linalg.eigvals(
                np.linalg.solve(truth.rigid_body_mass, (truth.participation.T * t) @ truth.participation)
            )
            return np.diag(t / most.real.max())

        check_samples(truth, found, rng, draw=draw)
        # The whole matrix says more than its diagonal.
        wide = intervals(
            problem_of(truth, FullMass(np.diag(truth.rigid_body_mass), healing="rigid_body")).prepared, truth, None
        )
        assert np.all(wide.mass[1] >= found.mass[1] * (1 - 1e-7)) and np.any(wide.mass[1] > 1.01 * found.mass[1])

    def test_without_a_unit_of_mass_ends_are_zero_or_infinite(self, random_structure):
        truth = random_structure(np.random.default_rng(1), n=4, d=2)
        found = check_ends(problem_of(truth, FullMass()), truth)
        P, w = np.linalg.inv(truth.mode_shapes), 2 * np.pi * truth.natural_frequencies
        for rows, ends in ((P, found.mass), (P * w[:, None], found.stiffness)):
            assert np.all(np.isinf(ends) | (ends == 0))
            for side, i, j in np.ndindex(ends.shape):
                if np.isinf(ends[side, i, j]):  # a member with a million times the entry
                    t = np.ones(4)
                    parts = rows[:, i] * rows[:, j] * (1 if side else -1)
                    t[np.argmax(parts)] = 1e6 * (2 + np.abs(parts).sum() / parts.max())
                    assert parts @ t > 1e6 * abs(parts.sum())
                    assert ends[side, i, j] == (np.inf if side else -np.inf)
        assert np.all(found.mass[0].diagonal() == 0) and np.all(np.isinf(found.mass[1].diagonal()))

    def test_what_is_closed_is_one_model(self, full, lumped):
        for truth, problem in (
            (full, problem_of(full, FullMass(), force=True)),
            (full, problem_of(full, KnownMass(full.mass))),
            (lumped, problem_of(lumped, LumpedMass([np.diag(lumped.mass)[:4][i::2].sum() for i in range(2)]))),
        ):
            found = intervals(problem.prepared, truth, None)
            assert determine(problem.prepared, truth, None).determined
            assert np.array_equal(found.mass, [truth.mass[:4, :4]] * 2)
            assert np.array_equal(found.stiffness, [truth.stiffness[:4, :4]] * 2)

    def test_a_lumped_mass_without_its_total_keeps_its_zeros(self, lumped):
        found = check_ends(problem_of(lumped, LumpedMass()), lumped)
        same = np.eye(4, dtype=bool)
        assert np.all(found.mass[0] == np.where(same, 0, lumped.mass[:4, :4]))
        assert np.all(found.mass[1][same] == np.inf) and np.all(found.mass[1][~same] == lumped.mass[:4, :4][~same])
        K = lumped.stiffness[:4, :4]
        assert np.all(found.stiffness[1] == np.where(K > 0, np.inf, 0.0))
        assert np.all(found.stiffness[0] == np.where(K > 0, 0.0, -np.inf))

    def test_a_symmetric_building_keeps_its_two_directions_apart(self):
        """One chain along x, the same along y: pairs of poles, and an open scale a direction for a lumped mass."""
        K_SS = np.kron(1e4 * np.array([[5.0, -2], [-2, 2]]), np.eye(2))
        G = np.tile(np.eye(2), (2, 1))
        K = np.block([[K_SS, -K_SS @ G], [-(K_SS @ G).T, G.T @ K_SS @ G]])
        truth = Structure(np.diag([2.0, 2, 1, 1, 0, 0]), K, np.full(4, 0.01), n_base=2)
        found = check_ends(problem_of(truth, LumpedMass()), truth)
        assert np.array_equal(np.isinf(found.mass[1]), np.eye(4, dtype=bool))
        assert np.all(np.abs(found.mass[0]) < 1e-9)
        coupled = np.kron(np.ones((2, 2)), np.eye(2)) > 0
        assert np.array_equal(np.isinf(found.stiffness).any(axis=0), coupled)
        assert np.abs(found.stiffness[:, ~coupled]).max() < 1e-6 * np.abs(K).max()
        # A full mass with totals is bounded, and may couple the modes at one pole.
        totals = check_ends(problem_of(truth, FullMass(3.0)), truth)
        assert np.all(np.isfinite(totals.mass)) and totals.mass[1, 0, 1] > 0.1
        for word in ("force", "model"):
            mass, force = (FullMass(), True) if word == "force" else (LumpedMass(3.0), False)
            closed = intervals(problem_of(truth, mass, force=force).prepared, truth, None)
            assert np.array_equal(closed.mass, [truth.mass[:4, :4]] * 2)

    @pytest.mark.parametrize("seed", range(2))
    def test_a_chain_with_a_full_mass_moves_along_one_ray(self, random_case, seed):
        """Zeros of the stiffness leave one scale, the total ends it."""
        truth, problem = random_case(np.random.default_rng(seed), "trace", "chain", n=4, d=1)
        found = check_ends(problem, truth)
        M, K = truth.mass[:4, :4], truth.stiffness[:4, :4]
        reach = 1 / weights(problem, truth).sum(axis=1).max()
        for own, ends in ((M, found.mass), (K, found.stiffness)):
            assert np.allclose(ends[0], np.minimum(0, reach * own), atol=1e-7 * np.abs(own).max())
            assert np.allclose(ends[1], np.maximum(0, reach * own), atol=1e-7 * np.abs(own).max(), rtol=1e-7)

    @pytest.mark.parametrize("seed", range(3))
    def test_a_chain_with_lumped_masses_and_no_unit_of_mass_is_a_ray(self, random_case, seed):
        truth, problem = random_case(np.random.default_rng(seed), "lumped", "chain", n=5, d=1, total=False)
        found = check_ends(problem, truth)
        for own, ends in ((truth.mass[:5, :5], found.mass), (truth.stiffness[:5, :5], found.stiffness)):
            size = np.sqrt(np.outer(np.diag(own), np.diag(own)))
            zero = np.abs(own) < 1e-9 * size
            assert np.all(np.abs(ends[:, zero]) < 1e-9 * size[zero])
            assert np.array_equal(ends[0][~zero], np.where(own[~zero] > 0, 0, -np.inf))
            assert np.array_equal(ends[1][~zero], np.where(own[~zero] > 0, np.inf, 0))

    @pytest.mark.parametrize("total", [None, 4.0])
    def test_a_mode_that_the_base_does_not_move(self, total):
        """Two equal masses on equal springs: the force weighs the mode in phase, a total ends the other."""
        k, c = 1e4, 3e3
        K_SS = np.array([[k + c, -c], [-c, k + c]])
        G = np.ones((2, 1))
        K = np.block([[K_SS, -K_SS @ G], [-(K_SS @ G).T, G.T @ K_SS @ G]])
        truth = Structure(np.diag([1.0, 1.0, 0.5]), K, [0.01, 0.02], n_base=1)
        problem = problem_of(truth, FullMass(total), force=True)
        assert open_masses(problem.prepared, truth) == [1]
        second = f"mode 2 ({np.sqrt(k + 2 * c) / (2 * np.pi):.4g} Hz)"
        assert any(second in sentence for sentence in determine(problem.prepared, truth, None).undetermined)
        found = check_ends(problem, truth)
        # M = [[1 + t, 1 - t], [1 - t, 1 + t]] / 2 with t >= 0, and 1 + t <= total.
        most = np.inf if total is None else total - 1
        assert np.allclose(found.mass[:, 0, 0], [0.5, (1 + most) / 2])
        assert np.allclose(found.mass[:, 0, 1], [(1 - most) / 2, 0.5])

    def test_a_mode_that_the_noise_hides_from_the_force_is_held_by_the_rigid_body_mass(self, random_blocks):
        """Mode 2 makes less of the force than the noise, so it is not weighed; the rest of M_rb ends it."""
        M, K, _ = random_blocks(np.random.default_rng(2), 3, 2)
        truth = Structure(M, K, [0.01, 0.02, 0.015], n_base=2)
        phi, push = truth.mode_shapes, truth.participation.copy()
        push[1] *= 0.01
        P, G = np.linalg.inv(phi), truth.rigid_body
        M_S0 = P.T @ push - truth.mass[:3, :3] @ G
        M_00 = M_S0.T @ np.linalg.solve(truth.mass[:3, :3], M_S0) + np.array([[0.4, 0.1], [0.1, 0.3]])
        weak = Structure(
            np.block([[truth.mass[:3, :3], M_S0], [M_S0.T, M_00]]), truth.stiffness, truth.damping_ratios, n_base=2
        )
        clean, noisy = (sysid.simulate(weak, FREQ, force=True, noise=noise, rng=0) for noise in (0.0, 0.05))
        test = Measurement(FREQ, clean.base, clean.response, rigid_body=weak.rigid_body, force=noisy.force)
        problem = problem_of(weak, FullMass(), test=test)
        verdict = determine(problem.prepared, weak, None)
        assert any(s.startswith("the modal mass of mode 2") for s in verdict.undetermined)
        found = check_ends(problem, weak)
        rest = weak.rigid_body_mass - weak.effective_masses[[0, 2]].sum(axis=0)
        most = 1 / (push[1] @ np.linalg.solve(rest, push[1]))
        P = np.linalg.inv(weak.mode_shapes)
        known = P[[0, 2], 0] @ P[[0, 2], 0]
        assert np.allclose(found.mass[:, 0, 0], [known, known + most * P[1, 0] ** 2], rtol=1e-6)

    def test_modes_at_one_pole_with_totals(self, random_blocks):
        """Without force their block of T is open: no random member is outside, and each end has a member."""
        rng = np.random.default_rng(0)
        M, K, _ = random_blocks(rng, 4, 2, frequencies=[10.0, 10.0, 25.0, 40.0])
        truth = Structure(M, K, [0.02, 0.02, 0.01, 0.01], n_base=2)
        totals = FullMass().total(problem_of(truth, FullMass()).geometry, truth.mass)
        problem = problem_of(truth, FullMass(totals))
        found = check_ends(problem, truth)
        P, groups = np.linalg.inv(truth.mode_shapes), problem.geometry.directions[:4]
        delta = truth.participation - P @ truth.rigid_body

        def draw(rng):
            T = np.diag(rng.exponential(size=4) * (rng.random(4) < 0.5) + 1e-9)
            x = rng.normal(size=(2, rng.integers(1, 3)))
            T[:2, :2] += x @ x.T
            size = [
                np.trace(P[:, groups == i].T @ T @ P[:, groups == i]) + delta[:, i] @ T @ delta[:, i] for i in (0, 1)
            ]
            return T / np.max(size / totals)

        check_samples(truth, found, rng, draw=draw)
        # Modes that are told apart by their damping have a smaller cone.
        apart = Structure(M, K, [0.02, 0.04, 0.01, 0.01], n_base=2)
        fewer = intervals(problem_of(apart, FullMass(totals)).prepared, apart, None)
        assert np.all(fewer.mass[1] <= found.mass[1] * (1 + 1e-7)) and np.any(fewer.mass[1] < 0.99 * found.mass[1])

    def test_modes_at_one_pole_with_a_force_in_one_direction(self, random_blocks):
        """One combination is weighed. The other weighs anything, coupled to the first as far as T >= 0 lets it."""
        rng = np.random.default_rng(1)
        M, K, _ = random_blocks(rng, 3, 1, frequencies=[10.0, 10.0, 25.0])
        truth = Structure(M, K, [0.02, 0.02, 0.01], n_base=1)
        found = check_ends(problem_of(truth, FullMass(), force=True), truth)
        gamma = truth.participation[:2, 0] / np.linalg.norm(truth.participation[:2, 0])
        turn = np.array([gamma, [-gamma[1], gamma[0]]])

        def draw(rng):
            x = rng.normal() * 3
            T = np.eye(3)
            T[:2, :2] = turn.T @ np.array([[1, x], [x, x**2 + rng.exponential() * (rng.random() < 0.5)]]) @ turn
            return T

        check_samples(truth, found, rng, draw=draw)
        assert np.all(np.isinf(found.mass[1].diagonal())) and np.all(found.mass[0].diagonal() > 0)
        one_finite = np.isfinite(found.mass).sum(axis=0)
        assert np.all(one_finite == 1)  # a single open direction: each entry grows one way only
        for side, i, j in np.ndindex(2, 3, 3):
            if np.isinf(found.mass[side, i, j]):
                T = np.eye(3)
                T[:2, :2] += 1e9 * np.outer(turn[1], turn[1])
                assert abs(answers_of(truth, T)[0][i, j]) > 1e6 * abs(truth.mass[i, j])

    @pytest.mark.parametrize("force", [False, True])
    def test_a_force_in_two_directions_closes_a_pair(self, random_blocks, force):
        M, K, _ = random_blocks(np.random.default_rng(0), 3, 2, frequencies=[10.0, 10.0, 25.0])
        truth = Structure(M, K, [0.02, 0.02, 0.01], n_base=2)
        found = check_ends(problem_of(truth, FullMass(), force=force), truth)
        assert np.array_equal(found.mass, [truth.mass[:3, :3]] * 2) is force
        assert np.any(np.isinf(found.mass)) is not force

    def test_other_sensors_than_degrees_of_freedom(self, random_blocks):
        """Four sensors, three modes: those of the degrees of freedom are fixed; no sum over sensors bounds them."""
        rng = np.random.default_rng(4)
        M, K, G = random_blocks(rng, 3, 2)
        R = np.vstack([np.eye(3), rng.normal(size=(1, 3))])
        truth = Structure(M, K, [0.01, 0.02, 0.015], n_base=2, recovery=R, rigid_body=R @ G)
        stiffness = SpectralStiffness(truth.natural_frequencies, max_frequency=100.0)
        weighed = problem_of(truth, FullMass(), force=True, stiffness=stiffness)
        verdict = determine(weighed.prepared, truth, None)
        assert verdict.determined and not cautions(verdict.findings)
        assert np.array_equal(intervals(weighed.prepared, truth, None).mass, [truth.mass[:3, :3]] * 2)
        stated = problem_of(truth, FullMass(9.0), stiffness=stiffness)
        assert np.any(np.isinf(intervals(stated.prepared, truth, None).mass))
        assert not determine(stated.prepared, truth, None).determined
        # What the physical total of each direction bounds is no matter of sensors.
        physical = problem_of(
            truth, FullMass(np.diag(truth.rigid_body_mass), healing="rigid_body"), stiffness=stiffness
        )
        assert np.all(np.isfinite(check_ends(physical, truth).mass))
