"""The result of an identification."""

from __future__ import annotations

import ast
import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import starmap
from pathlib import Path
from typing import Any

import numpy as np

from sysid.errors import InputError, finite_array, instance, refuse, shown, text, whole_number
from sysid.files.tree import to_bytes
from sysid.finding import Finding
from sysid.modal_analysis.response import residual_share
from sysid.problem.prepared import Prepared
from sysid.problem.problem import Problem
from sysid.problem.stated import StatedProblem
from sysid.problem.stored import NotRebuiltError, needs_module
from sysid.results import readings, storage
from sysid.results.answer import Answer
from sysid.results.facts import PartOfProblem, StoredRecords
from sysid.results.summary import summary
from sysid.results.tables import gains_of_sensors, noise_of_channels
from sysid.results.version import __version__
from sysid.search.modal import Modal
from sysid.search.strategy import History
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import NEGLIGIBLE

# Fields that are texts, numbers or arrays themselves.
_PLAIN = (
    "x", "strategy", "interrupted",
)  # fmt: skip


@dataclass(frozen=True)
class Recipe:
    """Recipe that rebuilds a problem elsewhere: its module and what was passed to ``problem()``.

    Attributes
    ----------
    module : str
        As given on the command line: a name, a path, or a dotted module.
    data : str or None
    rng : int
    parameters : dict
        What else is passed to ``problem()``, by name: numbers, texts, bools, None, and lists, tuples and dictionaries
        of them.
    start : array_like (n_variables,), optional
        Unknowns where a refinement starts, such as the `x` of a result.
    modes, sensors : int or None, tuple of str
        Of `Modal`, by which the problem is identified; not passed to ``problem()``.

    Raises
    ------
    InputError
        Where a parameter is something else, or one of the other fields.
    """

    module: str
    data: str | None = None
    rng: int = 0
    parameters: dict[str, Any] = field(default_factory=dict, compare=False)
    start: tuple[float, ...] | None = None
    modes: int | None = None
    sensors: tuple[str, ...] = ()
    # Recipes are compared by their parameters as texts: 1, 1.0 and True are equal in Python.
    _texts: frozenset[tuple[str, str]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        text("Recipe: module", self.module)
        object.__setattr__(self, "rng", whole_number("Recipe: rng", self.rng, at_least=0))
        if self.data is not None:
            text("Recipe: data", self.data)
        named = isinstance(self.parameters, Mapping) and all(isinstance(name, str) for name in self.parameters)
        refuse((not named, "Recipe: parameters is a dictionary from names to values: parameters={'floors': 3}"))
        object.__setattr__(self, "parameters", dict(self.parameters))
        object.__setattr__(self, "_texts", frozenset((name, repr(value)) for name, value in self.parameters.items()))
        if self.start is not None:
            object.__setattr__(self, "start", tuple(finite_array("Recipe: start", self.start).ravel().tolist()))
        if self.modes is not None:
            object.__setattr__(self, "modes", whole_number("Recipe: modes", self.modes, at_least=1))
        object.__setattr__(self, "sensors", tuple(text("Recipe: a sensor", one) for one in self.sensors))
        for name, value in self.parameters.items():
            refuse(
                (name in ("data", "rng"), f"parameter {name!r} is a field of the recipe itself"),
                (not _is_plain(value), f"parameter {name} = {value!r}: give a number, a text, or a list of them"),
            )

    @property
    def title(self) -> str:
        """The module and its parameters: "cantilever_tower (elements=3)"; of a test read from files what was said.

        Such as "test.h5, lumped mass, 103 kg stated".
        """
        asked = [] if self.modes is None else [f"{self.modes} mode{'s' * (self.modes > 1)}"]
        asked += [f"on {', '.join(self.sensors)}"] * bool(self.sensors)
        if self.module == "recorded_test" and self.data:
            return ", ".join([Path(self.data).name, *starmap(_option_in_words, self.parameters.items()), *asked])
        given = ", ".join(f"{name}={value!r}" for name, value in self.parameters.items())
        return ", ".join([f"{self.module} ({given})" if given else self.module, *asked])

    @property
    def modal(self) -> Modal:
        """The modal strategy with the modes and sensors asked for."""
        return Modal(self.sensors or None, modes=self.modes)

    def strategy(self, named: str) -> str | Modal:
        """The strategy to identify the problem by: `named`, or the modal one with the modes and sensors asked for."""
        if self.modes is None and not self.sensors:
            return named
        other = f"--modes and --dofs are of the strategy 'modal', and {named!r} is asked for: leave one of both out"
        refuse((named not in ("auto", Modal.name), other))
        return self.modal

    def to_tree(self) -> dict[str, Any]:
        """Give the fields by their names; `from_tree` takes them back."""
        parameters = {name: repr(value) for name, value in self.parameters.items()}
        # A number of any size, and values of any shape, as texts.
        tree = {"module": self.module, "data": self.data, "rng": str(self.rng), "parameters": parameters}
        start = None if self.start is None else np.array(self.start)
        more = {"start": start, "modes": self.modes, "sensors": list(self.sensors) or None}
        return tree | {name: value for name, value in more.items() if value is not None}

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> Recipe:
        """Give the recipe of a tree that `to_tree` made.

        Raises
        ------
        InputError
            Where a parameter is no plain value of Python's.
        """
        parameters = {name: _literal(name, text) for name, text in tree["parameters"].items()}
        asked = tree.get("modes"), tuple(tree.get("sensors", ()))
        return cls(tree["module"], tree["data"], int(tree["rng"]), parameters, tree.get("start"), *asked)


def _literal(name: str, text: Any) -> Any:
    """The value that a text stands for: a number, a text, a list of them, and no expression."""
    try:
        return ast.literal_eval(str(text))
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
        raise InputError(f"parameter {shown(name)} is {shown(text)}, which is no plain value") from None


def _option_in_words(name: str, value: Any) -> str:
    """Option of a test that was read from files, in words: "0.5-40 Hz"; another parameter as it was given."""
    parts = value if isinstance(value, list | tuple) else [value]
    said = ("-" if name == "band" else " and ").join(str(part).removesuffix(".0") for part in parts)
    words = {
        "mass": f"{said} kg stated", "lumped": "lumped mass" if value else "full mass", "band": f"{said} Hz",
        "goal": f"goal {said}",
    }  # fmt: skip
    return words.get(name, f"{name}={value!r}")


@dataclass(frozen=True, eq=False, repr=False)
class Identification(Answer):
    """A structure identified from a base-shake test, and how far it can be trusted: see `Answer` for its figures.

    Attributes
    ----------
    recipe : Recipe or None
        Set where the problem came from a module.
    """

    recipe: Recipe | None = None

    def __repr__(self) -> str:
        return f"<Identification: {self.judgement}, residual {self.residual:.3g}; {self.structure!r}>"

    def summary(self) -> str:
        """Table of the result, for a terminal."""
        return summary(self)

    def to_dict(self) -> dict[str, Any]:
        """The figures of ``summary.json``; None for what the data leave open or what was not computed."""
        u, values = self.quick_uncertainty, self.values
        std = {} if u is None else u.variables
        facts = self.facts
        reported = () if self.x is None else [v for v in facts.unknowns if facts.tells_damping or not v.is_ratio]
        return {
            "problem": self.recipe.module if self.recipe else None,
            "parameters": self.recipe.parameters if self.recipe else {},
            "modes_asked": self.recipe.modes if self.recipe else None,
            "strategy": self.strategy,
            "seed": self.seed,
            "judgement": self.judgement,
            "confidence": list(self.confidence),
            "success": bool(self.success),
            "message": self.message,
            "residual": self.residual,
            "residuals": list(self.residuals),
            "objective": self.objective,
            "force_residual": self.force_residual,
            "validation_residuals": [test.residual(self.structure) for test in self.validation],
            "natural_frequencies_hz": self.structure.natural_frequencies.tolist(),
            "natural_frequencies_std_hz": _plain(self.quick_std("natural_frequencies")),
            "damping_ratios": _plain(self.identified_ratios),
            "damping_ratios_std": _plain(self.quick_std("damping_ratios")),
            "unknowns": {v.name: values[v.name].tolist() for v in reported},
            "unknowns_std": {v.name: _plain(std[v.name]) for v in reported if v.name in std},
            "unknown_units": {v.name: v.unit for v in reported},
            **self._in_band(),
            "total_mass_kg": np.diag(self.structure.rigid_body_mass).tolist(),
            "total_mass_std_kg": _plain(np.diag(self.quick_std("rigid_body_mass"))),
            "determined": bool(self.determined),
            "closed_by": list(self.closed_by),
            "undetermined": list(self.undetermined),
            "findings": [_figures(one) for one in self.findings],
            "assumptions": [_figures(one) for one in self.assumptions],
            "outliers": [
                {"test": o.test, "run": o.run, "channel": o.channel, "frequency_hz": o.freq, "deviations": o.size}
                for o in self.outliers
            ],
            "noise": [
                {
                    "channel": c.channel,
                    "level": c.level,
                    "unit": c.unit,
                    "percent_of_rms": c.percent,
                    "percent_of_signal": c.signal,
                }
                for c in noise_of_channels(self)
            ],
            "gains": [
                {**one.to_tree(), "deviations_per_percent": _plain(np.array(one.worth))}
                for one in gains_of_sensors(self)
            ],
            "evaluations": int(self.history.evaluations),
            "leaders_tried": int(self.history.leaders_tried),
            "leaders_won": int(self.history.leaders_won),
            "refinement_statuses": dict(self.history.refinement_statuses),
            "wall_time_s": float(self.history.wall_time),
            "version": __version__,
        }

    def _in_band(self) -> dict[str, Any]:
        """Content of the matrices: the band, their rows, effective masses, and residual modes."""
        s, test = self.structure, self.measurement
        share = residual_share(test, s)
        return {
            "band_hz": test.freq[[0, -1]].tolist(),
            "degrees_of_freedom": list(self.degrees_of_freedom),
            "effective_mass_kg": np.einsum("kii->i", s.effective_masses).tolist(),
            "residual_modes": {"count": s.residual.count, "static": s.residual.static, "share_of_response": share},
            "amplitude_laws": [
                {
                    "mode": law.mode + 1,
                    "level_of_mode": law.level_of + 1,
                    "sensor": test.sensor_names[law.sensor],
                    "frequency_at_rest_hz": law.frequency,
                    "damping_ratio_at_rest": law.ratio,
                    "reference_level_m_s2": law.form.level,
                    "exponent_of_frequency": law.form.of_frequency,
                    "exponent_of_damping": law.form.of_damping,
                    "fall_of_frequency": law.values[0],
                    "rise_of_damping": law.values[1],
                    "fall_and_rise_std": np.sqrt(np.diag(law.covariance)[2:]).tolist(),
                    "formula": law.formula,
                    "levels_m_s2": list(law.levels),
                    "frequency_hz": [law.at(level)[0] for level in law.levels],
                    "damping_ratio": [law.at(level)[1] for level in law.levels],
                }
                for law in s.laws
            ],
        }

    def to_tree(self) -> dict[str, Any]:
        """Give everything as dictionaries, lists, arrays, numbers and texts; `from_tree` takes it back."""
        return {
            **{name: getattr(self, name) for name in _PLAIN},
            "structure": self.structure.to_tree(),
            **self._problem_to_tree(),
            "seed": readings.if_given(str, self.seed),  # a number of any size
            "findings": [one.to_tree() for one in self.findings],
            "history": self.history.to_tree(),
            "recipe": readings.if_given(Recipe.to_tree, self.recipe),
        }

    def _problem_to_tree(self) -> dict[str, Any]:
        """The problem, and beside it what readers ask of it, where the tree does not hold it whole."""
        if self.part is not None:
            return {"problem": self.part.tree, "readings": self.part.readings}
        tree = self.prepared.to_tree()
        return {"problem": tree, "readings": readings.answer_to_tree(self) if needs_module(tree["given"]) else None}

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> Identification:
        """Give the identification of a tree that `to_tree` made, exact to the bit.

        Without its problem, where the tree does not hold it whole: `problem` then raises an InputError.
        """
        structure = Structure.from_tree(tree["structure"])
        return cls(
            **{name: tree[name] for name in _PLAIN},
            structure=structure,
            problem=_problem_from_tree(tree, structure),
            seed=readings.if_given(int, tree["seed"]),
            findings=tuple(map(Finding.from_tree, tree["findings"])),
            history=History.from_tree(tree["history"]),
            recipe=readings.if_given(Recipe.from_tree, tree["recipe"]),
        )

    def save(self, path: str | Path) -> Path:
        """Write everything to an HDF5 file, whole or not at all (no pickle inside); `sysid.load` reads it back.

        Parameters
        ----------
        path : str or Path
            The file (``.h5``, ``.hdf5``), or the folder in which it becomes ``result.h5``; folders are made.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        InputError
            Where it cannot be written, or what the user described by objects of another program cannot be stored.

        Warns
        -----
        UserWarning
            Where it is written without the expressions of its problem, of which one holds what cannot be stored.
        """
        tree = self.to_tree()
        written, without = storage.write_tree(tree, path), tree["problem"]["given"]["without"]
        if without is not None and self.part is None:
            warnings.warn(
                f"{written} is without the expressions of its problem, as {without} cannot be stored: to refine it, "
                "give its module again (--module FILE; in Python sysid.load(path, problem=...))",
                stacklevel=2,
            )
        return written

    def with_problem(self, problem: Problem) -> Identification:
        """Give the same with its problem, where a file did not hold it whole.

        Parameters
        ----------
        problem : Problem
            Of the same records and variables; made as it was for the identification.

        Raises
        ------
        InputError
            Where it has other records or other variables, or the unknowns stand for other matrices in it.
        """
        instance("problem", problem, Problem)
        _check_records(self.records, problem)
        prepared = Prepared.from_tree(problem, self._tree_for(problem))
        if self.x is not None:
            _check_unknowns(self, self.x, prepared)
        return replace(self, problem=problem, prepared=prepared)

    def _tree_for(self, problem: Problem) -> dict[str, Any]:
        """What was found of the records, for a problem that may state other things of them: fits of its tests alone."""
        if self.part is None:
            tree, tests = self.prepared.to_tree(), [test.to_tree() for test in self.problem.tests]
        else:
            tree, tests = self.part.tree, [self.part.records.measurement.to_tree()]
        given = [to_bytes(test.to_tree(), 0) for test in problem.tests]
        names, were = ("fits", "delays", "calibrations"), [to_bytes(test, 0) for test in tests]
        known = {name: dict(zip(were, tree.get(name) or (), strict=False)) for name in names}
        return {**tree, **{name: [known[name].get(test) for test in given] for name in names}}


def load(path: str | Path, problem: Problem | None = None) -> Identification:
    """Read an identification that `Identification.save` wrote, exact to the bit.

    Parameters
    ----------
    path : str or Path
        The file, or the folder that holds its ``result.h5``.
    problem : Problem, optional
        What was identified, with the same records and variables: where the file does not hold it whole, because a
        matrix model is a class of the user's own that this process has not imported, or an expression holds what
        cannot be stored. All that does not need it is there without it: figures, summary, report and export.

    Returns
    -------
    Identification
        Whose `problem` raises an InputError where it is needed and not given.

    Raises
    ------
    InputError
        Where there is no such file, or it is not a result of sysid, or damaged, or one of another format, or `problem`
        is another one; names the file.
    """
    result = storage.read_tree(path, Identification.from_tree)
    if problem is None:
        return result
    try:
        return result.with_problem(problem)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _problem_from_tree(tree: dict[str, Any], structure: Structure) -> Any:
    """The problem of a result's tree, or what is there of it."""
    part = tree["problem"]
    try:
        return Problem.from_tree(part)
    except NotRebuiltError as error:
        if tree["readings"] is None:
            raise
        recipe = tree["recipe"]
        module = "" if recipe is None else f" (the problem was made by {recipe['module']!r})"
        read = tree["readings"]
        attributes = readings.answer_from_tree(read, structure)
        return PartOfProblem(part, read, StoredRecords.from_tree(part), attributes, f"{error}{module}")


def _check_records(records: StatedProblem | StoredRecords, problem: Problem) -> None:
    """Refuse a problem of other records."""
    for name in ("freq", "base", "response", "force"):
        ours, other = getattr(records.measurement, name), getattr(problem.measurement, name)
        mistake = f"the problem that was given has other records than the result ({name})"
        remedy = "give the problem of the same test, with the same data and parameters"
        refuse((not np.array_equal(ours, other), f"{mistake}: {remedy}"))


def _check_unknowns(result: Identification, x: Array, problem: Prepared) -> None:
    """Refuse a problem of other unknowns, or in which they stand for other matrices."""
    given = [(unknown.name, unknown.shape) for unknown in problem.variables]
    fixed = {unknown.name for unknown in problem.formulation.fixed}
    its = [(name, np.shape(value)) for name, value in result.values.items() if name not in fixed]
    words = f"{_in_words(given)} instead of {_in_words(its)}"
    refuse((given != its, f"the problem that was given has other unknowns than the result: {words}"))
    structure = problem.structure(x)
    for name in ("mass", "stiffness"):
        one, other = getattr(structure, name), getattr(result.structure, name)
        close = one.shape == other.shape and np.allclose(one, other, NEGLIGIBLE, NEGLIGIBLE * np.abs(other).max())
        mistake = f"the unknowns of the result stand for another {name} matrix in the problem that was given"
        refuse((not close, f"{mistake}: it is not made as it was for the identification"))


def _in_words(unknowns: list[tuple[str, tuple[int, ...]]]) -> str:
    return ", ".join(f"{name} {shape}" if shape else name for name, shape in unknowns) or "none"


def _is_plain(value: Any) -> bool:
    """True where a value can be written as text and read again, here and in JSON."""
    try:
        json.dumps(value, allow_nan=False)
        return bool(ast.literal_eval(repr(value)) == value)
    except (ValueError, TypeError, SyntaxError, RecursionError):
        return False


def _figures(one: Finding) -> dict[str, Any]:
    """A finding by its fields."""
    return {**one._asdict(), "numbers": {name: _plain(np.array(z, float)) for name, z in one.numbers.items()}}


def _plain(values: Array) -> Any:
    """A number, or lists of numbers, of Python's; None for what is not finite."""
    plain = values.astype(object)
    plain[~np.isfinite(values)] = None
    return plain.tolist()
