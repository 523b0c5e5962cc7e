"""Results that tests of several files look at: identifying a problem takes seconds."""

import contextlib
import runpy

import pytest

import sysid
from sysid import catalogue


@pytest.fixture(scope="session")
def identified(from_one_start):
    """Give a function that identifies a bundled problem without noise, strategy "auto" and seed 0: once for all tests.

    Keywords are options of its function ``problem``. Without `look` the search begins at the guess alone and no other
    answers are looked for, unless some test had that done already.
    """
    known = {}

    def result(name, *, look=True, **options):
        key = (name, *options.items())
        look = look or (True, key) in known
        if (look, key) not in known:
            recipe = sysid.Recipe(str(catalogue.bundled_folder() / f"{name}.py"), None, 0)
            problem = runpy.run_path(recipe.module)["problem"](**options) if options else catalogue.build(recipe)
            with contextlib.nullcontext() if look else from_one_start():
                known[look, key] = sysid.identify(problem, rng=0)
        return known[look, key]

    return result


@pytest.fixture(scope="session")
def identified_from_guess(from_one_start):
    """Give a function that identifies a problem with noise, from one start where nothing else is asked for.

    Whether another structure explains the records as well is asked of other problems, and of these without noise by
    the benchmark `second_answers` and the full form of test_reference.py.
    """

    def result(problem, rng, strategy=None):
        with from_one_start():
            return sysid.identify(problem, rng=rng, strategy=strategy or "continuation")

    return result
