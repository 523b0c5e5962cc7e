"""Every reader and the command line, given what chance makes: no hang, no traceback, no memory filled."""

from __future__ import annotations

import contextlib
import io
import resource
import signal
import string
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

import sysid
from benchmarks.hostile.damage import KINDS, damaged
from benchmarks.laboratory.written_files import Lvm, StrongMotion
from benchmarks.line import Line, below
from sysid.cli.main import main
from sysid.cli.starting import BUG
from sysid.files import lvm, strong_motion, xsens_dot
from sysid.jobs.job import Job, JobResult
from sysid.jobs.submission import FILE_NAME as LEDGER
from sysid.jobs.submission import Ledger
from sysid.results.checkpoint import Checkpoint

SECONDS, REDUCED = 600.0, 1.5  # a reader
HANGS = 5.0  # s, from which one input counts as a hang
MEMORY = 500.0  # MB that all of it may add to the process

Attempt = Callable[[np.random.Generator], None]


def lines(reduced: bool) -> Iterator[Line]:
    """Of each reader: the inputs that hung, and those that ended in anything but an answer or an InputError."""
    with tempfile.TemporaryDirectory() as name, contextlib.chdir(name):
        before = _megabytes()
        for what, attempt in _attempts(Path(name)).items():
            count, hung, failed = _fuzz(attempt, REDUCED if reduced else SECONDS)
            yield below(f"{what}, {count} inputs: took more than {HANGS:g} s", hung, 0)
            first = f" (the first: {failed[0]})" if failed else ""
            yield below(f"{what}, {count} inputs: ended in another error than one for people{first}", len(failed), 0)
        yield below("megabytes that this process grew by", _megabytes() - before, MEMORY)


def _attempts(folder: Path) -> dict[str, Attempt]:
    K = 1e4 * np.array([[3.0, -1.0, -2.0], [-1.0, 1.0, 0.0], [-2.0, 0.0, 2.0]])
    truth = sysid.Structure(np.diag([3.0, 2.0, 0.0]), K, [0.01, 0.02], n_base=1)
    problem = sysid.Problem(
        sysid.simulate(truth, np.linspace(1.0, 40.0, 60)), mass=sysid.LumpedMass(5.0),
        stiffness=sysid.SpectralStiffness(), damping=sysid.ModalDamping(),
    )  # fmt: skip
    result = sysid.identify(problem, rng=0).save(folder / "sound.h5").read_bytes()
    state = folder / "state.h5"
    sysid.identify(problem, strategy=sysid.Swarm(5), rng=0, callback=_stop, checkpoint=Checkpoint(state, every=0.0))
    unfinished = state.read_bytes()
    file, noise = folder / "fuzzed", np.random.default_rng(1).standard_normal((2, 40))
    labview = Lvm(["table", "top"], ["g", "g"], [noise, -noise], gaps=[1.0], special="Packet_Notes")
    volume = StrongMotion(["360 Deg", "Up"], noise)

    def of(sound: bytes, read: Callable[[], object], file: Path = file) -> Attempt:
        def attempt(rng: np.random.Generator) -> None:
            data = sound
            for _ in range(int(rng.integers(1, 4))):
                data = damaged(data, KINDS[rng.integers(len(KINDS))], rng) or b"0"
            file.write_bytes(data)
            with contextlib.suppress(sysid.InputError):
                read()

        return attempt

    return {
        "results": of(result, lambda: sysid.load(file)),
        "states of unfinished searches": of(unfinished, Checkpoint(file).read),
        "ledgers of jobs": of(_ledger(folder), lambda: _ledger(folder), folder / LEDGER),
        "CSV of inertial units": of(_xsens(), lambda: xsens_dot.read_xsens_dot(file)),
        "measurement files of LabVIEW": of(labview.text().encode(), lambda: lvm.read_lvm(file)),
        "strong-motion records": of(volume.text().encode(), lambda: strong_motion.read_strong_motion(file)),
        "the command line": _command,
    }


def _stop(progress: sysid.Progress) -> None:
    if (progress.phase, progress.iteration) == ("swarm", 3):
        raise KeyboardInterrupt


def _ledger(folder: Path) -> bytes:
    """Bytes of a ledger after its results were read, and others written."""
    x = np.linspace(0.1, 0.9, 30)
    tasks = [Job(index, sysid.Recipe("of_nothing.py"), index, "0" * 64) for index in range(20)]
    with warnings.catch_warnings(action="ignore"), Ledger(folder, tasks) as ledger:
        for result in ledger.results().values():
            if not np.array_equal(result.x, x + result.index):
                raise RuntimeError(f"other numbers: {result}")
        for task in tasks:
            ledger.add(JobResult(task.index, task.seed, True, "converged", x + task.index, 1e-3))
    return (folder / LEDGER).read_bytes()


def _xsens() -> bytes:
    head = "DeviceTag:,A\n\nPacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z\n"
    rows = [f"{i},{16667 * i},{np.sin(i):.6f},0.1,9.81,0.0,0.5,-0.25" for i in range(60)]
    return (head + "\n".join(rows) + "\n").encode()


def _command(rng: np.random.Generator) -> None:
    """Words that the command line knows, and some that it does not, in any order."""
    words = (
        *("list", "new", "show", "run", "compare", "refine", "report", "--help", "--version", "--seed", "--strategy"),
        *("--out", "--max-time", "--set", "--data", "--resume", "--fresh", "--starts", "--workers", "--scheduler"),
        *("--draws", "--orders", "--bands", "--variants", "--leave-out", "1-2", "3-1", "0.5-8", "sensor", "run"),
        *("swarm", "modal", "0", "-1", "1e999", "nan", "a=b", "n=", "=3", "", " ", "/", "..", "/dev/null", "/dev/zero"),
        *(
            "sound.h5",
            "state.h5",
            "fuzzed",
            "fuzzed.py",
            "no\0thing",
            "\x1b[2J",
            "\udcff",
            "x" * 5000,
            "ü",
            "*",
            "-",
            "--",
        ),
    )
    Path("fuzzed.py").write_bytes(_source(rng))
    chosen = [words[i] for i in rng.integers(len(words), size=int(rng.integers(0, 6)))]
    silent = io.StringIO()
    with contextlib.redirect_stdout(silent), contextlib.redirect_stderr(silent):
        status = main(chosen)
    if status == BUG:
        raise RuntimeError(f"{chosen}: {silent.getvalue().strip().splitlines()[-1]}")


def _source(rng: np.random.Generator) -> bytes:
    """A problem module that is none."""
    bodies = ("return 3", "raise ValueError('\\x1b')", "raise SystemExit", "1 / 0", "return sysid", "import nothing")
    text = f"import sysid\n\ndef problem(*, data=None, rng=0):\n    {bodies[rng.integers(len(bodies))]}\n"
    if rng.random() < 0.5:
        return text.encode()
    return "".join(rng.choice(list(string.printable), 40)).encode()


def _fuzz(attempt: Attempt, seconds: float) -> tuple[int, int, list[str]]:
    """Inputs, how many of them hung, and what else than an InputError came out."""
    count, hung, failed, end = 0, 0, list[str](), time.perf_counter() + seconds
    before = signal.signal(signal.SIGALRM, _too_late)
    try:
        while time.perf_counter() < end:
            rng = np.random.default_rng((31, count))
            count += 1
            signal.setitimer(signal.ITIMER_REAL, HANGS)
            try:
                attempt(rng)
            except _Hang:
                hung += 1
            except BaseException as error:  # what this looks for
                failed.append(f"input {count - 1}: {type(error).__name__}: {error}"[:200])
            finally:
                signal.setitimer(signal.ITIMER_REAL, 0.0)
    finally:
        signal.signal(signal.SIGALRM, before)
    return count, hung, failed


class _Hang(BaseException):
    """An input takes too long."""


def _too_late(number: int, frame: object) -> None:
    raise _Hang


def _megabytes() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
