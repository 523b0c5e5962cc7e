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
    )
    T, _ = cramer_rao._slopes(s, run.modes, unknowns, rigid=False)
    info = cramer_rao.information(run.modes, [(run, levels)], setting.lines, force=force)
    told = T.T @ info[: len(T), : len(T)] @ T

    def changed(step):
        """Spectra of a structure with changed matrices, M_rb as it was."""
        M, K, B = s.mass[:n, :n], s.stiffness[:n, :n], s.mass[:n, :n] @ s.rigid_body_dofs + s.mass[:n, n:]
        dM = np.einsum("p,pij->ij", step[:2], unknowns.mass)
        M, K = M + dM, K + step[3] * unknowns.stiffness[0]
        B = B + dM @ s.rigid_body_dofs + step[2] * unknowns.coupling[0]
        squares, phi = scipy.linalg.eigh(K, M)
        modes = simulated.Modes(
            np.sqrt(squares), run.modes.zeta * np.exp(step[4:]), phi.T @ B, phi, run.modes.rigid_body,
            run.modes.rigid_body_mass,
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
