"""The state of an unfinished search in a file: numbers and text only, with the SHA-256 of its bytes, as results are."""

from __future__ import annotations

import contextlib
import hashlib
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import scipy
from numpy.typing import ArrayLike

from sysid.errors import InputError, path_of, refuse, text
from sysid.files.tree import Tree, from_bytes, to_bytes
from sysid.problem.problem import Problem
from sysid.results.identification import Recipe
from sysid.results.storage import alone, atomically, unfinished_writings
from sysid.results.version import __version__
from sysid.search.session import EVERY, Journal
from sysid.search.strategy import Strategy
from sysid.search.swarm_objective import RefineBy
from sysid.structure.structure import Structure

FILE_NAME = "unfinished.h5"
# What numbers that fit no search make NumPy, CasADi and Python raise.
_UNFIT = (
    KeyError,
    IndexError,
    TypeError,
    ValueError,
    AttributeError,
    RuntimeError,
    AssertionError,
    NotImplementedError,
)
_CONTENT, _FORMAT = "unfinished search", 2


@dataclass(frozen=True)
class RunRequest:
    """Arguments with which a command line began a search; `refine_by` is that of its swarm, where it was chosen.

    `source` is a digest of the files that the problem was made from: a user's own model is code, which no problem
    holds.
    """

    recipe: Recipe
    strategy: str
    seed: int
    refine_by: RefineBy | None = None
    source: str = field(default="", compare=False)

    def __str__(self) -> str:
        recipe = self.recipe
        noise, data = f", rng {recipe.rng}" * bool(recipe.rng), f", data {recipe.data}" * (recipe.data is not None)
        refined = f" refined by {self.refine_by}" * (self.refine_by is not None)
        return f"{recipe.title}{noise}{data}, strategy {self.strategy}{refined}, seed {self.seed}"

    def to_tree(self) -> Tree:
        """Give the fields by their names; `from_tree` takes them back."""
        fields = {
            "strategy": self.strategy, "seed": str(self.seed), "refine_by": self.refine_by, "source": self.source,
        }  # fmt: skip
        return {"recipe": self.recipe.to_tree(), **fields}

    @classmethod
    def from_tree(cls, tree: Tree) -> RunRequest:
        """Give what `to_tree` made a tree of.

        Raises
        ------
        InputError
            Where the tree tells no search.
        """
        try:
            recipe = Recipe.from_tree(tree["recipe"])
            words = [text(name, tree[name]) for name in ("strategy", "seed")]
            return cls(recipe, words[0], int(words[1]), tree["refine_by"], str(tree["source"]))
        except InputError:
            raise
        except Exception as error:  # a tree that somebody else wrote may lack anything
            raise InputError(
                f"the state does not tell which search it is of ({type(error).__name__}: {error})"
            ) from None


@dataclass(frozen=True)
class Checkpoint:
    """The file of an unfinished search: there from its start until its result is safe.

    The `request` stands in it for whoever is to go on; `every` is s between two writings.
    """

    path: Path
    request: RunRequest | None = None
    every: float = field(default=EVERY, kw_only=True)

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", path_of("checkpoint", self.path))

    @property
    def exists(self) -> bool:
        """True where there is an unfinished search."""
        return self.path.is_file()

    def read(self) -> Tree:
        """Everything in the file.

        Raises
        ------
        InputError
            Where it is no unfinished search, is damaged, or comes from another sysid.
        """
        try:
            tree, number = from_bytes(self.path.read_bytes())
        except OSError as error:
            raise InputError(f"{self.path} cannot be read: {error.strerror or error}") from error
        except InputError as error:
            raise InputError(f"{self.path} cannot be read: {error}") from error
        ours = tree.get("content") == _CONTENT and number == _FORMAT
        refuse((not ours, f"{self.path} is not the state of an unfinished search of this sysid"))
        return tree

    def _entries(self, tree: Tree) -> Tree:
        """Parts of the search in a tree, each by its number."""
        entries = tree.get("entries")
        sound = isinstance(entries, dict) and all(
            number.isdecimal() and isinstance(entry, dict) and {"part", "content"} <= set(entry)
            for number, entry in entries.items()
        )
        if not sound or not isinstance(entries, dict):
            raise InputError(f"{self.path} holds no parts of a search: take it away, or begin anew with --fresh")
        return entries

    def remove(self) -> None:
        """Take the file away, and what a kill left of writing it."""
        for path in (self.path, *unfinished_writings(self.path)):
            path.unlink(missing_ok=True)

    @contextlib.contextmanager
    def journal(self, search: str) -> Iterator[Journal]:
        """Give the journal of a search, with what the file has of it; at the end all is written.

        Where the search then has nothing to go on with, the file vanishes, and the folders that were made for it.
        Raises InputError where the file is of another search (see `identity`), is in use, or cannot be written.
        """
        lock = self.path.with_name(f".{self.path.name}.lock")
        with alone(lock, str(self.path), "wait for its end, or give another file"), self._journal(search) as journal:
            yield journal

    @contextlib.contextmanager
    def _journal(self, search: str) -> Iterator[Journal]:
        entries: Tree = {}
        if self.exists:
            tree = self.read()
            changed = "the problem, its records, the strategy, the seed or sysid has changed since"
            remedy = "take it away, or give another file"
            refuse((tree.get("search") != search, f"{self.path} is of another search: {changed}; {remedy}"))
            entries = self._entries(tree)
        request = self.request and self.request.to_tree()

        def write(kept: Tree) -> None:
            tree = {"content": _CONTENT, "search": search, "begun": request, "entries": kept}
            with atomically(self.path) as temporary:
                temporary.write_bytes(to_bytes(tree, _FORMAT))

        def try_to_write(kept: Tree) -> None:
            try:
                write(kept)
            except InputError as error:  # no reason to lose the search itself
                warnings.warn(f"the search goes on, but its state is not kept: {error}", stacklevel=2)

        journal = Journal(try_to_write, entries, self.every)
        try:
            for left in unfinished_writings(self.path):
                left.unlink(missing_ok=True)
            write(entries)
            yield journal
        except _UNFIT as error:
            if not entries or isinstance(error, InputError):
                raise
            raise InputError(
                f"the search could not go on from {self.path} ({type(error).__name__}: {error}): take it away, or "
                "begin anew with --fresh; where that fails too it is an error of sysid"
            ) from error
        finally:
            journal.flush()
            if not journal.entries:
                with contextlib.suppress(OSError):
                    self.remove()


def identity(
    problem: Problem, strategy: str | Strategy, seed: int, start: ArrayLike | Structure | None,
    max_evaluations: int | None,
) -> str:  # fmt: skip
    """A text that tells one search from another: a digest of all that its bits depend on but the code of own models.

    Raises
    ------
    InputError
        Where the problem holds what cannot be stored.
    """
    begin: Any = start.to_tree() if isinstance(start, Structure) else start if start is None else np.asarray(start)
    tree = {
        "problem": problem.to_tree(), "start": begin, "strategy": repr(strategy), "seed": str(seed),
        "max_evaluations": max_evaluations,
        "versions": (__version__, *(f"{module.__name__} {module.__version__}" for module in (ca, np, scipy))),
    }  # fmt: skip
    return hashlib.sha256(to_bytes(tree, _FORMAT)).hexdigest()
