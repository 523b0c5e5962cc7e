"""The bound of whole records, against derivatives of records that are simulated in time."""

import importlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def modules():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT))
        return [importlib.import_module(f"benchmarks.records.{name}") for name in ("simulated", "cramer_rao")]


@pytest.fixture(scope="module")
def case(modules):
    """A coupled structure and a run of many samples a period, so that what folds back is small."""
    simulated, _ = modules
    setting = next(s for s in map(simulated.coupled, range(50)) if s.structure.n_base == 2 and s.structure.n <= 5)
    setting = replace(
        setting, sample_rate=12 * setting.sample_rate, duration=15 / setting.structure.natural_frequencies[0]
    )
    rng = np.random.default_rng(0)
    run = setting.run(rng)
    return setting, run, setting.with_noise(run.records(), rng)[1]


def _spectra(record, run, band):
    freq = np.fft.rfftfreq(run.motion.samples, 1 / run.motion.sample_rate)
    return np.fft.rfft(record)[:, (freq >= band[0]) & (freq <= band[1])]


def test_its_spectra_are_those_of_the_records_in_time(modules, case):
    _, cramer_rao = modules
    setting, run, _ = case
    records, modes = run.records(), run.modes
    w, A, U, den = cramer_rao.modal_spectra(modes, run, setting.lines)
    for told, record in (
        (modes.shapes @ A + modes.rigid_body @ U, records.response),
        (modes.gamma.T @ A + modes.rigid_body_mass @ U, records.force),
    ):
        left = (_spectra(record, run, setting.lines) - told).T
        size = np.linalg.norm(told)
        assert np.linalg.norm(left) < 1e-2 * size
        # Tails that fold back at the sample rate, of the base too, are real numbers times these.
        folded = np.column_stack([np.ones(w.size), 1j * w, *(1 / den), *(1j * w / den)])
        folded /= np.linalg.norm(folded, axis=0)
        solved = np.linalg.lstsq(np.vstack([folded.real, folded.imag]), np.vstack([left.real, left.imag]))[0]
        assert np.linalg.norm(left - folded @ solved) < 2e-6 * size


@pytest.mark.parametrize("force", [True, False])
def test_its_information_is_that_of_differences_of_records_in_time(modules, case, force):
    """Of M_SS, M_S0, K_SS and damping ratios, one at a time, with the base motion as it is and transients free."""
    simulated, cramer_rao = modules
    setting, run, levels = case
    s = setting.structure
    n, d = s.n, s.n_base
    unknowns = cramer_rao.Unknowns(
        cramer_rao.symmetric(n, [(0, 0), (0, 1)]),
        np.eye(n * d).reshape(n * d, n, d)[:1],
        cramer_rao.symmetric(n, [(1, 1)]),
        np.zeros((0, d, d)),
    )
    T, _ = cramer_rao._slopes(s, run.modes, unknowns, weighed=force)
    info = cramer_rao.information(run.modes, [(run, levels)], setting.lines, force=force)
    told = T.T @ info @ T

    def changed(step):
        """Spectra of a structure with changed matrices."""
        M, G = s.mass.copy(), s.rigid_body_dofs
        M[:n, :n] += np.einsum("p,pij->ij", step[:2], unknowns.mass)
        M[:n, n:] += step[2] * unknowns.coupling[0]
        M[n:, :n] = M[:n, n:].T
        K, rigid = s.stiffness[:n, :n] + step[3] * unknowns.stiffness[0], np.vstack([G, np.eye(d)])
        squares, phi = scipy.linalg.eigh(K, M[:n, :n])
        modes = simulated.Modes(
            np.sqrt(squares), run.modes.zeta * np.exp(step[4:]), phi.T @ (M[:n] @ rigid), phi, G,
            rigid.T @ M @ rigid,
        )  # fmt: skip
        records = simulated.Run(modes, run.motion, run.free).records()
        channels = [records.response, records.force] if force else [records.response]
        return np.vstack([_spectra(record, run, setting.lines) for record in channels]).T  # (lines, channels)

    sizes = 1e-4 * np.concatenate([[s.mass[0, 0]] * 3, [s.stiffness[1, 1]], np.ones(n)])
    steps = np.diag(sizes)
    differences = np.stack([(changed(h) - changed(-h)) / (2 * size) for h, size in zip(steps, sizes, strict=True)], -1)
    w, _, _, den = cramer_rao.modal_spectra(run.modes, run, setting.lines)
    S = cramer_rao._noise(run.modes, run, levels, w, den)[:, : differences.shape[1], : differences.shape[1]]
    out = np.vstack([run.modes.shapes, run.modes.gamma.T])[: differences.shape[1]]
    free = [(x / den[k])[:, None] * out[:, k] for k in range(n) for x in (np.ones(w.size), 1j * w)]
    root = np.linalg.cholesky(np.linalg.inv(S)).conj().swapaxes(1, 2)  # S^-1 = root^H root
    tangent = (root @ np.stack(free, -1)).reshape(-1, len(free))
    tangent = np.vstack([tangent.real, tangent.imag])
    moves = (root @ differences).reshape(-1, sizes.size)
    moves = np.vstack([moves.real, moves.imag])
    moves = moves - tangent @ np.linalg.lstsq(tangent, moves, rcond=1e-14)[0]
    scale = np.sqrt(np.diag(told))
    np.testing.assert_allclose(2 * moves.T @ moves / np.outer(scale, scale), told / np.outer(scale, scale), atol=0.02)


def test_one_step_from_the_truth_errs_by_the_bound(modules):
    """Records with noise, their spectra and levels: chi² is its degrees of freedom, errors have the bound's size.

    One Gauss-Newton step of all unknowns, transients and what folds back, over draws of four storeys.
    """
    simulated, cramer_rao = modules
    setting = simulated.four_storeys()
    s, n, band = setting.structure, setting.structure.n, setting.lines
    unknowns = cramer_rao.all_entries(n, 1)
    quotients, chi_square = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        run = setting.run(rng)
        noisy, levels = setting.with_noise(run.records(), rng)
        modes = run.modes
        w, A, U, den = cramer_rao.modal_spectra(modes, run, band)
        g = w**2 * modes.gamma / den
        out, rigid = np.vstack([modes.shapes, modes.gamma.T]), np.vstack([modes.rigid_body, modes.rigid_body_mass])
        u = _spectra(noisy.base, run, band)
        e = np.vstack([_spectra(noisy.response, run, band), _spectra(noisy.force, run, band)])
        e = (e - rigid * u - out @ (A - g * U + g * u)).T  # with the base as it was measured
        factor = np.linalg.cholesky(cramer_rao._noise(modes, run, levels, w, den))
        J, _ = cramer_rao.whitened(modes, run, levels, band, force=True)
        T, slopes = cramer_rao._slopes(s, modes, unknowns, weighed=True)
        folded = [(1j * w[:, None] / w[-1]) ** p * unit for p in range(4) for unit in np.eye(n + 1)]
        folded = np.linalg.solve(factor, np.stack(folded, -1)).reshape(len(J), -1)
        columns = np.hstack([J[:, : len(T)] @ T, J[:, len(T) :], folded])
        columns, errors = np.vstack([columns.real, columns.imag]), np.linalg.solve(factor, e[..., None]).ravel()
        errors = np.concatenate([errors.real, errors.imag])
        scale = np.linalg.norm(columns, axis=0)
        step = np.linalg.lstsq(columns / scale, errors)[0] / scale
        chi_square.append(2 * np.sum((errors - columns @ step) ** 2) / (errors.size - step.size))
        bound = cramer_rao.bound(s, [(run, levels)], band, unknowns, force=True)
        for name, slope in slopes.items():
            std, error = getattr(bound, name), slope @ step[: slope.shape[-1]]
            quotients.append((error / std)[np.tril_indices(n)] if std.ndim == 2 else error / std)
    assert np.mean(chi_square) == pytest.approx(1, abs=0.01)
    assert np.sqrt(np.mean(np.concatenate(quotients) ** 2)) == pytest.approx(1, abs=0.2)
