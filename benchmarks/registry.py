"""All benchmarks.

To add one, write ``benchmarks/NAME.py``, or ``benchmarks/GROUP/NAME.py`` in a group, with a function
``lines(reduced: bool) -> Iterator[Line]``, and add one line to `BENCHMARKS`. Nothing else names it.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from dataclasses import dataclass

from benchmarks.line import Line

ALL = "all"


@dataclass(frozen=True)
class Benchmark:
    """A module that measures something.

    Attributes
    ----------
    module : str
        Below `benchmarks`: ``"NAME"``, or ``"GROUP.NAME"``. It is imported only when it runs.
    what : str
        What it measures, in one line.
    full, reduced : str
        About how long each form takes on two cores.
    timed : bool
        True where it judges seconds, or when something happens: nothing else should run beside it.
    reduced_timed : bool
        False where a timed one judges none in its reduced form.
    """

    module: str
    what: str
    full: str
    reduced: str
    timed: bool = False
    reduced_timed: bool = True

    @property
    def name(self) -> str:
        """Name of the benchmark; unique among all benchmarks and groups."""
        return self.module.rpartition(".")[2]

    @property
    def group(self) -> str:
        """The group that it runs with; empty for none."""
        return self.module.rpartition(".")[0]

    def alone(self, reduced: bool) -> bool:
        """True where nothing else should run beside it."""
        return self.timed and (self.reduced_timed or not reduced)

    def lines(self, reduced: bool) -> Iterator[Line]:
        """Measure, line by line; the reduced form takes fewer seeds and leaves out what takes minutes."""
        lines: Iterator[Line] = importlib.import_module(f"benchmarks.{self.module}").lines(reduced)
        return lines


BENCHMARKS = (
    Benchmark("swarm.tower", "how exact the swarm strategy identifies the tower without noise", "4 min", "45 s"),
    Benchmark("swarm.tower_noise", "residual over the noise floor, tower with 1 % noise", "3 min", "40 s"),
    Benchmark(
        "swarm.swarm_alone", "residual that the swarm reaches without a gradient step, and others", "25 min", "30 s"
    ),
    Benchmark(
        "swarm.hpso_ls", "the tower by the paper's algorithm, without noise and with it", "30 min", "25 s", timed=True
    ),
    Benchmark(
        "swarm.noisy_tests", "coupled structures by the paper's algorithm beside the modal strategy", "30 min", "20 s"
    ),
    Benchmark(
        "swarm.refinement_by_ipopt", "eigenvalues refined by IPOPT: derivatives, leaders, statuses", "20 min", "10 s"
    ),
    Benchmark(
        "swarm.structured", "springs, dampers, masses from wide bounds by swarm and simpler searches", "40 min", "30 s"
    ),
    Benchmark(
        "swarm.swarm_cost",
        "microseconds a candidate of the swarm's objective and the swarm",
        "3 min",
        "20 s",
        timed=True,
    ),
    Benchmark("swarm.spacecraft", "successes and seconds of the swarm strategy on the spacecraft", "7 min", "90 s"),
    Benchmark("swarm.shake_table", "measured records: fit of one event, prediction of another", "5 s", "5 s"),
    Benchmark("amplitude.gradients", "gradients of fits with laws of amplitude", "1 min", "10 s"),
    Benchmark("amplitude.law_speed", "processor time of a law of three floors", "3 min", "15 s", timed=True),
    Benchmark("amplitude.measured_events", "measured records: a mode that follows its amplitude", "3 min", "25 s"),
    Benchmark("amplitude.stopped_laws", "laws of amplitude whose fit is stopped at random times", "4 min", "15 s"),
    Benchmark("amplitude.unseen_runs", "simulated structures that change with amplitude", "90 min", "60 s"),
    Benchmark("swarm.bad_input", "how mistakes at the command line are reported", "20 s", "20 s"),
    Benchmark("swarm.fresh_install", "the README's two commands in a new environment", "12 min", "-", timed=True),
    Benchmark("modal.noise_free", "residual and matrices of noise-free tests of random structures", "1 min", "10 s"),
    Benchmark("modal.speed", "seconds that an identification of 10 or 20 modes takes", "1 min", "15 s", timed=True),
    Benchmark("modal.modes_found", "modes found, missed and spurious in noisy tests", "7 min", "10 s"),
    Benchmark("modal.accuracy", "errors over the Cramér-Rao bound, and coverage of 95 % intervals", "15 min", "10 s"),
    Benchmark("modal.building", "matrices of a building, and their extremes where they are open", "2 s", "2 s"),
    Benchmark("modal.six_axis_spacecraft", "errors of predictions and rigid-body mass, 20 modes", "1 min", "10 s"),
    Benchmark("modal.large_tests", "seconds and memory for 50 and 100 modes", "2 min", "15 s", timed=True),
    Benchmark("modal.damping_range", "lumped and chain tests of little to much damping", "8 min", "15 s"),
    Benchmark("modal.unsound_tests", "whether results say what a test cannot tell", "10 s", "10 s"),
    Benchmark(
        "records.stated_values", "stated masses: whether true ones help and wrong ones are told", "4 min", "15 s"
    ),
    Benchmark("variants.six_springs", "errors of springs and dampers at four levels of noise", "9 min", "15 s"),
    Benchmark("variants.five_storeys", "errors of storey stiffnesses at 5 % noise", "6 min", "20 s"),
    Benchmark("variants.modules_from_readme", "whether modules written from the README alone run", "3 min", "3 min"),
    Benchmark("variants.module_mistakes", "how mistakes in a problem module are reported", "70 s", "5 s"),
    Benchmark(
        "records.second_answers",
        "second answers told, and unique answers not accused of one",
        "8 min",
        "45 s",
        timed=True,
    ),
    Benchmark("jobs.killed_searches", "searches killed at random times and resumed: the same bits", "8 min", "25 s"),
    Benchmark("jobs.interrupted_runs", "Ctrl-C at random times of a run: what is said and kept", "5 min", "20 s"),
    Benchmark(
        "jobs.lost_workers",
        "jobs whose workers are killed; what a job costs; gain of two",
        "20 min",
        "25 s",
        timed=True,
        reduced_timed=False,
    ),
    Benchmark(
        "jobs.two_workers",
        "eight draws of the tower by two workers, over one",
        "60 s",
        "20 s",
        timed=True,
        reduced_timed=False,
    ),
    Benchmark("jobs.cut_link", "jobs on two machines whose link drops for 30 s", "2 min", "-", timed=True),
    Benchmark("jobs.one_folder", "two runs in one folder: one result, the other refused, none lost", "15 min", "30 s"),
    Benchmark("hostile.corruptions", "damaged result files: an error or the same numbers", "2 s", "1 s"),
    Benchmark("hostile.hand_made_files", "files made by hand to have something run: nothing does", "60 s", "60 s"),
    Benchmark("hostile.fuzz", "every reader and the command line, given what chance makes", "50 min", "15 s"),
    Benchmark(
        "hostile.stored_expressions",
        "stored problems read in a fresh process: bits, size, time",
        "40 min",
        "15 s",
        timed=True,
        reduced_timed=False,
    ),
    Benchmark("hostile.extreme_structures", "silent wrong answers at the ends of what occurs", "5 min", "15 s"),
    Benchmark("records.four_storeys", "one record cut in motion: verdicts, intervals, errors, levels", "5 min", "25 s"),
    Benchmark("records.coupled_records", "coupled structures: modes, intervals, accusations", "10 min", "20 s"),
    Benchmark("records.two_runs", "errors of two unequal runs over those of one", "3 min", "20 s"),
    Benchmark(
        "records.record_speed",
        "seconds and memory from records in time to a judged result",
        "1 min",
        "10 s",
        timed=True,
    ),
    Benchmark("records.measured_records", "measured records: stated deviations against a jackknife", "1 min", "30 s"),
    Benchmark("records.stopped_fits", "fits stopped by Ctrl-C and --max-time: nothing lost, in time", "8 min", "40 s"),
    Benchmark("records.gain_errors", "a sensor 2 % wrong: silent cases, and right ones accused", "3 min", "10 s"),
    Benchmark(
        "files.read_files", "one test as CSV, MAT, UFF 58 and 58b: masses after read, run and export", "40 s", "12 s"
    ),
    Benchmark(
        "files.awkward_files", "awkward and broken files: read right, or refused in one clear line", "5 s", "5 s"
    ),
    Benchmark("files.exported_files", "exported files read by other programs: what they keep", "20 s", "10 s"),
    Benchmark("page.report_page", "the report page by a browser's measure", "80 s", "15 s"),
    Benchmark(
        "page.page_speed",
        "a run with its page, a large page, a summary, the import: seconds",
        "70 s",
        "15 s",
        timed=True,
    ),
    Benchmark(
        "mistakes.named_mistakes",
        "one mistake a test: named first, right ones not accused",
        "6 min",
        "20 s",
        timed=True,
    ),
    Benchmark("mistakes.model_errors", "structures that change: told so, linear ones not", "5 min", "15 s"),
    Benchmark(
        "estimate.estimate_speed",
        "processor time of modal fits over that of an older commit",
        "5 min",
        "15 s",
        timed=True,
    ),
    Benchmark("estimate.answers", "modes, judgement and matrices beside an older commit's", "8 min", "20 s"),
    Benchmark("estimate.last_phase", "ends in IPOPT, their gradients, wrong signs noticed", "3 min", "15 s"),
    Benchmark(
        "band.continuous",
        "beams, frames, plates with modes beyond the lines: determined, exact",
        "1 h",
        "60 s",
        timed=True,
    ),
    Benchmark(
        "band.above_first_mode", "lines that begin above the first mode: nothing right accused", "10 min", "20 s"
    ),
    Benchmark("band.dashpots", "damping that is not classical: modes, C within its intervals, told", "10 min", "25 s"),
    Benchmark("band.wrong_sensors", "one wrong sensor among modes beyond the lines: named", "40 min", "20 s"),
    Benchmark(
        "band.residuals_in_searches",
        "swarm and hpso-ls with modes beyond the lines: fits to the noise",
        "5 min",
        "20 s",
    ),
    Benchmark("band.exported", "answers in the band by other programs, in time, against the test", "8 min", "20 s"),
    Benchmark(
        "band.spacecraft_dummy",
        "six base directions, 22 modes to 200 Hz: base drive and mass properties",
        "6 min",
        "15 s",
    ),
    Benchmark(
        "band.no_modes_above", "structures without modes above the lines: what residual modes cost", "4 min", "20 s"
    ),
    Benchmark(
        "channels.gains", "gains within tolerances, and wrong ones, beside modes above the band", "20 min", "20 s"
    ),
    Benchmark("channels.delays", "late channels: found first, how exactly; none on one clock", "10 min", "25 s"),
    Benchmark(
        "channels.signed_exports", "exported files of a sensor at -x: sign in the row's name, or turned", "5 s", "3 s"
    ),
    Benchmark(
        "channels.brackets", "a sensor on a soft bracket: named with redundancy, none of sound tests", "20 min", "15 s"
    ),
    Benchmark("channels.rocking", "tables that rock: told by their rotation, straight ones not", "15 min", "40 s"),
    Benchmark("channels.damaged", "damaged samples: kind and channel told; nothing of sound tests", "6 min", "20 s"),
    Benchmark(
        "laboratory.reader_files", "files of laboratories and their broken twins: right, or one line", "10 s", "10 s"
    ),
    Benchmark(
        "laboratory.growing_errors", "stepped sines read to a share: modes, intervals, judgement", "3 min", "20 s"
    ),
    Benchmark(
        "laboratory.kinds_of_test",
        "ten kinds of test as their files, by the command line, beside the truth",
        "3 h",
        "20 s",
        timed=True,
        reduced_timed=False,
    ),
    Benchmark("laboratory.supports", "bridges whose recorded supports move apart: named", "20 min", "30 s"),
    Benchmark(
        "channels.unfit", "whole records that no modes fit: no worse than a rigid body or spectra", "10 min", "15 s"
    ),
    Benchmark("channels.real_frames", "delays, noise and quadrature of two recorded events", "1 min", "10 s"),
    Benchmark("house", "imports one way, tests of types, branches, sizes of functions and files", "2 s", "2 s"),
)


def names() -> set[str]:
    """All that may be asked for: benchmarks, groups, and "all"."""
    return {ALL} | {b.name for b in BENCHMARKS} | {b.group for b in BENCHMARKS if b.group}


def select(wanted: list[str]) -> list[Benchmark]:
    """Benchmarks that some names stand for, each once, in the order of the registry."""
    return [b for b in BENCHMARKS if {b.name, b.group, ALL}.intersection(wanted)]
