"""``sysid compare PROBLEM``: all methods side by side, as a table and a picture."""

from __future__ import annotations

import argparse
from pathlib import Path

from sysid import catalogue
from sysid.cli.output import Output, png, results_folder, strict_json, write_files
from sysid.cli.requests import recipe_of
from sysid.cli.starting import INTERRUPTED, NOT_REACHED, SUCCESS
from sysid.compare import peers
from sysid.compare.comparison import Comparison, as_csv, compare, comparison_text, line
from sysid.compare.peers import MethodResult
from sysid.results.identification import Recipe
from sysid.results.version import __version__


def run(options: argparse.Namespace, out: Output) -> int:
    """Compare, tell each method's end in a line, and write table and picture."""
    recipe = recipe_of(options, out)
    problem = catalogue.build(recipe)
    folder = results_folder(options.out, Path("results") / catalogue.short_name(recipe.module))
    out.write(f"{recipe.title}: {problem.n_variables} unknowns, seed {options.seed}\n")
    if peers.missing_packages():
        out.write(f"without pymoo, CMA-ES and SciPy's optimisers, which need: {peers.HOW_TO_INSTALL}\n")
    if problem.reference is None:
        out.write("the problem has no reference, so errors of M, K and C are not known\n")

    def tell(result: MethodResult) -> None:
        out.progress(f"{line(result)}\n")

    compared = compare(problem, rng=options.seed, max_time=options.max_time, modal=recipe.modal, listener=tell)
    if not compared.results:
        raise KeyboardInterrupt
    out.write(f"\n{comparison_text(compared)}\n\n")
    out.answer(comparison={"problem": recipe.module, "parameters": recipe.parameters, **compared.to_dict()})
    _write(compared, recipe, folder, out, rows=options.out is not None)
    if compared.interrupted:
        out.complain("interrupted; the table holds what there was until then")
        return INTERRUPTED
    return SUCCESS if compared.success else NOT_REACHED


def _write(compared: Comparison, recipe: Recipe, folder: Path, out: Output, *, rows: bool) -> None:
    """Write the picture, and the rows of the table as CSV and JSON where they are wanted."""
    from sysid.plot.comparison import comparison

    files = {}
    if any(result.ran for result in compared.results):
        files["comparison.png"] = png(comparison, compared, recipe.title)
    if rows:
        head = {"problem": recipe.module, "parameters": recipe.parameters, "version": __version__}
        files["comparison.csv"] = as_csv(compared).encode()
        files["comparison.json"] = strict_json({**head, **compared.to_dict()}).encode()
    write_files(folder, files, out)
