"""Results that tests of several files look at: identifying a problem takes seconds."""

import runpy

import pytest

import sysid
from sysid import catalogue


@pytest.fixture(scope="session")
def identified():
    """Give a function that identifies a bundled problem without noise, strategy "auto" and seed 0: once for all tests.

    Keywords are options of its function ``problem``.
    """
    known = {}

    def result(name, **options):
        key = (name, *options.items())
        if key not in known:
            path = str(catalogue.bundled_folder() / f"{name}.py")
            recipe = sysid.Recipe(path, None, 0)
            problem = runpy.run_path(path)["problem"](**options) if options else catalogue.build(recipe)
            known[key] = sysid.identify(problem, rng=0)
        return known[key]

    return result


@pytest.fixture(scope="session")
def identified_from_guess():
    """Give a function that identifies a problem with noise from one start, and looks for no other answers.

    Whether another structure explains the records as well is asked of the same problem without noise.
    """

    def result(problem, rng):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("sysid.results.judgement.with_other_answers", lambda problem, end, session: end)
            return sysid.identify(problem, rng=rng, strategy=sysid.Continuation(starts=1))

    return result
