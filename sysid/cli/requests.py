"""Tell what a command is asked to work on: the recipe of a problem, the run, the result; and which code may run.

A result or the state of an unfinished run names its problem module, and whoever made the file chose the name. Problems
that come with the package run freely; all else has to be named, or trusted (``--trust``), by the user.
"""

from __future__ import annotations

import argparse
import ast
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

from sysid import catalogue
from sysid.cli.arguments import TRUST
from sysid.cli.output import Output, results_folder
from sysid.errors import InputError, refuse, shown
from sysid.files import recorded_test
from sysid.results.checkpoint import FILE_NAME, Checkpoint, RunRequest
from sysid.results.identification import Identification, Recipe, load
from sysid.search.auto import NAMED
from sysid.search.strategy import Strategy
from sysid.search.swarm import Swarm

_MODULE = "recorded_test"  # the bundled problem that takes what ``sysid read`` writes


def recipe_of(options: argparse.Namespace, out: Output, rng: int | None = None) -> Recipe:
    """The recipe that the arguments of a command make; ``data`` and ``rng`` may be set like parameters, too.

    `rng` is the seed of the simulated noise, where the command has an option of its own for it. Where something is not
    KEY=VALUE or is set twice, the InputError names the parameters of the module.
    """
    module = typed_module(options.problem, out)
    given: dict[str, str] = {}
    elsewhere = {"data": options.data, "rng": rng}
    for setting in options.settings:
        name, equals, text = setting.partition("=")
        if not (equals and name.isidentifier()):
            raise _mistake(module, f"--set {setting!r} is not KEY=VALUE")
        if name in given or elsewhere.get(name) is not None:
            raise _mistake(module, f"parameter {name!r} is set twice")
        given[name] = text
    data, seed = given.pop("data", options.data), _value(given.pop("rng", str(rng or 0)))
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise _mistake(module, f"rng = {seed!r} is not a nonnegative integer")
    parameters = {name: _value(text) for name, text in given.items()}
    return Recipe(module, data, seed, parameters, modes=options.modes, sensors=options.dofs)


def _value(text: str) -> Any:
    """The value of a text in Python, else the text."""
    try:
        return ast.literal_eval(text)
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
        return text


def _mistake(module: str, what: str) -> InputError:
    return InputError(f"{what}; {catalogue.parameters_in_words(module)}")


def typed_module(name: str, out: Output) -> str:
    """A problem as the user typed it, for a recipe; that an own problem hides a bundled one is told."""
    module, remark = catalogue.typed(name)
    if remark:
        out.warn(remark)
    return module


def check_trust(recipe: Recipe, source: Path, instead: str, options: argparse.Namespace) -> None:
    """Refuse a recipe that a file, `source`, holds, where its module is not of the package and nobody trusts it.

    `instead` tells how the user names the module.
    """
    if catalogue.is_bundled(recipe.module) or options.trust:
        return
    file = catalogue.file_of(recipe.module)
    place = shown(recipe.module) if file is None else file.absolute()
    if file is not None and not file.exists():
        raise InputError(f"{source} names the problem module {place}, which is not here: get and name it: {instead}")
    raise InputError(
        f"{source} names the problem module {place}, whose code would run: say {TRUST} where you know what stands in "
        f"it, or name the module yourself: {instead}"
    )


def read_result(options: argparse.Namespace, out: Output) -> Identification:
    """The result; its problem made anew where a module is named, which has to make the same one."""
    result = load(options.result)
    if options.module is None:
        return result
    module = typed_module(options.module, out)
    return with_problem_of(result, replace(result.recipe or Recipe(module), module=module), options.result)


def with_problem_of(result: Identification, recipe: Recipe, source: str | Path) -> Identification:
    """The result with the problem that a recipe makes."""
    problem = catalogue.build(replace(recipe, start=None))
    try:
        return result.with_problem(problem)
    except InputError as error:
        raise InputError(f"{source}, with {recipe.title}: {error}") from error


def is_test(name: str | None) -> bool:
    """True where a problem is called by the file of a test."""
    return name is not None and name.endswith(".h5")


def _test_recipe(options: argparse.Namespace, given: Recipe) -> Recipe:
    """The recipe of a run of a test file: the bundled problem, with the test as its data."""
    extra = _of_tests(options)
    if not is_test(given.module):
        words = "--mass, --lumped, --band, --gain-std, --at-rest, --amplitude and --goal are for a test that"
        instead = "what a module's problem() takes is said by --set KEY=VALUE"
        refuse((extra, f"{words} 'sysid read' wrote; {instead}"))
        return given
    twice = [name for name in extra if name in given.parameters]
    refuse(
        (twice, f"parameter {', '.join(map(repr, twice))} is set twice"),
        (given.data is not None, f"--data {given.data}: {given.module} is the data already"),
    )
    recorded_test.load(given.module)  # told before anything is made
    return replace(given, module=_MODULE, data=given.module, parameters={**given.parameters, **extra})


def _of_tests(options: argparse.Namespace) -> dict[str, Any]:
    """What is said by the options that are for tests."""
    names = ("lumped", "mass", "band", "goal", "gain_std", "at_rest", "amplitude")
    return {name: value for name in names if (value := getattr(options, name)) is not None}


def tell_excited_band(recipe: Recipe, out: Output) -> None:
    """Tell the band that the base excites, of a run of records that ``sysid read`` wrote, and whether it is fitted."""
    if recipe.module == _MODULE and recipe.data is not None:
        asked = recipe.parameters
        others = asked.get("band") is not None or asked.get("estimator") not in (None, "records")
        use = "other lines were asked for" if others else "these lines are fitted, and --band LOW-HIGH takes others"
        tell_band(recorded_test.load(recipe.data), use, out)


def tell_band(test: recorded_test.RecordedTest, use: str, out: Output) -> None:
    """Write the band that the base excites, and what it is used for; nothing of spectra."""
    if (band := test.excited_band) is not None:
        out.write(f"the base excites {band[0]:.4g} to {band[1]:.4g} Hz: {use}\n")
        out.answer(excited_band_hz=list(band))


def folder_of(options: argparse.Namespace, out: Output) -> Path:
    """The folder of results that the arguments of ``run`` ask for."""
    if options.resume is None:
        return results_folder(options.out, Path("results") / _name(_asked(options, out).recipe))
    refuse((options.fresh or options.out is not None, "--resume excludes --fresh and --out"))
    return results_folder(options.resume, Path(options.resume))


def requested_run(options: argparse.Namespace, folder: Path, out: Output) -> RunRequest:
    """The search that the arguments of ``run`` ask for, in the folder of its results.

    Refused where the folder holds an unfinished search and nothing is said of it, or another one than is to be resumed.
    """
    if options.resume is not None:
        return _resumed(options, folder, out)
    search = _asked(options, out)
    checkpoint = Checkpoint(folder / FILE_NAME)
    if checkpoint.exists and not options.fresh:
        words = f"{folder} holds {_in_words(checkpoint, search)}: '{resuming_command(search, folder)}' goes on with it,"
        raise InputError(f"{words} --fresh begins anew, --out DIR writes elsewhere")
    return search


def resuming_command(search: RunRequest, folder: Path) -> str:
    """The command that goes on with a search; a module that is not of the package is named again."""
    module = search.recipe.module
    return f"sysid run {'' if catalogue.is_bundled(module) else f'{module} '}--resume {folder}"


def strategy_of(search: RunRequest) -> str | Strategy:
    """The strategy of a search, with the modes or the eigenvalue refinement that were asked for; or a refusal."""
    if search.refine_by is None:
        return search.recipe.strategy(search.strategy)
    chosen = NAMED[search.strategy]() if search.strategy in NAMED else None
    if not isinstance(chosen, Swarm):
        raise InputError(
            f"--refine-by is of the strategies 'swarm' and 'hpso-ls', and the strategy is {search.strategy!r}: leave "
            "it out, or give --strategy swarm or hpso-ls"
        )
    return replace(chosen, refine_by=search.refine_by)


def with_source(search: RunRequest, files: Collection[Path], folder: Path) -> RunRequest:
    """The search with the digest of the files that its problem was made from; refused where it began with others."""
    source = catalogue.digest(files)
    edited = (
        f"{folder} holds an unfinished run of {search}, and since it began its module or what this imports from "
        f"beside itself was edited: give the problem with --out {folder} --fresh to begin anew, or undo the edit"
    )
    refuse((search.source not in ("", source), edited))
    return replace(search, source=source)


def _resumed(options: argparse.Namespace, folder: Path, out: Output) -> RunRequest:
    checkpoint = Checkpoint(folder / FILE_NAME)
    asked = _asked(options, out) if options.problem is not None else None
    if not checkpoint.exists:
        if asked is None:
            raise InputError(
                f"no unfinished run in {folder}: 'sysid run PROBLEM --resume {folder}' begins one there, and goes on "
                "with it where there is one"
            )
        out.write(f"no unfinished run in {folder}: it begins anew\n")
        return asked
    tree = checkpoint.read()
    elsewhere = f"{checkpoint.path} was not begun by 'sysid run': go on with it as it was begun"
    refuse((tree["begun"] is None, elsewhere))
    search = RunRequest.from_tree(tree["begun"])
    given = (options.seed, options.strategy, options.refine_by, options.data, options.modes)
    more = any(one is not None for one in given) or bool(options.settings or options.dofs or _of_tests(options))
    if asked is None:
        kept = "--seed, --strategy, --refine-by, --modes, --dofs, --data, --set and those of tests"
        refuse((more, f"--resume takes {kept} from the run in {folder}: {search}"))
        check_trust(search.recipe, checkpoint.path, f"sysid run MODULE.py --resume {folder}", options)
    else:
        search = _agreed(search, asked, more or is_test(options.problem), folder)
    out.write(f"going on with {search}\n" if tree["entries"] else f"{search} had reached nothing: it begins anew\n")
    return search


def _agreed(search: RunRequest, asked: RunRequest, whole: bool, folder: Path) -> RunRequest:
    """The unfinished run as it is asked for: `whole`, or by its module alone, which the user says again."""
    wanted, its = (catalogue.short_name(one.recipe.module) for one in (asked, search))
    if not whole and wanted == its:
        return replace(search, recipe=replace(search.recipe, module=asked.recipe.module))
    refuse((asked != search, f"{folder} holds an unfinished run of {search}, not of {asked}"))
    return search


def _name(recipe: Recipe) -> str:
    """Name for the folder of results: the module's, of a test that is run without one the test's."""
    without_module = recipe.module == _MODULE and recipe.data is not None
    return Path(recipe.data or "").stem if without_module else catalogue.short_name(recipe.module)


def _asked(options: argparse.Namespace, out: Output) -> RunRequest:
    refuse((options.problem is None, "PROBLEM is missing (see 'sysid run --help')"))
    recipe = _test_recipe(options, recipe_of(options, out))
    return RunRequest(recipe, options.strategy or "auto", options.seed or 0, options.refine_by)


def _in_words(checkpoint: Checkpoint, search: RunRequest) -> str:
    """Content of the file, as far as it can be read."""
    try:
        tree = checkpoint.read()["begun"]
    except InputError:
        return f"an unfinished run that is damaged ({FILE_NAME})"
    if tree is None or (found := RunRequest.from_tree(tree)) == search:
        return "an unfinished run of this problem"
    return f"an unfinished run of {found}"
