"""The ten kinds of test that laboratories run, each as the files that it leaves and the truth behind them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.band.structures import PLANE
from benchmarks.laboratory import test_files
from benchmarks.laboratory.motions import channels, earthquake, motion_of, sweep
from benchmarks.laboratory.of_frequency import analysed, dwelled, lines_of_dwells
from benchmarks.laboratory.rigs import Rig, plane, storeys, three_axes, with_dashpot
from benchmarks.laboratory.spoiling import Spoiled
from benchmarks.laboratory.test_files import Channel
from benchmarks.records.simulated import Motion, random_motion

RATE = 3.2  # samples a period of the end of the base's motion
PERIODS = (60.0, 100.0)  # of the first mode, in a record of random motion
CROSS = 0.05  # motion of the axes that are not driven
ARM = 0.4  # m, from the middle of a table to its vertical sensors and load cells
Writer = Callable[[Path, list[Channel], np.ndarray, float], str]


@dataclass(frozen=True, eq=False)
class Case:
    """A test in files.

    Attributes
    ----------
    rig : Rig
        The truth.
    files : list of Path
    sensors : str
        A TOML.
    word : str
        The judgement that is right.
    options : list of str
        Of ``sysid run``, beside ``--gain-std``.
    drifts : bool
        Whether the sensors are floors, one above the other.
    """

    rig: Rig
    files: list[Path]
    sensors: str
    word: str = "determined"
    options: tuple[str, ...] = ()
    drifts: bool = False


def random_with_force(rng: np.random.Generator, folder: Path) -> Case:
    """Random motion of one axis, as a logger's table."""
    rig = plane(rng, (("x",), ("z",))[int(rng.integers(2))])
    return _in_time(rig, [_random(rng, rig)], rng, folder / "random.csv", test_files.csv)


def slow_sweep(rng: np.random.Generator, folder: Path) -> Case:
    """A sweep of two octaves a minute with notches, as arrays of MATLAB."""
    return _swept(rng, folder / "sweep.mat", test_files.matlab, 2.0)


def fast_sweep(rng: np.random.Generator, folder: Path) -> Case:
    """A sweep of four octaves a minute with notches, as sets 58."""
    return _swept(rng, folder / "sweep.unv", test_files.universal, 4.0)


def three_axes_of_spacecraft(rng: np.random.Generator, folder: Path) -> Case:
    """Three runs of random motion along x, y and z, eighteen channels, as sets 58 in a file each."""
    rig = three_axes(rng)
    motions = []
    for driven in range(3):
        size = np.full(3, CROSS)
        size[driven] = 1.0
        motion = _random(rng, rig, longer=6.0)  # its modes are close to each other
        motions.append(replace(motion, amplitudes=size[:, None] * motion.amplitudes))
    return _in_time(rig, motions, rng, folder / "axis.unv", test_files.universal)


def earthquake_with_weighed_floors(rng: np.random.Generator, folder: Path) -> Case:
    """A model of three to five floors under an earthquake, its floors weighed, as a LabVIEW file."""
    rig = storeys(rng, int(rng.integers(3, 6)), (2.0, 4.0))
    motion = motion_of(6 * earthquake(rng, RATE * rig.end, 80 / rig.frequencies[0], (0.1 * rig.start, rig.end)),
                       RATE * rig.end, 1.6)  # fmt: skip
    case = _in_time(rig, [motion], rng, folder / "quake.lvm", test_files.labview, force=False)
    return replace(case, options=("--lumped", "--mass", f"{rig.weighed:.6g}"), drifts=True)


def earthquake_of_a_building(rng: np.random.Generator, folder: Path) -> Case:
    """A building of six floors under an earthquake, as a strong-motion file of ground and floors."""
    rig = storeys(rng, 6, (0.8, 2.0))
    rate = float(next(one for one in (50.0, 100.0, 200.0) if one > 2.5 * rig.end))
    motion = motion_of(3 * earthquake(rng, rate, 80 / rig.frequencies[0], (0.1, rig.end)), rate, 1.6)
    case = _in_time(rig, [motion], rng, folder / "building.V2", test_files.strong_motion, force=False)
    return replace(case, word="one of many", drifts=True)


def analyser_functions(rng: np.random.Generator, folder: Path) -> Case:
    """H1 with Hann's window of 40 blocks, 801 lines, and coherences, as sets 58."""
    rig = plane(rng, longest=8.0)
    spoiled = Spoiled.of(rng, *_second(rig, True), 1.0)
    freq, H1, coherence = analysed(rig, spoiled, rng)
    top = 'frf = "transmissibility"\nbase_axes = "x"\nwindow = "hann"\naverages = 40\n'
    text = test_files.functions(folder / "h1.unv", _channels(rig, True)[1:], freq, H1, coherence, top)
    return Case(rig, [folder / "h1.unv"], text)


def stepped_sine(rng: np.random.Generator, folder: Path) -> Case:
    """A sine stepped through uneven lines at two levels, as tables of amplitude and phase."""
    rig = plane(rng, longest=12.0)
    spoiled = Spoiled.of(rng, *_second(rig, True), 8 * rig.end)
    freq = lines_of_dwells(rig)
    files, text = [], ""
    for level, size in (("low", 1.0), ("high", 2.5)):
        files.append(folder / f"{level}.csv")
        text = test_files.stepped_table(files[-1], _channels(rig, True), freq, dwelled(rig, freq, size, spoiled, rng))
    return Case(rig, files, text)


def rocking_table(rng: np.random.Generator, folder: Path) -> Case:
    """A table that rocks while it moves, with vertical sensors and load cells at its ends, as arrays of MATLAB."""
    rig = plane(rng, PLANE, moved=("x", "ry"))
    motion = _random(rng, rig)
    x, other = motion.amplitudes[0], motion.amplitudes[2]
    size = rng.uniform(0.05, 0.3)  # rad/m
    motion = replace(motion, amplitudes=np.array([x, 0 * x, size * (0.7 * x + 0.7 * other)]))
    return _in_time(rig, [motion], rng, folder / "rocking.mat", test_files.matlab)


def frame_with_dashpot(rng: np.random.Generator, folder: Path) -> Case:
    """Random motion of a frame with a dashpot between two floors, as a logger's table."""
    rig = with_dashpot(rng, plane(rng))
    return _in_time(rig, [_random(rng, rig)], rng, folder / "dashpot.csv", test_files.csv)


KINDS: dict[str, Callable[[np.random.Generator, Path], Case]] = {
    "random": random_with_force, "sweep 2": slow_sweep, "sweep 4": fast_sweep, "spacecraft": three_axes_of_spacecraft,
    "weighed": earthquake_with_weighed_floors, "building": earthquake_of_a_building, "H1": analyser_functions,
    "stepped": stepped_sine, "rocking": rocking_table, "dashpot": frame_with_dashpot,
}  # fmt: skip


def _random(rng: np.random.Generator, rig: Rig, longer: float = 1.0) -> Motion:
    rate = RATE * rig.end
    seconds = longer * float(rng.uniform(*PERIODS)) / rig.frequencies[0]
    return random_motion(rng, seconds, rate, (rig.start, rig.end), correlation=np.eye(len(rig.base)))


def _swept(rng: np.random.Generator, path: Path, write: Writer, octaves: float) -> Case:
    rig = plane(rng, longest=12.0)
    rate = RATE * rig.end
    history = sweep(rate, (rig.start, rig.end), octaves, rig.frequencies[: rig.count], float(rng.uniform(0.2, 0.5)))
    return _in_time(rig, [motion_of(history, rate)], rng, path, write)


def _channels(rig: Rig, force: bool) -> list[Channel]:
    """Channels of base, sensors and forces, in this order."""
    sensors = [Channel(f"a{at}", "response", *place) for at, place in enumerate(rig.sensors, 1)]
    if "ry" in rig.base:
        table, cells = (
            [Channel(f"{name} x", role, "x"), Channel(f"{name} left", role, "z", (-ARM, 0, 0)),
             Channel(f"{name} right", role, "z", (ARM, 0, 0))]
            for name, role in (("table", "base"), ("force", "force"))
        )  # fmt: skip
        return [*table, *sensors, *cells]
    table = [Channel(f"table {axis}", "base", axis) for axis in rig.base]
    return [*table, *sensors, *([Channel(f"force {axis}", "force", axis) for axis in rig.base] * force)]


def _second(rig: Rig, force: bool) -> tuple[int, slice]:
    """How many channels there are, and which of them are on a second module: the last third of the sensors."""
    first = len(rig.base) + 2 * len(rig.sensors) // 3
    return len(_channels(rig, force)), slice(first, len(rig.base) + len(rig.sensors))


def _in_time(
    rig: Rig, motions: list[Motion], rng: np.random.Generator, path: Path, write: Writer, force: bool = True
) -> Case:  # fmt: skip
    """Records of runs, spoiled and written; several runs as files of their own."""
    rate, named = motions[0].sample_rate, _channels(rig, force)
    spoiled = Spoiled.of(rng, *_second(rig, force), rate)
    files, text = [], ""
    for at, motion in enumerate(motions, 1):
        late = np.zeros(2 * len(rig.base) + len(rig.sensors))
        late[: len(named)] = spoiled.late
        rows = channels(rig, motion, late)[: len(named)]
        rows = _at_table(rows) if "ry" in rig.base else rows
        files.append(path if len(motions) == 1 else path.with_stem(f"{path.stem}{at}"))
        text = write(files[-1], named, spoiled.recorded(rows, rate, rng), rate)
    top = 'base_axes = "x ry"\n' * ("ry" in rig.base)
    return Case(rig, files, top + text)


def _at_table(rows: np.ndarray) -> np.ndarray:
    """Vertical sensors and load cells at the ends of a table, in place of rotations, moments and what is vertical."""
    (x, z, turn), (fx, fz, moment) = rows[:3], rows[-3:]
    return np.vstack([
        x, z + ARM * turn, z - ARM * turn, rows[3:-3], fx, (fz + moment / ARM) / 2, (fz - moment / ARM) / 2
    ])  # fmt: skip
