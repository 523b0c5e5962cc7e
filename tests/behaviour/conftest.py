"""Results that tests of several files look at: identifying a problem takes seconds."""

import runpy

import pytest

import sysid
from sysid import catalogue


def without_the_look(problem, **options):
    """Identify a problem, and look for no other structures that explain its records, which takes half of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sysid.results.judgement.with_other_answers", lambda problem, end, session: end)
        return sysid.identify(problem, **options)


@pytest.fixture(scope="session")
def identified():
    """Give a function that identifies a bundled problem without noise, strategy "auto" and seed 0: once for all tests.

    Keywords are options of its function ``problem``. Without `look` no other answers are looked for, unless some test
    had them looked for already.
    """
    known = {}

    def result(name, *, look=True, **options):
        key = (name, *options.items())
        look = look or (True, key) in known
        if (look, key) not in known:
            recipe = sysid.Recipe(str(catalogue.bundled_folder() / f"{name}.py"), None, 0)
            problem = runpy.run_path(recipe.module)["problem"](**options) if options else catalogue.build(recipe)
            known[look, key] = (sysid.identify if look else without_the_look)(problem, rng=0)
        return known[look, key]

    return result


@pytest.fixture(scope="session")
def identified_from_guess():
    """Give a function that identifies a problem with noise, from one start where nothing else is asked for.

    Whether another structure explains the records as well is asked of other problems, and of these without noise by
    the benchmark `second_answers` and the full form of test_reference.py.
    """

    def result(problem, rng, strategy=None):
        return without_the_look(problem, rng=rng, strategy=strategy or sysid.Continuation(starts=1))

    return result
