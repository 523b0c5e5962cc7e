"""``sysid run --resume DIR`` and ``--fresh``: which search is run, and what becomes of an unfinished one."""

from __future__ import annotations

import argparse
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from sysid import catalogue
from sysid.cli import parameters, read, trust
from sysid.cli.files import results_folder
from sysid.cli.output import Output
from sysid.errors import InputError
from sysid.results.checkpoint import FILE_NAME, Checkpoint, RunRequest
from sysid.results.identification import Recipe
from sysid.search.auto import NAMED
from sysid.search.strategy import Strategy
from sysid.search.swarm import Swarm


def folder_of(options: argparse.Namespace, out: Output) -> Path:
    """The folder of results that the arguments of ``run`` ask for."""
    if options.resume is None:
        return results_folder(options.out, Path("results") / _name(_asked(options, out).recipe))
    if options.fresh or options.out is not None:
        raise InputError(f"--resume and {'--fresh' if options.fresh else '--out'} exclude each other")
    return results_folder(options.resume, Path(options.resume))


def requested_run(options: argparse.Namespace, folder: Path, out: Output) -> RunRequest:
    """The search that the arguments of ``run`` ask for, in the folder of its results.

    Raises
    ------
    InputError
        Where the folder holds an unfinished search and nothing is said of it, or another one than is to be resumed.
    """
    if options.resume is not None:
        return _resumed(options, folder, out)
    search = _asked(options, out)
    checkpoint = Checkpoint(folder / FILE_NAME)
    if checkpoint.exists and not options.fresh:
        raise InputError(
            f"{folder} holds {_in_words(checkpoint, search)}: '{resuming_command(search, folder)}' goes on with it, "
            "--fresh begins anew, --out DIR writes elsewhere"
        )
    return search


def resuming_command(search: RunRequest, folder: Path) -> str:
    """The command that goes on with a search; a module that is not of the package is named again."""
    module = search.recipe.module
    return f"sysid run {'' if catalogue.is_bundled(module) else f'{module} '}--resume {folder}"


def strategy_of(search: RunRequest) -> str | Strategy:
    """The strategy of a search, with the eigenvalue refinement that was chosen.

    Raises
    ------
    InputError
        Where one was chosen and the strategy has none.
    """
    if search.refine_by is None:
        return search.strategy
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
    if search.source not in ("", source):
        raise InputError(
            f"{folder} holds an unfinished run of {search}, and since it began its module or what this imports from "
            f"beside itself was edited: give the problem with --out {folder} --fresh to begin anew, or undo the edit"
        )
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
    if tree["begun"] is None:
        raise InputError(f"{checkpoint.path} was not begun by 'sysid run': go on with it as it was begun")
    search = RunRequest.from_tree(tree["begun"])
    given = (options.seed, options.strategy, options.refine_by, options.data)
    more = any(one is not None for one in given) or bool(options.settings)
    if asked is None:
        if more:
            raise InputError(
                f"--resume takes --seed, --strategy, --refine-by, --data and --set from the run in {folder}: {search}"
            )
        trust.check_trust(search.recipe, checkpoint.path, f"sysid run MODULE.py --resume {folder}", options)
    else:
        search = _agreed(search, asked, more or read.is_test(options.problem), folder)
    out.write(f"going on with {search}\n" if tree["entries"] else f"{search} had reached nothing: it begins anew\n")
    return search


def _agreed(search: RunRequest, asked: RunRequest, whole: bool, folder: Path) -> RunRequest:
    """The unfinished run as it is asked for: `whole`, or by its module alone, which the user says again."""
    wanted, its = (catalogue.short_name(one.recipe.module) for one in (asked, search))
    if not whole and wanted == its:
        return replace(search, recipe=replace(search.recipe, module=asked.recipe.module))
    if asked != search:
        raise InputError(f"{folder} holds an unfinished run of {search}, not of {asked}")
    return search


def _name(recipe: Recipe) -> str:
    """Name for the folder of results: the module's, of a test that is run without one the test's."""
    without_module = recipe.module == read.MODULE and recipe.data is not None
    return Path(recipe.data or "").stem if without_module else catalogue.short_name(recipe.module)


def _asked(options: argparse.Namespace, out: Output) -> RunRequest:
    if options.problem is None:
        raise InputError("PROBLEM is missing (see 'sysid run --help')")
    recipe = read.recipe(options, parameters.recipe_of(options, out))
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
