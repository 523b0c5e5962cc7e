"""The examples in docstrings give what they say."""

import doctest
import importlib
import pkgutil

import matplotlib.pyplot as plt
import numpy as np

import sysid


def test_the_examples_in_docstrings_give_what_they_say():
    names = [module.name for module in pkgutil.walk_packages(sysid.__path__, "sysid.")]
    # the bundled problems are no part of the API, and __main__ would start the command line
    names = [name for name in names if "bundled_problems" not in name and not name.endswith("__main__")]
    with np.printoptions(legacy=False):  # some packages that other tests import change it
        ends = {name: doctest.testmod(importlib.import_module(name)) for name in names}
    plt.close("all")
    assert {name: end.failed for name, end in ends.items() if end.failed} == {}
    assert sum(end.attempted for end in ends.values()) > 20
