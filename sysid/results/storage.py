"""Results on disk: one HDF5 file an identification, numbers and text only.

::

    /                  content, format, sysid_version, strategy, seed, success, message, ...   (attributes)
    ├── x              the unknowns
    ├── structure      mass, stiffness, damping_ratios | damping_matrix, recovery, rigid_body, sensors
    ├── problem        goal; measurement, validation/0, validation/1, ..., reference
    │   ├── mass, stiffness, damping      the models: their kind and their fields
    │   └── formulation    in their place, for a problem in its own unknowns: variables and CasADi functions as text
    ├── history        residual after each phase, both curves, states, log
    └── recipe         module, data, rng
"""

from __future__ import annotations

import contextlib
import io
import os
import secrets
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement, Sensor
from sysid.models.damping import ModalDamping, ProportionalDamping
from sysid.models.mass import FullMass, KnownMass, LumpedMass
from sysid.models.stiffness import ChainStiffness, SpectralStiffness
from sysid.problem.problem import Problem
from sysid.problem.stored import read as read_formulation
from sysid.problem.stored import write as write_formulation
from sysid.results.identification import Identification, Recipe
from sysid.search.strategy import History
from sysid.structure.structure import Structure

CONTENT = "sysid identification"
FORMAT = 2  # rises where an older sysid could not read the file: 2 holds problems in their own unknowns
FILE_NAME = "result.h5"

_SUFFIXES = (".h5", ".hdf5")
_MODELS = {
    kind.__name__: kind
    for kind in (
        FullMass, LumpedMass, KnownMass, SpectralStiffness, ChainStiffness, ModalDamping, ProportionalDamping,
    )
}  # fmt: skip
_TUPLES = (ProportionalDamping,)  # whose fields are pairs, and not arrays


def save(identification: Identification, path: str | Path) -> Path:
    """Write an identification to an HDF5 file, whole or not at all.

    Parameters
    ----------
    identification : Identification
    path : str or Path
        The file (``.h5``, ``.hdf5``), or the folder in which it becomes ``result.h5``; folders are made.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    import h5py

    target = file_or_folder(path, FILE_NAME, _SUFFIXES)
    # Built in memory: on a full disk HDF5 loses the error when it closes, or takes the process down.
    image = io.BytesIO()
    with h5py.File(image, "w") as file:
        _write(file, identification)
    with atomically(target) as temporary:
        temporary.write_bytes(image.getbuffer())
    return target


def load(path: str | Path) -> Identification:
    """Read an identification that `save` wrote, exact to the bit.

    Parameters
    ----------
    path : str or Path
        The file, or the folder that holds its ``result.h5``.

    Returns
    -------
    Identification

    Raises
    ------
    InputError
        Where there is no such file, or it is not a result of sysid, or one of a later format.
    """
    import h5py

    source = Path(path)
    if source.is_dir():
        source = source / FILE_NAME
    if not source.is_file():
        raise InputError(f"no result at {source}: give the .h5 file that 'sysid run' wrote, or its folder")
    try:
        if not h5py.is_hdf5(source):
            raise InputError(f"{source} is not an HDF5 file, so it is no result of sysid")
        with h5py.File(source, "r") as file:
            if _get(file.attrs, "content") != CONTENT:
                raise InputError(f"{source} is an HDF5 file, but not a result of sysid")
            if (number := int(file.attrs.get("format", 0))) > FORMAT:
                raise InputError(
                    f"{source} has format {number} (sysid {_get(file.attrs, 'sysid_version')}), and this one reads "
                    f"up to {FORMAT}: a later sysid is needed"
                )
            try:
                return _read(file)
            except (KeyError, TypeError, ValueError) as error:
                raise InputError(f"{source} is damaged: {error.args[0] if error.args else error}") from error
    except OSError as error:
        raise InputError(f"{source} cannot be read: {error.strerror or error}") from error


def file_or_folder(path: str | Path, name: str, suffixes: Sequence[str]) -> Path:
    """Give the file to write where a path may be that file or the folder for it.

    Parameters
    ----------
    path : str or Path
    name : str
        What the file is called in a folder.
    suffixes : sequence of str
        Endings that tell a file from a folder, the usual one first.

    Returns
    -------
    Path

    Raises
    ------
    InputError
        Where `path` is a file with another ending, which is somebody else's.
    """
    target = Path(path)
    if target.suffix.lower() in suffixes:
        return target
    if target.is_file():
        raise InputError(f"{target} is some other file: give a name that ends in {suffixes[0]}, or a folder")
    return target / name


@contextlib.contextmanager
def atomically(path: Path) -> Iterator[Path]:
    """Give a temporary file beside `path` that takes its place at the end, and vanishes after any failure.

    Parameters
    ----------
    path : Path
        What to write; its folder is made.

    Yields
    ------
    Path
        Where to write it.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)  # noqa: PTH105 - the atomic one; its name says so
    except BaseException as error:  # Ctrl-C too leaves nothing half-written
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise InputError(f"{path} cannot be written: {error.strerror or error}") from error
        raise


def _write(file: Any, identification: Identification) -> None:
    from sysid import __version__

    it = identification
    _put(file.attrs, content=CONTENT, format=FORMAT if it.problem.is_written else 1, sysid_version=__version__)
    _put(
        file.attrs, strategy=it.strategy, seed=it.seed, success=it.success, message=it.message,
        determined=it.determined, interrupted=it.interrupted,
    )  # fmt: skip
    _put(file, x=it.x, closed_by=list(it.closed_by), undetermined=list(it.undetermined), remarks=list(it.remarks))
    _write_structure(file.create_group("structure"), it.structure)

    problem = file.create_group("problem")
    _put(problem.attrs, goal=it.problem.goal)
    _write_measurement(problem.create_group("measurement"), it.problem.measurement)
    for i, test in enumerate(it.problem.validation):
        _write_measurement(problem.create_group(f"validation/{i}"), test)
    if it.problem.reference is not None:
        _write_structure(problem.create_group("reference"), it.problem.reference)
    if it.problem.is_written:
        write_formulation(problem.create_group("formulation"), it.problem.formulation, _put, _write_measurement)
    for name in () if it.problem.is_written else ("mass", "stiffness", "damping"):
        model = getattr(it.problem, name)
        group = problem.create_group(name)
        _put(group.attrs, kind=type(model).__name__)
        for field in fields(model):
            value = getattr(model, field.name)
            _put(group, **{field.name: value if isinstance(value, str) or value is None else np.asarray(value, float)})

    history = file.create_group("history")
    for field in fields(History):
        value = getattr(it.history, field.name)
        if field.name == "states":
            _put(history, states=[name for name, _ in value], state_counts=np.array([n for _, n in value], np.int64))
        else:
            _put(history, **{field.name: list(value) if isinstance(value, tuple) else value})
    if it.recipe is not None:
        _put(file.create_group("recipe").attrs, module=it.recipe.module, data=it.recipe.data, rng=it.recipe.rng)


def _read(file: Any) -> Identification:
    group = file["problem"]
    tests = group.get("validation", {})
    given, untold = _read_models(group)
    problem = Problem(
        _read_measurement(group["measurement"]),
        **given,
        reference=_read_structure(group["reference"]) if "reference" in group else None,
        validation=[_read_measurement(tests[str(i)]) for i in range(len(tests))],
        goal=_get(group.attrs, "goal"),
    )
    if untold:
        vars(problem)["formulation"] = replace(problem.formulation, **untold)
    stored = {field.name: _get(file["history"], field.name) for field in fields(History)}
    counts = file["history/state_counts"][()].tolist()
    stored["states"] = tuple(zip(stored["states"], counts, strict=True))
    attrs, recipe = file.attrs, file.get("recipe")
    seed = _get(attrs, "seed")
    return Identification(
        structure=_read_structure(file["structure"]),
        problem=problem,
        x=_get(file, "x"),
        strategy=_get(attrs, "strategy"),
        seed=None if seed is None else int(seed),
        success=_get(attrs, "success"),
        message=_get(attrs, "message"),
        history=History(**stored),
        determined=_get(attrs, "determined"),
        closed_by=_get(file, "closed_by"),
        undetermined=_get(file, "undetermined"),
        remarks=_get(file, "remarks") or (),  # the first files of this format have none
        interrupted=_get(attrs, "interrupted"),
        recipe=None if recipe is None else Recipe(*(_get(recipe.attrs, f.name) for f in fields(Recipe))),
    )


def _write_structure(group: Any, structure: Structure) -> None:
    modal = structure.modal_damping  # which of the two was given; the other follows from it
    damping = {"damping_ratios": structure.damping_ratios} if modal else {"damping_matrix": structure.damping}
    _put(group.attrs, n_base=structure.n_base)
    _put(
        group, mass=structure.mass, stiffness=structure.stiffness, recovery=structure.recovery,
        rigid_body=structure.rigid_body, **damping,
    )  # fmt: skip
    _write_sensors(group, structure.sensors)


def _read_structure(group: Any) -> Structure:
    return Structure(
        group["mass"][()],
        group["stiffness"][()],
        _get(group, "damping_ratios"),
        n_base=_get(group.attrs, "n_base"),
        damping_matrix=_get(group, "damping_matrix"),
        recovery=group["recovery"][()],
        rigid_body=group["rigid_body"][()],
        sensors=_read_sensors(group),
    )


def _write_measurement(group: Any, test: Measurement) -> None:
    _put(
        group, freq=test.freq, base=test.base, response=test.response, rigid_body=test.rigid_body, force=test.force,
        response_std=test.response_std, force_std=test.force_std, base_axes=list(test.base_axes or ()),
    )  # fmt: skip
    _write_sensors(group, test.sensors)


def _read_measurement(group: Any) -> Measurement:
    return Measurement(
        group["freq"][()],
        group["base"][()],
        group["response"][()],
        rigid_body=group["rigid_body"][()],
        force=_get(group, "force"),
        sensors=_read_sensors(group),
        response_std=_get(group, "response_std"),
        force_std=_get(group, "force_std"),
        base_axes=_get(group, "base_axes"),
    )


def _read_models(group: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    if "formulation" in group:
        return read_formulation(group["formulation"], _get, _read_measurement)
    return {name: _read_model(group[name]) for name in ("mass", "stiffness", "damping")}, {}


def _read_model(group: Any) -> Any:
    kind = _MODELS.get(name := _get(group.attrs, "kind"))
    if kind is None:
        raise InputError(f"model {name!r} is unknown")
    values = {field.name: _get(group, field.name) for field in fields(kind)}
    if kind in _TUPLES:
        values = {key: tuple(value.tolist()) for key, value in values.items()}
    return kind(**values)


def _write_sensors(group: Any, sensors: Sequence[Any] | None) -> None:
    """Names, positions, and axes: each a word, or empty where a vector stands for it."""
    if sensors is None:
        return
    for sensor in sensors:
        if not isinstance(sensor, Sensor):
            raise InputError(f"a sensor is described by a {type(sensor).__name__}; only a sysid.Sensor can be saved")
    words = [s.axis if isinstance(s.axis, str) else "" for s in sensors]
    vectors = [(0.0, 0.0, 0.0) if isinstance(s.axis, str) else s.axis for s in sensors]
    _put(
        group.create_group("sensors"), name=[s.name for s in sensors], axis=words,
        axis_vector=np.array(vectors, float), position=np.array([s.position for s in sensors], float),
    )  # fmt: skip


def _read_sensors(group: Any) -> tuple[Sensor, ...] | None:
    if "sensors" not in group:
        return None
    group = group["sensors"]
    rows = zip(
        _get(group, "name"), group["position"][()].tolist(), _get(group, "axis"), group["axis_vector"][()].tolist(),
        strict=True,
    )  # fmt: skip
    return tuple(Sensor(name, tuple(position), word or tuple(vector)) for name, position, word, vector in rows)


def _put(place: Any, **values: Any) -> None:
    """Store numbers, arrays, a text or a list of texts in a group or its attributes; None is left out.

    Texts have a fixed length: those of free length are stored as objects, which fewer programs read.
    """
    for name, value in values.items():
        if value is None:
            continue
        if isinstance(value, str):
            value = _text([value])[0]
        elif isinstance(value, list):
            value = _text(value)
        elif isinstance(value, int) and not isinstance(value, bool):
            # A seed has any size.
            value = np.int64(value) if -(2**63) <= value < 2**63 else _text([str(value)])[0]
        place[name] = value


def _text(values: list[str]) -> Any:
    import h5py

    encoded = [value.encode("utf-8", "surrogatepass") for value in values]
    return np.array(encoded, dtype=h5py.string_dtype("utf-8", max([1, *map(len, encoded)])))


def _get(place: Any, name: str) -> Any:
    """Give what `_put` stored: str, tuple of str, bool, int, float or array; None where it was left out."""
    if name not in place:
        return None
    value = place[name]
    value = np.asarray(value[()] if hasattr(value, "shape") and hasattr(value, "file") else value)
    if value.dtype.kind in "SO":
        texts = tuple(bytes(v).decode("utf-8", "surrogatepass") for v in value.ravel().tolist())
        return texts if value.ndim else texts[0]
    return value if value.ndim else value.item()
