"""Problem modules: where they are, what they are called, and how one becomes a `Problem`."""

from __future__ import annotations

import ast
import difflib
import dis
import hashlib
import importlib
import importlib.machinery
import importlib.util
import inspect
import os
import re
import sys
import traceback
import zlib
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from sysid.errors import InputError, refuse
from sysid.models.unknowns import NO_COMPLEX, NO_TRUTH, declared
from sysid.problem.problem import Problem
from sysid.problem.stored import BESIDE, PROBLEM_MODULE
from sysid.results.identification import Recipe

_SIGNATURE = "def problem(*, data=None, rng=0) -> sysid.Problem"


@dataclass(frozen=True)
class Entry:
    """A problem that can be run by its name."""

    name: str
    path: Path
    bundled: bool  # it comes with the package, and is not one of the user's own ``./problems``
    description: str  # first line of the module's docstring


def bundled_folder() -> Path:
    """Folder of the problems that come with the package.

    An installed wheel has them inside the package, a checkout beside it.
    """
    package = Path(__file__).parent
    inside = package / "bundled_problems"
    return inside if inside.is_dir() else package.parent / "problems"


def user_folder() -> Path:
    """Folder of the user's own problems: ``./problems``."""
    return Path("problems")


def entries() -> tuple[Entry, ...]:
    """Problems that can be run by name, alphabetically; at the command line the user's own hide bundled ones.

    Modules are read, not imported.
    """
    paths = {path.stem: path for folder in (bundled_folder(), user_folder()) for path in _modules(folder)}
    home = bundled_folder().resolve()
    return tuple(
        Entry(name, path, path.resolve().parent == home, _first_line(path)) for name, path in sorted(paths.items())
    )


def short_name(problem: str) -> str:
    """Name for a folder of results: the stem of a file, the last part of a dotted module."""
    if _is_path(problem):
        return Path(problem).stem
    return problem.rpartition(".")[2]


def build(recipe: Recipe) -> Problem:
    """Load a problem module and call its ``problem()``.

    The recipe's ``module`` is a path to a module, which ends in .py, else a bundled problem, else a module in
    ``./problems``, else a dotted module that Python can import. ``data`` reaches ``problem()`` as a `pathlib.Path`, or
    as None, ``parameters`` each by its name. An InputError tells whatever is wrong with the module, its data or what it
    gives, a problem that cannot be searched too; one from inside the module passes as it is, any other exception is
    told with its line of the module.
    """
    return built(recipe)[0]


def built(recipe: Recipe, *, check: bool = True) -> tuple[Problem, frozenset[Path]]:
    """The problem that `build` gives, and the files it was made from: the module, and what that imported beside itself.

    Of a dotted module, which Python imports, the module alone. Without `check` a problem that cannot be searched is not
    refused, for which poles may be looked for: `identify` does it too.
    """
    data = None if recipe.data is None else Path(recipe.data)
    if recipe.data is not None and not os.path.exists(recipe.data):  # noqa: PTH110 - a path may be "", or too long
        raise InputError(
            f"data {recipe.data!r}: there is no such file or folder; where a result names it, put it there, or work in "
            "the folder that the result was made in"
        )
    before = len(declared())
    with _neighbours(file_of(recipe.module)) as imported:
        function, path = _function(recipe.module)
        signature = inspect.signature(function)
        try:
            signature.bind_partial(data=data, rng=recipe.rng)
        except TypeError as error:
            raise InputError(f"{path}: problem() does not take data and rng ({error}); write {_SIGNATURE}") from None
        try:
            signature.bind(data=data, rng=recipe.rng, **recipe.parameters)
        except TypeError as error:
            raise InputError(f"{path}: problem() {error}; {_in_words(signature)}") from None
        for name, value in recipe.parameters.items():
            if isinstance(value, str) and isinstance(signature.parameters[name].default, bool):
                raise InputError(f"{path}: {name} = {value!r}; give True or False")
        with _telling_the_line(path):
            problem = function(data=data, rng=recipe.rng, **recipe.parameters)
    if not isinstance(problem, Problem):
        raise InputError(f"{path}: problem() gives a {type(problem).__name__}, not a sysid.Problem")
    used = set(problem.declared.variables)
    idle = [variable for variable in declared()[before:] if variable not in used]
    if idle:
        names = ", ".join(f"{variable.name!r} ({variable.declared})" for variable in idle)
        raise InputError(f"{path}: variable {names} enters no matrix, residual or constraint: use it, or take it out")
    if check:
        problem.check()
    return problem, frozenset({path.absolute(), *imported})


def digest(files: Collection[Path]) -> str:
    """SHA-256 of some files, by what stands in them and their places beside each other, wherever their folder is."""
    home, texts = os.path.commonpath([file.parent for file in files]), []
    try:
        for file in sorted(file for file in files if file.is_file()):
            with file.open("rb") as content:
                texts.append((str(file.relative_to(home)), hashlib.file_digest(content, "sha256").hexdigest()))
    except OSError as error:
        raise InputError(f"{error.filename} cannot be read: {error.strerror or error}") from error
    return hashlib.sha256(repr(texts).encode()).hexdigest()


def parameters_in_words(problem: str) -> str:
    """The keyword parameters of a problem module beside data and rng, for a message."""
    with _neighbours(file_of(problem)):
        return _in_words(inspect.signature(_function(problem)[0]))


def _in_words(signature: inspect.Signature) -> str:
    parameters = [value for name, value in signature.parameters.items() if name not in ("data", "rng")]
    listing = ", ".join(" ".join(str(value.replace(annotation=value.empty)).split()) for value in parameters)
    return f"parameters of this module: {listing or 'none'}"


def _function(name: str) -> tuple[Callable[..., object], Path]:
    """The function ``problem()`` of a module; also the path that messages call it by."""
    module, path = _load(name)
    function = getattr(module, "problem", None)
    if not callable(function):
        raise InputError(f"{path} has no function problem(); it needs one: {_SIGNATURE}")
    return function, path


def file_of(name: str) -> Path | None:
    """The file of a problem module; None where it is a dotted module, or unknown.

    What stands in the working folder hides no bundled problem here: a recipe may come from a file.
    """
    if _is_path(name):
        return Path(name)
    return _in_folder(bundled_folder(), name) or _in_folder(user_folder(), name)


def typed(name: str) -> tuple[str, str]:
    """The module that a name at the command line means, and a remark: the user's own problem hides a bundled one."""
    of_user = None if _is_path(name) else _in_folder(user_folder(), name)
    bundled = _in_folder(bundled_folder(), name)
    if of_user is None or bundled is None or of_user.read_bytes() == bundled.read_bytes():  # the last in a checkout
        return name, ""
    return str(of_user), f"{of_user} hides the bundled problem {name}: it is taken"


def is_bundled(name: str) -> bool:
    """True where a recipe's module is a problem that comes with the package."""
    return not _is_path(name) and _in_folder(bundled_folder(), name) is not None


def _in_folder(folder: Path, name: str) -> Path | None:
    """The problem of a name in a folder."""
    path = folder / f"{name}.py"
    return path if path in _modules(folder) else None


def _load(name: str) -> tuple[ModuleType, Path]:
    """Import a problem module; also the path that messages call it by."""
    file = file_of(name)
    if file is not None or os.path.isfile(name):  # noqa: PTH113 - a name may be too long for a path
        return _load_file(file or Path(name))
    parts = name.split(".")
    if len(parts) > 1 and all(part.isidentifier() for part in parts):
        return _load_dotted(name)
    raise _unknown(name)


def _load_file(path: Path) -> tuple[ModuleType, Path]:
    """Run a file as a module of a private name; no ``__pycache__`` is left beside it."""
    try:
        other = (
            f"problem {path}: the name of a problem module ends in .py; 'sysid read FILE --out TEST.h5' makes a test "
            "of a logger's file, 'sysid run TEST.h5' runs it, and 'sysid new NAME --data TEST.h5' makes a module of it"
        )
        hint = "; 'sysid show' tells of a result, 'sysid new' makes a problem" * (path / "result.h5").is_file()
        refuse(
            # A device, or a pipe, may never end; a test or a result that somebody else made may hold Python.
            (path.exists() and not path.is_file(), f"problem {path} is not a file{hint}"),
            (path.exists() and path.suffix != ".py", other),
        )
        source = path.read_bytes()
    except OSError as error:
        raise InputError(f"problem {path} cannot be read: {error.strerror or error}") from None
    full, name = path.absolute(), _private_name(path)
    loader = importlib.machinery.SourceFileLoader(name, str(full))
    spec = importlib.util.spec_from_file_location(name, full, loader=loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    # Dataclasses and pickles look their module up by its name; of two of the same text the later one counts.
    sys.modules.pop(name, None)
    sys.modules[name] = module
    try:
        with _telling_the_line(path):
            # dont_inherit: this file's own __future__ imports are not the module's.
            exec(compile(source, str(full), "exec", dont_inherit=True), module.__dict__)
    except BaseException:
        del sys.modules[name]
        raise
    return module, path


def _private_name(path: Path) -> str:
    """Name of the module of a file in Python: it hides no other, and tells files of one name apart."""
    return f"{PROBLEM_MODULE}{zlib.crc32(os.fsencode(path.absolute())):08x}_{path.stem}"


def _load_dotted(name: str) -> tuple[ModuleType, Path]:
    """Import a module by its dotted name, as Python does."""
    with _telling_the_line(Path(name)):  # finding a.b.c imports a and a.b
        try:
            spec = importlib.util.find_spec(name)
        except ModuleNotFoundError as error:
            if error.name is None or not f"{name}.".startswith(f"{error.name}."):
                raise
            spec = None
    if spec is None:
        raise _unknown(name)
    path = Path(spec.origin) if spec.has_location and spec.origin else Path(name)
    with _telling_the_line(path):
        return importlib.import_module(name), path


@contextmanager
def _neighbours(module: Path | None) -> Iterator[set[Path]]:
    """Let a module of the user's import the files and packages beside it, and gather the files at the end.

    They are imported anew for each problem, also where the script at hand has imported them, and then forgotten by all
    but their problem: their text may change, and another folder may have some of the same name. No ``__pycache__`` is
    left beside them.
    """
    files: set[Path] = set()
    if module is None:
        yield files
        return
    folder, writes_none = str(module.absolute().parent), sys.dont_write_bytecode
    others = _taken_out(folder)
    sys.path.insert(0, folder)
    sys.dont_write_bytecode = True
    try:
        yield files
    finally:
        sys.dont_write_bytecode = writes_none
        imported = _taken_out(folder)
        if (problem := sys.modules.get(_private_name(module))) is not None:
            vars(problem).setdefault(BESIDE, {}).update(imported)
        files.update(Path(m.__file__) for m in imported.values() if m.__file__ is not None)
        with suppress(ValueError):  # the module may have set a path of its own
            sys.path.remove(folder)
        sys.modules.update(others)


def _taken_out(folder: str) -> dict[str, ModuleType]:
    """Take out of Python the modules from files and packages of a folder.

    But for sysid, the script that runs, and packages with compiled parts: many of those cannot be imported twice.
    """
    found, staying, within = {}, {"sysid", "__main__"}, folder.rstrip(os.sep) + os.sep
    for name, module in list(sys.modules.items()):
        given, top = getattr(module, "__dict__", {}), name.partition(".")[0]
        # A package without __init__.py has no file, but a path.
        for place in [given["__file__"]] if given.get("__file__") else given.get("__path__", ()):
            inside = str(place).removeprefix(within)
            if inside != place and inside.partition(os.sep)[0].partition(".")[0] == top:
                found[name] = module
                if inside.endswith(tuple(importlib.machinery.EXTENSION_SUFFIXES)):
                    staying.add(top)
    found = {name: module for name, module in found.items() if name.partition(".")[0] not in staying}
    for name in found:
        del sys.modules[name]
    return found


@contextmanager
def _telling_the_line(path: Path) -> Iterator[None]:
    """Turn an exception of the user's module at `path` into an InputError that tells its line."""
    full = str(path.absolute())
    try:
        yield
    except InputError:
        raise
    except KeyboardInterrupt as interrupt:
        if not _was_raised(interrupt, full):
            raise
        raise InputError(f"{path} raised KeyboardInterrupt, which is Ctrl-C's alone") from interrupt
    except (Exception, SystemExit) as error:
        if isinstance(error, SyntaxError) and error.filename == full:
            raise InputError(f"{path}, line {error.lineno}: syntax error: {error.msg}") from None
        lines = [line for frame, line in traceback.walk_tb(error.__traceback__) if frame.f_code.co_filename == full]
        where = f"{path}, line {lines[-1]}" if lines else f"{path}"
        raise InputError(f"{where}: {_exception_in_words(error)}") from error


def _exception_in_words(error: BaseException) -> str:
    """Message of an exception of a module; of what CasADi cannot do with expressions, what to write instead."""
    said = str(error)
    if "truth value of a numeric MX" in said:
        return NO_TRUTH
    if isinstance(error, TypeError) and "MX" in said and re.search(r"complex|\d\.?j\b", said):
        return NO_COMPLEX
    return f"{type(error).__name__}: {said}".removesuffix(": ")


def _was_raised(interrupt: KeyboardInterrupt, file: str) -> bool:
    """True where a statement of a file raised it, and not Ctrl-C at some other instruction."""
    last = interrupt.__traceback__
    assert last is not None
    while last.tb_next is not None:
        last = last.tb_next
    code = last.tb_frame.f_code
    return code.co_filename == file and dis.opname[code.co_code[last.tb_lasti]] == "RAISE_VARARGS"


def _unknown(name: str) -> InputError:
    names = [entry.name for entry in entries()]
    if os.path.isfile(f"{name}.py"):  # noqa: PTH113 - a name may be too long for a path
        return InputError(f"problem {name!r} is unknown, but there is a {name}.py here: sysid run {name}.py")
    close = difflib.get_close_matches(name, names, n=1)
    hint = "".join(f"did you mean {near!r}? " for near in close)
    known = ", ".join(names) or "none"
    return InputError(f"problem {name!r} is unknown: {hint}known are {known}; a path to a module does as well")


def _is_path(name: str) -> bool:
    return name.endswith(".py") or os.sep in name or (os.altsep or os.sep) in name


def _modules(folder: Path) -> list[Path]:
    """Files of `folder` that can be problems."""
    try:
        return sorted(p for p in folder.glob("*.py") if not p.name.startswith("_"))
    except OSError:
        return []


def _first_line(path: Path) -> str:
    try:
        text = ast.get_docstring(ast.parse(path.read_bytes())) or ""
    except OSError as error:
        return f"(cannot be read: {error.strerror})"
    except SyntaxError as error:
        return f"(syntax error in line {error.lineno})"
    except (ValueError, RecursionError, MemoryError) as error:
        return f"(no Python source: {error})"
    return text.strip().partition("\n")[0]
