"""First derivatives by the unknowns, against central differences of the structures themselves."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.measurement.whole import NoiseLevels
from sysid.modal_analysis.modal_estimate import Gains, ModalEstimate
from sysid.problem.direct_response import response_slopes, rows_of_test, slopes_of

FREQ = np.linspace(1.0, 14.0, 12)
G = np.array([[1.0, 0.3], [1.0, 0.8], [0.9, -0.4]])
COUPLING = np.array([[0.2, 0.1], [0, 0.3], [0.1, 0]])


def shaken(rng, d, n, *, force=True):
    """Two runs with random base motion in all directions, and random records with noise stated channel by channel."""
    draw = lambda *size: rng.normal(size=size) + 1j * rng.normal(size=size)  # noqa: E731
    noise = rng.uniform(0.5, 2, (1, n, 1)) * rng.uniform(0.5, 2, (2, 1, FREQ.size))
    options = {"force": draw(2, d, FREQ.size), "force_std": rng.uniform(1, 3, (1, d, 1)) * np.ones(FREQ.size)}
    return sysid.Measurement(
        FREQ, draw(2, d, FREQ.size), draw(2, n, FREQ.size), rigid_body=G[:n, :d], base_axes=["x", "ry"][:d],
        response_std=noise, **(options if force else {}),
    )  # fmt: skip


def written(rng, damping):
    """All entries of the mass and of the stiffness move with six unknowns, base rows too."""
    m = sysid.Variable("m", 3, lower=1, upper=9)
    k = sysid.Variable("k", 3, lower=100, upper=9e3)
    c = sysid.Variable("c", 3, lower=0.001, upper=50)
    M = ca.blockcat(
        [[ca.diag(m) + 0.1 * m[0], m[1] * COUPLING], [m[1] * COUPLING.T, ca.diag(ca.vertcat(m[2], 2 * m[1]))]]
    )
    K = ca.diag(k) + 0.2 * k[1] * np.ones((3, 3))
    C = {
        "matrix": ca.diag(c) + 1e-3 * K + 0.3 * c[0] * np.ones((3, 3)), "ratios": 1e-3 * c * m, "numbers": np.eye(3)
    }[damping]  # fmt: skip
    at = [rng.uniform(2, 4, 3), rng.uniform(800, 4000, 3)] + ([] if damping == "numbers" else [rng.uniform(5, 10, 3)])
    return {"mass": M, "stiffness": K, "damping": C}, np.concatenate(at)


def models(rng, damping):
    """Full mass and stiffness, damping by ratios that are unknowns or that follow the frequency."""
    L = rng.uniform(-0.3, 0.3, (5, 5)) + np.eye(5)
    H = rng.uniform(-5, 5, (3, 3)) + np.diag([20.0, 35, 60])
    of_modes = {
        "modal": (sysid.ModalDamping(0.001, 0.2), rng.uniform(0.01, 0.05, 3)),
        "proportional": (sysid.ProportionalDamping((0, 5), (0, 1e-2)), [1.3, 4e-4]),
    }[damping]
    given = {
        "mass": sysid.FullMass([20.0, 9.0], healing="rigid_body"), "stiffness": sysid.SpectralStiffness([4.0, 6.0, 9.0])
    }  # fmt: skip
    return given | {"damping": of_modes[0]}, np.concatenate([L[np.tril_indices(5)], H[np.tril_indices(3)], of_modes[1]])


def mixed(rng, damping):
    """A lumped mass with written springs, on degrees of freedom that two sensors combine."""
    k = sysid.Variable("k", 3, lower=100, upper=9e3)
    K = ca.diag(k) + ca.diag(ca.vertcat(k[1:], 0)) - 0.5 * (np.eye(3, k=1) + np.eye(3, k=-1)) * k[1]
    given = {"mass": sysid.LumpedMass(9.0), "stiffness": K, "recovery": [[1, 0, 0], [0.2, 0.3, 0.5]]}
    given |= {"rigid_body_dofs": np.linalg.lstsq(np.array(given["recovery"]), G[:2, :1], rcond=None)[0]}
    damped, at = {
        "modal": (sysid.ModalDamping(0.001, 0.2), rng.uniform(0.01, 0.05, 3)),
        "proportional": (sysid.ProportionalDamping((0, 5), (0, 1e-2)), [1.3, 4e-4]),
    }[damping]
    return given | {"damping": damped}, np.concatenate([rng.uniform(0.3, 0.9, 3), at, rng.uniform(800, 4000, 3)])


KINDS = [
    (written, "matrix"), (written, "ratios"), (written, "numbers"), (models, "modal"), (models, "proportional"),
    (mixed, "modal"), (mixed, "proportional"),
]  # fmt: skip
kinds = pytest.mark.parametrize(("kind", "damping"), KINDS, ids=lambda v: getattr(v, "__name__", v))


def case(kind, damping, **options):
    rng = np.random.default_rng([len(damping), KINDS.index((kind, damping))])
    given, x = kind(rng, damping)
    n, d = (2, 1) if "recovery" in given else (3, 2)
    return sysid.Problem(shaken(rng, d, n, **options), **given), x


def differences(function, x, *, step=1e-3):
    """Derivatives of arrays by central differences of sixth order, x last."""
    weights = {-3: -1, -2: 9, -1: -45, 1: 45, 2: -9, 3: 1}
    columns = []
    for i, size in enumerate(np.abs(x)):
        h = step * max(size, 0.1 * np.abs(x).min())
        at = {k: function(x + k * h * np.eye(x.size)[i]) for k in weights}
        columns.append([sum(w * at[k][j] for k, w in weights.items()) / (60 * h) for j in range(len(at[1]))])
    return [np.stack(parts, axis=-1) for parts in zip(*columns, strict=True)]


def close(made, expected, x, name):
    """Alike for a relative change of each unknown."""
    made, expected = made * np.abs(x), expected * np.abs(x)
    np.testing.assert_allclose(made, expected, atol=2e-8 * np.abs(expected).max() + 1e-12, rtol=1e-7, err_msg=name)


@kinds
def test_of_matrices_and_modes(kind, damping):
    problem, x = case(kind, damping)
    made, n = slopes_of(problem.formulation.matrices, x, problem.measurement), 3

    def of(x):
        s = problem.structure(x)
        M, push = s.mass[:n, :n], s.mass[:n, :n] @ s.rigid_body_dofs + s.mass[:n, n:]
        logs = np.log(2 * np.pi * s.natural_frequencies), np.log(s.damping_ratios)
        return [M, s.stiffness[:n, :n], s.damping, push, s.rigid_body_mass, s.normal_modes, *logs, s.participation]

    names = ("mass", "stiffness", "damping", "d_push", "d_rigid", "d_shapes", "d_log_omega", "d_log_ratios")
    for name, expected in zip((*names, "d_participation"), differences(of, x), strict=True):
        close(getattr(made, name), expected, x, name)
    np.testing.assert_allclose(made.push, of(x)[3], rtol=1e-12)


@kinds
def test_of_responses(kind, damping):
    problem, x = case(kind, damping)
    X, dX = response_slopes(slopes_of(problem.formulation.matrices, x, problem.measurement), FREQ)

    def relative(x):
        s = problem.structure(x)
        M, C, K = s.mass[:3, :3], s.damping, s.stiffness[:3, :3]
        push = M @ s.rigid_body_dofs + s.mass[:3, 3:]
        w = 2 * np.pi * FREQ[:, None, None]
        return [np.linalg.solve(-(w**2) * M + 1j * w * C + K, w**2 * push)]

    np.testing.assert_allclose(X, relative(x)[0], rtol=1e-9)
    close(dX, differences(relative, x)[0], x, "responses")


def misfits(test, structure):
    """Predicted less measured, in units of the stated noise and of the size of the accelerations so weighed."""
    side_by_side = lambda record: np.concatenate(list(record), axis=1).ravel()  # noqa: E731
    scale = np.linalg.norm(test.relative / test.response_std)
    parts = [side_by_side((test.predict(structure) - test.relative) / test.response_std) / scale]
    if test.force is not None:
        parts.append(side_by_side((test.predict_force(structure) - test.force) / test.force_std) / scale)
    return np.concatenate([half for part in parts for half in (part.real, part.imag)]), scale


@kinds
@pytest.mark.parametrize("force", [False, True])
def test_of_the_rows_of_a_test(kind, damping, force):
    problem, x = case(kind, damping, force=force)
    test, term = problem.measurement, problem.formulation.own_test
    rows = term.linearised(x, as_stated=True)
    left, scale = misfits(test, problem.structure(x))
    np.testing.assert_allclose(rows.residuals, left, rtol=1e-8, atol=1e-12)
    close(rows.jacobian, differences(lambda x: [misfits(test, problem.structure(x))[0]], x)[0], x, "rows")
    # Each real number of complex noise has half its variance.
    np.testing.assert_allclose(rows.std, 1 / (np.sqrt(2) * scale), rtol=1e-9)
    assert term.error(x) == pytest.approx(np.linalg.norm(left), rel=1e-9)
    # These records are no structure's: their noise counts as large as the misfit shows it, the same for all.
    inflated = term.linearised(x).std / rows.std
    np.testing.assert_allclose(inflated, inflated[0], rtol=1e-9)
    assert inflated[0] > 1


def test_modes_of_one_frequency_keep_their_mass():
    """Two equal oscillators: a mass on both moves their shapes by their normalisation only, whatever the pair is."""
    m = sysid.Variable("m", lower=0.5, upper=2.0)
    test = sysid.Measurement(FREQ, np.ones((1, 1, 12)), np.ones((1, 2, 12)) * 3, rigid_body=np.ones((2, 1)))
    problem = sysid.Problem(test, mass=m * np.eye(2), stiffness=100 * np.eye(2), damping=[0.01, 0.01])
    made = slopes_of(problem.formulation.matrices, np.array([1.25]), test)
    shapes = made.structure.normal_modes
    np.testing.assert_allclose(made.d_shapes[..., 0], -shapes / (2 * 1.25), rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(made.d_log_omega, -1 / (2 * 1.25), rtol=1e-12)


WHOLE = [0, 2]  # modes of the structure that whole records show


def with_modes_of_records(test, structure, rng):
    """The test with an estimate of two of the structure's three modes, nearly right, in scales of their own.

    With a force a mode's sign alone is open.
    """
    n, d, m = test.n_sensors, test.n_base, len(WHOLE)
    scale = np.array([-1.0, 1.0]) if test.force is not None else np.array([-2.5, 0.4])
    near = lambda a: a * (1 + 0.05 * rng.normal(size=a.shape))  # noqa: E731
    size = n * m + m * d + 2 * m + d * (d + 1) // 2
    root = rng.normal(size=(size + 5, size))
    if test.force is None:
        root[:, n * m + m * d + 2 * m :] = 0.0  # nothing tells of the rigid-body mass
    return ModalEstimate(
        test, test,
        near(structure.mode_shapes[:, WHOLE] * scale), near(structure.participation[WHOLE] / scale[:, None]),
        near(2 * np.pi * structure.natural_frequencies[WHOLE]), near(structure.damping_ratios[WHOLE]),
        structure.rigid_body_mass * 1.03, root.T @ root, NoiseLevels(np.ones(n), np.ones(d), np.ones(d)), 1.0,
        np.ones(test.n_runs), Gains(np.zeros(n), np.ones(n), 100, np.zeros((size, n)), np.zeros((n, d)), np.zeros(n)),
    )  # fmt: skip


def off_the_modes(own, structure):
    """Modal parameters of a structure less those of the records, in the scale of these where no force gives one."""
    test = own.records
    phi, gamma = structure.mode_shapes[:, WHOLE], structure.participation[WHOLE]
    scale = np.sum(gamma * own.gamma, axis=1) / np.sum(own.gamma**2, axis=1)
    if test.force is not None:
        scale = scale / np.abs(scale)
    upper = np.triu_indices(test.n_base)
    return np.concatenate([
        (phi * scale - own.phi).ravel(), (gamma / scale[:, None] - own.gamma).ravel(),
        np.log(2 * np.pi * structure.natural_frequencies[WHOLE] / own.omega),
        np.log(structure.damping_ratios[WHOLE] / own.ratios), (structure.rigid_body_mass - own.rigid)[upper],
    ])  # fmt: skip


@pytest.mark.parametrize(("kind", "damping"), [(models, "modal"), (mixed, "modal")], ids=["models", "mixed"])
@pytest.mark.parametrize("force", [False, True])
def test_rows_of_whole_records_are_those_of_their_modes(kind, damping, force):
    """Products of the rows and of their derivatives are those of the modal parameters' information."""
    problem, x = case(kind, damping, force=force)
    modal = with_modes_of_records(problem.measurement, problem.structure(x), np.random.default_rng(3))
    test = modal.records
    slopes = slopes_of(problem.formulation.matrices, x, test)
    (rows,) = rows_of_test(modal, slopes, x.size, problem.formulation.matrices.beyond, share=0.7, as_stated=True)
    off = lambda x: off_the_modes(modal, problem.structure(x))  # noqa: E731
    expected = np.column_stack([off(x), differences(lambda x: [off(x)], x)[0] * np.abs(x)])
    made = np.column_stack([rows.residuals, rows.jacobian * np.abs(x)])
    weight = 0.7 / np.linalg.norm(test.relative / test.response_std)
    gram = weight**2 * expected.T @ modal.information @ expected
    np.testing.assert_allclose(made.T @ made, gram, atol=1e-7 * np.abs(gram).max())
    np.testing.assert_allclose(rows.std, weight / np.sqrt(2), rtol=1e-9)


@pytest.mark.parametrize("times", [1.0, 3.0])
def test_deviations_of_whole_records_grow_with_what_is_left_beyond_the_stated_noise(times):
    """White noise `times` as large as is stated: deviations grow by as much, but for chance."""
    problem, x = case(models, "modal")
    structure, rng = problem.structure(x), np.random.default_rng(4)
    freq = np.linspace(1.0, 14.0, 600)
    draw = lambda *size: (rng.normal(size=size) + 1j * rng.normal(size=size)) / np.sqrt(2)  # noqa: E731
    shapes = (1, 2, freq.size), (1, 3, freq.size)
    noise = {"response_std": np.full(shapes[1], 0.01), "force_std": np.full(shapes[0], 0.2)}
    base = draw(*shapes[0])
    test = sysid.Measurement(
        freq, base, draw(*shapes[1]), rigid_body=G, base_axes=["x", "ry"], force=draw(*shapes[0]), **noise
    )  # records in the place of those of the structure, which follow
    relative = test.predict(structure) + times * 0.01 * draw(*shapes[1])
    force = test.predict_force(structure) + times * 0.2 * draw(*shapes[0])
    test = replace(test, response=relative + np.einsum("sd,rdf->rsf", G, base), force=force)
    modal = with_modes_of_records(test, structure, rng)
    slopes = slopes_of(problem.formulation.matrices, x, test)
    none = problem.formulation.matrices.beyond
    (found,), (stated,) = (rows_of_test(modal, slopes, 1, none, as_stated=flag) for flag in (False, True))
    np.testing.assert_allclose(found.std / stated.std, times, rtol=0.08)
