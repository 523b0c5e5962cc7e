"""Files made by hand to have something run, or memory filled: nothing runs, and each ends in one clear line."""

from __future__ import annotations

import contextlib
import io
import os
import re
import resource
import runpy
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np

import sysid
from benchmarks.hostile import made_by_hand
from benchmarks.hostile.made_by_hand import CANARIES, SECRET, HandMade, Sound
from benchmarks.line import Line, above, below
from sysid import catalogue
from sysid.cli.main import main
from sysid.files import reading
from sysid.results.checkpoint import Checkpoint, RunRequest

_SECONDS = 30  # of a processor, from which a command counts as one that hangs
_MEGABYTES = 1500.0  # that a command may take, the package itself included
_FILES = 40
# What must not reach a terminal, a page or an exported file.
_CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
_RUNS = "import pathlib\npathlib.Path({trace!r}).touch()\nimport sysid\n"
_MODEL = "\nclass Tank(sysid.ModalDamping):\n    pass\n"
_PROBLEM = "\ndef problem(*, data=None, rng=0, **others):\n    raise SystemExit('it ran')\n"
_OWN = '''
import numpy as np

import sysid


class Light(sysid.ModalDamping):
    """A model of the user's own."""


def problem(*, data=None, rng=0):
    K = 1e4 * np.array([[3.0, -1.0, -2.0], [-1.0, 1.0, 0.0], [-2.0, 0.0, 2.0]])
    truth = sysid.Structure(np.diag([3.0, 2.0, 0.0]), K, [0.01, 0.02], n_base=1)
    test = sysid.simulate(truth, np.linspace(1.0, 40.0, 60), noise=0.001, rng=rng)
    return sysid.Problem(test, mass=sysid.LumpedMass(5.0), stiffness=sysid.SpectralStiffness(), damping=Light())
'''
# Modules of the standard library's names: a worker begins with imports of its own.
_STANDARD = ("multiprocessing", "random", "tempfile", "pickle", "struct", "signal", "threading")
_COMMAND = "from sysid.cli.main import command\n\nif __name__ == '__main__':\n    command()\n"


def lines(reduced: bool) -> Iterator[Line]:
    """Of each file: what ran or was imported, how it ended, what it took.

    The reduced form leaves `report` and `export` to the files of one result in ten.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        here = _place(folder)
        sound = _sound(folder)
        files = [
            *made_by_hand.results(sound, here), *made_by_hand.recipes(sound), *made_by_hand.tests(sound, here),
            *made_by_hand.unfinished(sound), *made_by_hand.ledgers(sound, folder),
        ]  # fmt: skip
        kept = {path for path in here.rglob("*") if path.name != "evil.c"}
        known = _Known(here, sound)
        ran, wrong, most, count = [], [], 0.0, 0
        for at, file in enumerate(files):
            commands = [one for one in file.commands if not (reduced and at % 10 and one[0] in ("report", "export"))]
            traces, faults, megabytes = known.tried(file, commands)
            count += len(commands)
            ran += [f"{file.what}: {trace}" for trace in traces]
            wrong += [f"{file.what}, {fault}" for fault in faults]
            most = max(most, megabytes)
            _clean(here, kept)
        beside = _workers(folder, sound)
    yield above("files made by hand: results, tests, recipes, unfinished runs, ledgers", len(files), _FILES)
    yield below(f"of {len(files)} files in {count} commands: ran or imported something{_first(ran)}", len(ran), 0)
    yield below(
        f"commands that ended neither in one clear line nor in the sound file's numbers{_first(wrong)}", len(wrong), 0
    )
    yield below("megabytes that a command took at most", most, _MEGABYTES)
    yield below(f"modules in the working folder that workers imported{_first(beside)}", len(beside), 0)
    calls = [path.name for path in Path(sysid.__file__).parent.rglob("*.py") if "deserialize(" in path.read_text()]
    yield below(f"files of sysid in which CasADi's deserialize( stands{_first(calls)}", len(calls), 0)


def _first(found: list[str]) -> str:
    return f" (the first: {found[0]})" if found else ""


def _place(folder: Path) -> Path:
    """A folder in which modules lie that leave a trace when they run."""
    here = folder / "here"
    for name in (CANARIES, "problems", "evil_package"):
        (here / name).mkdir(parents=True)
    modules = (
        "evil_models",
        "beside_it",
        "evil",
        "problems/evil",
        "problems/recorded_test",
        "problems/physical_damping",
    )
    for module in (*modules, "evil_package/__init__", "evil_package/inside"):
        trace = str(here / CANARIES / module.replace("/", "."))
        (here / f"{module}.py").write_text(_RUNS.format(trace=trace) + _MODEL + _PROBLEM)
    (here / "secret").write_bytes(SECRET.ljust(64))
    with h5py.File(here / "elsewhere.h5", "w") as file:
        file["x"] = np.linspace(1.0, 2.0, 5)
    return here


def _sound(folder: Path) -> Sound:
    """Files as sysid writes them, in a folder that is none of the place of the others."""
    made = folder / "made"
    made.mkdir()
    (made / "own_light.py").write_text(_OWN)
    recipes = {
        "models": sysid.Recipe("cantilever_tower", parameters={"elements": 3, "noise": 0.0, "force": False}),
        "expressions": sysid.Recipe("physical_damping"),
        "own": sysid.Recipe(str(made / "own_light.py")),
    }
    results = {}
    before = {*sys.modules}
    for name, recipe in recipes.items():
        result = replace(sysid.identify(catalogue.build(recipe), rng=0), recipe=recipe)
        results[name] = result.save(made / f"{name}.h5").read_bytes()
    for module in {*sys.modules} - before:
        if "own_light" in module:  # as in another process
            del sys.modules[module]
    return Sound(**results, test=_test(), unfinished=_stopped(made), ledger=_ledger(made, results["expressions"]))


def _test() -> bytes:
    """A test as `sysid read` writes it."""
    K = 1e4 * np.array([[3.0, -1.0, -2.0], [-1.0, 1.0, 0.0], [-2.0, 0.0, 2.0]])
    truth = sysid.Structure(np.diag([3.0, 2.0, 0.0]), K, [0.01, 0.02], n_base=1)
    rng = np.random.default_rng(3)
    base = rng.standard_normal((1, 4000))
    top = truth.simulate(base, 200.0) + 1e-3 * rng.standard_normal((2, 4000))
    columns = {"table": base[0], "low": top[0], "top": top[1]}
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder, "run.npz"), **columns)
        sensors = [
            {"column": name, "role": "base" if name == "table" else "response", "axis": "x", "unit": "m/s²"}
            for name in columns
        ]
        return reading.gather(Path(folder, "run.npz"), {"sample_rate": 200.0, "sensor": sensors}).to_bytes()


def _stopped(folder: Path) -> bytes:
    """The state of a run that was stopped in its swarm."""
    recipe = sysid.Recipe("physical_damping")
    problem, files = catalogue.built(recipe)
    path = folder / "unfinished.h5"
    begun = RunRequest(recipe, "swarm", 0, catalogue.digest(files))
    with contextlib.suppress(sysid.SolverError):
        sysid.identify(problem, strategy="swarm", rng=0, callback=_stop, checkpoint=Checkpoint(path, begun, every=0.0))
    return path.read_bytes()


def _stop(progress: sysid.Progress) -> None:
    if (progress.phase, progress.iteration) == ("swarm", 3):
        raise KeyboardInterrupt


def _ledger(folder: Path, result: bytes) -> bytes:
    """The ledger of one start about a result."""
    (folder / "result.h5").write_bytes(result)
    with contextlib.chdir(folder):
        status, said, _ = _forked(("refine", "result.h5", "--starts", "1", "--workers", "1"), folder)
    if status:
        raise RuntimeError(f"refine of the sound result ended with {status}: {said}")
    return (folder / "refine" / "jobs.sqlite").read_bytes()


class _Known:
    """Numbers of the sound files, beside which those of others are held."""

    def __init__(self, here: Path, sound: Sound) -> None:
        self._here, self._sound = here, sound
        (here / "sound").mkdir()
        for name in ("models", "expressions"):
            (here / "sound" / "result.h5").write_bytes(getattr(sound, name))
            setattr(self, name, _numbers(here / "sound" / "result.h5"))
        with contextlib.redirect_stdout(io.StringIO()):  # what commands import is imported before they are forked
            main(["report", str(here / "sound")])
        (here / "sound" / "report.html").unlink()
        shutil.copytree(here, here.parent / "pure", ignore=lambda folder, names: {"problems", CANARIES} & set(names))
        pure = here.parent / "pure"
        (pure / "test.h5").write_bytes(sound.test)
        status, said, _ = _forked(("run", "test.h5", "--out", "out"), pure)
        if status not in (0, 1):
            raise RuntimeError(f"run of the sound test ended with {status}: {said}")
        self.test = _numbers(pure / "out" / "result.h5")

    def tried(self, file: HandMade, commands: Sequence[tuple[str, ...]]) -> tuple[list[str], list[str], float]:
        """Traces that a file left, faults of how commands ended that were given it, and megabytes that they took."""
        place = self._here / file.place
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(file.content)
        before, faults, most = {*self._here.rglob("*")}, [], 0.0
        for command in commands:
            status, said, megabytes = _forked(command, self._here)
            most = max(most, megabytes)
            fault = self._fault(command, status, said, place)
            if fault:
                faults.append(f"{' '.join(command)}: {fault}")
        written = [
            path for path in {*self._here.rglob("*")} - before if path.suffix in (".html", ".csv", ".py", ".json")
        ]
        faults += [
            f"{path.name} holds what it must not" for path in written if _leaks(path.read_text(errors="replace"))
        ]
        traces = [path.name for path in (self._here / CANARIES).iterdir()]
        return traces, faults, most

    def _fault(self, command: tuple[str, ...], status: int, said: str, place: Path) -> str:
        """Fault in the end of a command; "" where there is none."""
        told = said.splitlines()
        if _leaks(said):
            return f"it tells what it must not: {said!r}"
        if status == 2:
            lines = [line for line in told if not line.startswith("sysid: warning: ")]
            good = len(lines) == 1 and lines[0].startswith("sysid: ") and len(lines[0]) < 1000
            return "" if good or command[0] == "import" else f"it says {said!r}"
        if status not in (0, 1):
            return f"exit status {status}: {said[-300:]!r}"
        if command[0] in ("import", "new"):
            return ""
        found = place.parent.parent / "result.h5" if place.suffix == ".sqlite" else place
        found = self._here / "out" / "result.h5" if command[0] == "run" else found
        same = _numbers(found) in (self.models, self.expressions, self.test)
        return "" if same else "it was taken, with other numbers than the sound file's"


def _numbers(path: Path) -> bytes:
    """Numbers of an answer."""
    with warnings.catch_warnings(action="ignore"):
        structure = sysid.load(path).structure
    return b"".join(np.asarray(part).tobytes() for part in (structure.mass, structure.stiffness, structure.damping))


def _leaks(text: str) -> bool:
    """True where control characters or the bytes of another file stand in a text."""
    return bool(_CONTROL.search(text)) or SECRET.decode() in text


def _forked(command: tuple[str, ...], folder: Path) -> tuple[int, str, float]:
    """Exit status, standard error and megabytes of a command of ``sysid`` in a process of its own.

    A fork of this one, which has imported all that a command needs; modules of the folder could be imported there.
    """
    with tempfile.TemporaryFile("w+") as said:
        pid = os.fork()
        if pid == 0:
            os.dup2(said.fileno(), 2)
            os.dup2(os.open(os.devnull, os.O_RDWR), 1)
            os._exit(_run(command, folder))
        _, status, usage = os.wait4(pid, 0)
        said.seek(0)
        return os.waitstatus_to_exitcode(status), said.read(), usage.ru_maxrss / 1024


def _run(command: tuple[str, ...], folder: Path) -> int:
    """Run a command where its files stand, in a process that ends behind it."""
    status = 99
    resource.setrlimit(resource.RLIMIT_CPU, (_SECONDS, _SECONDS))
    try:
        os.chdir(folder)
        sys.path.insert(0, str(folder))
        sys.stderr, sys.stdout = os.fdopen(2, "w", closefd=False), os.fdopen(1, "w", closefd=False)
        if command[0] == "import":
            if Path(command[1]).exists():
                runpy.run_path(command[1])
            status = 0
        elif command[0] == "load":
            try:
                sysid.load(command[1])
                status = 0
            except sysid.InputError as error:
                print(f"sysid: {' '.join(repr(str(error)).split())}", file=sys.stderr)
                status = 2
        else:
            status = main([*command, "--quiet"])
    except BaseException as error:  # what this looks for
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
    for stream in (sys.stderr, sys.stdout):
        stream.flush()
    return status


def _workers(folder: Path, sound: Sound) -> list[str]:
    """Modules of the standard library's names that workers of `sysid refine` import from where they stand."""
    place = folder / "workers"
    (place / CANARIES).mkdir(parents=True)
    (place / "result.h5").write_bytes(sound.expressions)
    (folder / "command.py").write_text(_COMMAND)
    for module in _STANDARD:
        trace = str(place / CANARIES / module)
        (place / f"{module}.py").write_text(_RUNS.format(trace=trace).replace("import sysid\n", ""))
    command = [sys.executable, str(folder / "command.py"), "refine", "result.h5", "--starts", "2", "--workers", "2"]
    done = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False, timeout=20 * _SECONDS)
    traces = [path.name for path in (place / CANARIES).iterdir()]
    return [*traces, *([f"it ended with {done.returncode}: {done.stderr[-200:]}"] if done.returncode else [])]


def _clean(here: Path, kept: set[Path]) -> None:
    """Take away what commands have left."""
    for path in sorted({*here.rglob("*")} - kept, reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
