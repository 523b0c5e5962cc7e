"""Plain spectra of modes that dampers couple: the model of whole records without transients, at lines that stand alone.

Shapes are no longer linear in what is left, as each load moves all modes: all unknowns are fitted together, from where
the fit without couplings ended.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.coupled_modes import coupling_of, in_the_lines_alone, passive, score_of_couplings
from sysid.modal_analysis.least_squares import SumOfSquares, minimise
from sysid.modal_analysis.misfit import Record
from sysid.modal_analysis.modal_estimate import Coupling, ModalEstimate
from sysid.modal_analysis.modal_fit import ModalFit, Modes, Weights, separate_poles
from sysid.modal_analysis.modal_model import Parameters, Run, SpectralModel
from sysid.modal_analysis.record_model import RecordModel
from sysid.modal_analysis.residues import Records
from sysid.modal_analysis.response import weights_of_test
from sysid.nlp import OBJECTIVE_SCALE, IterationMonitor
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import EXACT, beyond_chance


class CoupledLines(RecordModel):
    """The model of plain spectra with modes that dampers couple.

    Parameters
    ----------
    test : Measurement
    m : int
    weights : list of (run, (c,), (n_freq,))
        Weights of channels and lines in a run, as many of each run as needed; zero for channels that another one has.
    static, gains :
        As in `RecordModel`.
    """

    def __init__(
        self, test: Measurement, m: int, weights: list[tuple[int, Array, Array]], *, static: int, gains: bool = False
    ) -> None:
        outputs = test.response if test.force is None else np.concatenate([test.response, test.force], axis=1)
        w, ones = 2 * np.pi * test.freq, np.ones(test.freq.size)
        runs = [
            Run(w, test.base[run] * lines, outputs[run] * lines, 1.0, run, ones, piece)
            for piece, (run, _, lines) in enumerate(weights)
        ]
        SpectralModel.__init__(self, test, m, runs)
        with np.errstate(divide="ignore"):
            of_outputs = np.array([channels for _, channels, _ in weights]) ** -2.0
        self.levels = np.hstack([of_outputs, np.zeros((len(runs), self.d))])
        self._place(static, 0, gains=gains, coupled=True, across=False)

    def trace_spectra(self, freq: Array) -> ComplexArray:
        """No traces: plain spectra have none."""
        return SpectralModel.trace_spectra(self, freq)

    def of_modes(self, modes: Modes, rigid: Array, coupling: Array | None) -> Parameters:
        """Parameters of a modal model."""
        ends, traces = np.zeros((self.m, 0)), np.zeros((self.test.n_runs, self.channels, 0))
        return Parameters(modes, rigid, ends, traces, coupling)


def _by_weights(test: Measurement, weights: Weights) -> list[tuple[int, Array, Array]]:
    """Weights of a fit of plain spectra, for `CoupledLines`."""
    assert weights.force is not None
    found = []
    for run in range(test.n_runs):
        sensors, force = weights.sensors[run], weights.force[run]
        found.append((run, np.append(sensors, np.zeros_like(force)), weights.lines[run]))
        found.append((run, np.append(np.zeros_like(sensors), force), weights.force_lines[run]))
    return found


def _by_noise(records: list[Record]) -> list[tuple[int, Array, Array]]:
    """Weights by the noise of responses and force, for `CoupledLines`."""
    first, found = 0, []
    channels = [record.std.shape[0] for record in records]
    for record, count in zip(records, channels, strict=True):
        for runs, each, lines in record.weights:
            weight = np.zeros(sum(channels))
            weight[first : first + count] = each
            shape = (runs.size, record.std.shape[1] // sum(one.size for one, _, _ in record.weights))
            found += [(int(run), weight, line) for run, line in zip(runs, np.broadcast_to(lines, shape), strict=True)]
        first += count
    return found


def coupling_information(
    test: Measurement, records: list[Record], modes: Modes, rigid: Array, coupling: Array, static: int
) -> tuple[Array, Coupling | None]:
    """``Re J' S^-1 J`` over theta beside couplings that are free, (p, p), and how these follow."""
    model = CoupledLines(test, modes.omega.size, _by_noise(records), static=static)
    return _information(model, model.of_modes(modes, rigid, coupling))


def _information(model: CoupledLines, p: Parameters, scale: float = 1.0) -> tuple[Array, Coupling | None]:
    normal = model.normal_equations(p, model.levels).normal / scale
    m, index = model.m, model.index
    found = coupling_of(model, p, normal, np.arange(m), np.arange(index.size))
    kept, own = slice(model.kept), model.coupling
    of_kept = normal[kept, kept]
    return of_kept if found is None else of_kept + normal[kept, own] @ found.follows, found


def with_couplings_of_lines(modal: ModalEstimate, monitor: IterationMonitor, max_iterations: int) -> ModalEstimate:
    """The estimate of plain spectra with couplings of its modes, where the lines ask for them beyond chance.

    Its statistics stand for the lines from then on.
    """
    test, fit = modal.records, modal.fit
    if fit is None or fit.weights is None or fit.weights.force is None or fit.of_accelerations <= EXACT:
        return modal
    m, same = fit.modes.omega.size, fit.modes.omega.size - separate_poles(fit.modes)[0].size
    if m - fit.static < 2 or same > max(fit.static - 1, 0):  # turns of modes at one pole are none that show
        return modal
    weights = _by_weights(test, fit.weights)
    model, asked = (CoupledLines(test, m, weights, static=fit.static, gains=gains) for gains in (False, True))
    first = model.of_modes(fit.modes, fit.rigid, None)
    here = asked.normal_equations(first, model.levels)
    numbers = 2 * (test.response.size + test.base.size)
    freedom, count = numbers - model.unknowns, len(model.coupled)
    promised, seen = score_of_couplings(asked, here, first)
    least = 2 * here.chi2 / max(freedom, EXACT) * beyond_chance(seen)  # far more than there is without any freedom
    # The factor is one or more, and takes a fit: it is asked for last.
    if promised < least or promised < (shared := _shared_by_lines(test, fit.modes)) * least:
        return modal

    def tell(_: int, p: Parameters, chi2: float) -> bool:
        return monitor.record(model.pack(p), OBJECTIVE_SCALE * chi2)

    problem = SumOfSquares(
        model.pack(first), model.unpack, lambda p: model.trial_chi2(p, model.levels),
        lambda p: model.normal_equations(p, model.levels),
    )  # fmt: skip
    p, chi2, settled = minimise(problem, tell, max_iterations, lambda chi2: EXACT * (chi2 + EXACT**2))
    variance = max(shared * 2 * chi2 / freedom, EXACT**4)
    last, own = 2 * np.pi * test.freq[-1], slice(0, m - fit.static)
    stays = np.count_nonzero(p.modes.omega <= last) == np.count_nonzero(fit.modes.omega <= last)
    stays &= not fit.static or bool(np.all(p.modes.omega[own] < p.modes.omega[-1]))
    enough = 2 * (here.chi2 - chi2) >= variance * beyond_chance(count)
    if not (settled and stays and enough and passive(p, last)):
        return modal
    alone = in_the_lines_alone(model, p, model.levels, variance)
    return modal if alone is None else _estimate(modal, model, alone, chi2, variance)


def _shared_by_lines(test: Measurement, modes: Modes) -> float:
    """Factor by which errors weigh more on smooth functions, as neighbouring lines share them."""
    records, first = Records(test), separate_poles(modes)[0]
    free = records.fit(modes.omega[first], modes.ratios[first], velocity=True)
    unknowns = free.residues.size
    return records.noise(free.left, unknowns) / records.variance(float(np.sum(free.left**2)), unknowns)


def _estimate(modal: ModalEstimate, model: CoupledLines, p: Parameters, chi2: float, variance: float) -> ModalEstimate:
    """The estimate at the end of a fit, with the variance of a real number that has the weight one.

    Its information is in units of the records' stated noise, or in theirs where none is stated.
    """
    order = np.argsort(p.modes.omega, kind="stable")
    modes, coupling = p.modes.at(order), p.coupling
    assert coupling is not None and modal.fit is not None
    p = replace(p, modes=modes, coupling=coupling[np.ix_(order, order)])
    size = weights_of_test(model.test, weighted=True)[0][1]
    A, found = _information(model, p, size**-2)
    n = model.n
    fit: ModalFit = replace(modal.fit, modes=modes, rigid=p.rigid, residual=float(np.sqrt(chi2)), status="settled")
    gain = replace(modal.gain, moves=np.zeros((model.index.size, n)))
    return replace(
        modal, **modes._asdict(), rigid=p.rigid, fit=fit, information=A, gain=gain, coupling=found,
        reduced=variance * size**2,
    )  # fmt: skip
