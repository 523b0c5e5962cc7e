"""Expressions as operations in plain data: what is read again is CasADi's own, to the bit, and nothing else is made."""

import copy
import time
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import sysid
from benchmarks.hostile.stored_expressions import changed
from sysid.files.tree import from_bytes, to_bytes
from sysid.problem import operations
from sysid.problem.decoding import decode
from sysid.problem.encoding import NotStorableError, encode
from sysid.problem.operations import is_compiled

X, Y, A, L = (
    ca.MX.sym("x", 3), ca.MX.sym("y", 3), ca.MX.sym("A", 3, 3), ca.MX.sym("L", ca.Sparsity.lower(3)),
)  # fmt: skip
SYMBOLS = [X, Y, A, L]
V = ca.SX.sym("v", 3)
OF_NUMBERS = ca.Function("of_numbers", [V], [V * V + ca.sin(2.5), ca.fmin(ca.sum1(V), 1.0), ca.SX(2, 2)])
OF_MATRICES = ca.Function("of_matrices", [X, A], [ca.vertcat(A @ X, ca.sin(X)), ca.det(A)])
NESTED = ca.Function("nested", [X], [OF_MATRICES(X, ca.DM([[2, 1, 0], [0, 3, 1], [1, 0, 4]]))[0] + OF_NUMBERS(X)[0][0]])


def point(rng):
    """Values of all symbols, with A far from singular."""
    values = [ca.DM(one.sparsity(), rng.uniform(0.2, 0.9, one.nnz())) for one in SYMBOLS]
    return [values[0], values[1], values[2] + 2 * ca.DM.eye(3), values[3] + ca.DM.eye(3)]


def with_entries(set_them):
    matrix = ca.MX(A)
    set_them(matrix)
    return matrix


def set_row(matrix):
    matrix[1, :] = X.T


def add_corner(matrix):
    matrix[:2, :2] += ca.diag(Y[:2])


def moved_back(expression, seed):
    """Reverse derivative of an expression, which adds to nonzeros, some of them twice."""
    return ca.jtimes(expression, A, seed, True)


CASES = {
    "entries": A[1, [0, 2]], "entries twice": A[[0, 0, 2], 1], "row set": with_entries(set_row),
    "corner added to": with_entries(add_corner), "reverse of entries": moved_back(ca.vertcat(A[0, 0], A[0, 0]), X[:2]),
    "reverse of rows": moved_back(A[[0, 2, 0], :], ca.horzcat(X, Y, X)), "reshape": ca.reshape(A + 1, 9, 1),
    "triangle": ca.tril(A), "cast": ca.sparsity_cast(ca.vec(A)[:6], ca.Sparsity.lower(3)), "column": ca.vertcat(X, Y),
    "block": ca.blockcat([[A, X], [X.T, 2]]), "diagonal": ca.diagcat(A, X), "diagonal matrix": ca.diag(X) @ A,
    "rows": ca.vertcat(*(2 * one for one in ca.vertsplit(X + Y, [0, 1, 3]))),
    "columns": ca.horzsplit(A + 1, [0, 2, 3])[1],
    "blocks": ca.diagsplit(ca.diagcat(A, A) * 2, [0, 3, 6])[1],
    "product": A @ X + Y, "sparse product": L @ A, "dot": ca.dot(X, Y),
    "bilinear": ca.bilin(A, X, Y), "rank one": ca.rank1(A, 2.0, X, Y), "kron": ca.kron(A, L), "1-norm": ca.norm_1(X),
    "2-norm": ca.norm_2(X), "norm": ca.norm_fro(A), "largest": ca.norm_inf(X), "determinant": ca.det(A),
    "inverse": ca.inv(A), "least": ca.mmin(X), "most": ca.mmax(A), "logsumexp": ca.logsumexp(X), "find": ca.find(X),
    "low": ca.low(ca.DM([0, 0.3, 0.6, 1]), X[0]), "transposed": (A * 2).T,
    "sum of products": ca.einstein(ca.vec(A), X, [3, 3], [3], [3], [-1, -2], [-2], [-1]),
    "repeated": ca.repmat(X, 2, 3), "sum over repetitions": ca.repsum(ca.repmat(A, 1, 3) * 2, 1, 3),
    "solved": ca.solve(A, X), "solved by LDL": ca.solve(A + A.T, X, "ldl"), "solved by LU": ca.solve(A, X, "lapacklu"),
    "triangle solved": ca.solve(L, X), "sparse solved": ca.solve(ca.project(A, ca.Sparsity.upper(3)) + L, A),
    "call of numbers": ca.vertcat(OF_NUMBERS(X)[0], OF_NUMBERS(Y)[1]), "call of matrices": OF_MATRICES(X, A)[0],
    "nested calls": NESTED(Y), "map": OF_NUMBERS.map(4)(ca.horzcat(X, Y, A[:, :2]))[0],
    "one of two": ca.if_else(X[0] > 0.5, X, Y), "one of two, lazily": ca.if_else(X[0] > 0.5, X * X, Y, True),
    "one of three": ca.conditional(2 * X[0], [X, Y], 2 * X, True), "cumulated": ca.cumsum(X), "cross": ca.cross(X, Y),
    "linear table": ca.interpolant("t", "linear", [[0, 0.3, 1.0], [0, 0.5, 2.0]], list(range(9)))(X[:2]),
    "smooth table": ca.interpolant("t", "bspline", [[0, 0.3, 0.6, 1.0]], [0, 1, 4, 9.0])(X[0]),
    "derivative": ca.jacobian(ca.solve(A, ca.sin(X)), X), "gradient": ca.gradient(ca.log(ca.det(A)), A),
    "constant": ca.MX(ca.DM([[1, 2], [0, np.pi]])), "sparse constant": ca.MX(ca.sparsify(ca.DM([[1, 0], [0, 3]]))),
    "not a number": X * np.nan + np.inf, "zeros": ca.MX(2, 3), "empty": ca.MX(0, 3), "symbol": A, "power": X**2.5,
}  # fmt: skip
CASES |= {f"unary {name}": ca.MX.unary(operations.casadi_number(name), X) for name in operations.UNARY}
CASES |= {f"binary {name}": ca.MX.binary(operations.casadi_number(name), X, Y) for name in operations.BINARY}


def through_a_file(tree):
    return from_bytes(to_bytes(tree, 1))[0]


def bits(function, values):
    return [np.array(one.nonzeros()).view(np.int64).tolist() for one in function.call(values)]


@pytest.mark.parametrize("name", CASES)
def test_what_is_read_again_has_the_same_pattern_values_and_derivatives_to_the_bit(name):
    rng, expression = np.random.default_rng(3), CASES[name]
    tree = through_a_file(encode(SYMBOLS, [expression], [point(rng), point(rng)]))
    (again,) = decode(tree, SYMBOLS)
    assert again.sparsity() == expression.sparsity()
    unknowns, both = ca.vertcat(*map(ca.vec, SYMBOLS)), []
    for one in (expression, again):
        try:
            both.append(ca.Function("f", SYMBOLS, [one, ca.jacobian(one, unknowns)]))
        except RuntimeError:  # CasADi has no derivative of "mmin", "find" and their like
            both.append(ca.Function("f", SYMBOLS, [one]))
    for _ in range(3):
        values = point(rng)
        assert bits(both[0], values) == bits(both[1], values)


def test_expressions_that_share_operations_are_stored_with_them_once():
    shared = ca.sin(A @ A)
    tree = encode(SYMBOLS, [shared, shared + 1, ca.vertcat(shared, X.T)], [point(np.random.default_rng(0))])
    assert sorted(tree["names"]) == ["add", "const", "mtimes", "reshape", "sin", "vertcat"] or "sin" in tree["names"]
    code = tree["functions"][-1]["code"].tolist()
    at, seen = 0, []
    while at < len(code):
        seen.append(tree["names"][code[at]])
        at += 2 + code[at + 1]
        at += 1 + code[at]
    assert (seen.count("sin"), seen.count("mtimes")) == (1, 1)


def test_a_function_that_is_called_often_is_stored_once():
    value = X
    for _ in range(30):
        value = NESTED(value) if value.numel() == 3 else NESTED(value[:3] / 10)
    tree = encode(SYMBOLS, [value], [point(np.random.default_rng(0))])
    assert [function["kind"] for function in tree["functions"]] == ["mx", "sx", "mx", "mx"]


def test_a_chain_of_4000_operations_is_written_and_read_within_seconds():
    value = X
    for i in range(2000):
        value = ca.sin(value) + i
    begun = time.process_time()
    decode(encode([X], [value], [[ca.DM([0.1, 0.2, 0.3])]]), [X])
    assert time.process_time() - begun < 3


class Doubled(ca.Callback):
    def __init__(self):
        super().__init__()
        self.construct("doubled", {"enable_fd": True})

    def eval(self, given):
        return [2 * given[0]]


CALLBACK = Doubled()
R, P = ca.MX.sym("r"), ca.MX.sym("p")
ROOT = ca.rootfinder("root", "newton", {"x": R, "p": P, "g": R**2 - P})
REFUSED = {
    "the function 'doubled' (CallbackInternal)": CALLBACK(X[0]),
    "the function 'root' (Newton)": ROOT(x0=1.0, p=Y[0])["x"],
    "(ThreadMap)": OF_NUMBERS.map(4, "thread", 2)(ca.repmat(X, 1, 4))[0],
    "the operation 'monitor'": (X * 2).monitor("here"),
    "the operation 'assertion'": X.attachAssert(X[0] > -9, "below"),
    "the operation 'solve', by a linear solver with options": ca.solve(A, X, "qr", {"eps": 1e-3}),
    "the operation 'bspline'": ca.bspline(X[0], ca.DM([1, 2, 3, 4]), [[0, 0, 0, 0, 1, 1, 1, 1]], [3], 1, {}),
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_cannot_be_stored_is_named(words):
    with pytest.raises(NotStorableError) as caught:
        encode(SYMBOLS, [REFUSED[words]], [point(np.random.default_rng(0))])
    assert words in str(caught.value)


def test_a_function_that_is_compiled_is_told_by_its_text():
    """CasADi compiles when such a function is made; here one's text has the byte of that option set."""
    plain = ca.Function("plain", [X], [ca.sin(X)])
    letters = b"FunctionInternal::jit" + b"b"
    coded = "".join(chr(97 + byte % 16) + chr(97 + byte // 16) for byte in letters)

    class Compiled:
        def serialize(self, options):
            before, after = plain.serialize(options).split(coded)
            return before + coded + "ba" + after[2:]

    assert not is_compiled(plain) and is_compiled(Compiled())


def tree_of(expression):
    return encode(SYMBOLS, [expression], [point(np.random.default_rng(0))])


def edited(tree, code=None, names=None, **parts):
    """The tree with other integers, names or parts of its last function."""
    tree = copy.deepcopy(tree)
    if code is not None:
        tree["functions"][-1]["code"] = np.array(code, dtype=np.int64)
    tree["names"] = names or tree["names"]
    tree["functions"][-1] |= parts
    return tree


@pytest.mark.parametrize("name", ["system", "external", "jit", "__class__", "", "input", "output", "monitor", "solve "])
def test_an_operation_that_is_not_on_the_list_is_refused(name):
    with pytest.raises(sysid.InputError, match="its expressions are damaged at operation 0"):
        decode(edited(tree_of(ca.sin(X)), names=(name,)), SYMBOLS)


@pytest.mark.parametrize("solver", ["ma27", "evil", "../../evil", "symbolicqr", "qr\0"])
def test_a_linear_solver_that_is_not_on_the_list_is_not_loaded(solver, monkeypatch):
    tree = edited(tree_of(ca.solve(A, X)), names=(f"solve {solver}",))
    monkeypatch.setattr(ca, "Linsol", None)
    with pytest.raises(sysid.InputError, match="is none of qr, ldl"):
        decode(tree, SYMBOLS)


def test_a_solver_that_this_casadi_lacks_is_named(monkeypatch):
    tree = tree_of(ca.solve(A, X, "ldl"))
    monkeypatch.setattr(operations, "has_library", lambda kind, name: name != "ldl")
    with pytest.raises(
        sysid.InputError, match="they need CasADi's ldl, which this installation of CasADi does not have"
    ):
        decode(tree, SYMBOLS)


@pytest.mark.parametrize(
    "code",
    [
        [0, 1, 4, 0], [0, 1, -1, 0], [0, 1, 2**62, 0], [1, 1, 0, 0], [0, 2, 0, 1, 0], [0, 0, 0], [0, 1, 0, 1, 7],
        [0, 1], [0, 900, 0], [0, -1, 0], [0, 1, 0, -1], [0],
    ],
)  # fmt: skip
def test_a_list_with_wrong_numbers_is_refused(code):
    with pytest.raises(sysid.InputError, match="its expressions are damaged"):
        decode(edited(tree_of(ca.sin(X)), code), SYMBOLS)


@pytest.mark.parametrize(
    "numbers",
    [
        [3, 3, 0, 3, 0, 1, 2, 3, 0, 1, 3], [3, 3, 0, 3, 0, 1, 2, 4, 0, 1, 2], [3, 3, 0, 3, 0, 2, 1, 3, 0, 1, 2],
        [3, 3, 0, 3, 0, 2, 2, 3, 1, 0, 2], [3, 3, 0, 3, 0, 1, 2, 3, 0, 1], [3, 3, 0, -1, 0, 0, 0, 0], [-3, 3, 1],
        [3, 3],
    ],
)  # fmt: skip
def test_a_pattern_that_is_none_is_refused(numbers):
    """CasADi 3.8 reads beyond its arrays in some of them."""
    tree = tree_of(ca.sin(X))
    tree["patterns"] = np.array(numbers)
    with pytest.raises(sysid.InputError, match="its expressions are damaged"):
        decode(tree, SYMBOLS)


def test_numbers_of_another_type_are_refused():
    tree = tree_of(ca.sin(X) + 2.5)
    for wrong in ({"code": np.ones(4)}, {"numbers": np.array([1])}, {"outputs": np.ones((1, 1), int)}, {"kind": "jit"}):
        with pytest.raises(sysid.InputError, match="its expressions are damaged"):
            decode(edited(tree, **wrong), SYMBOLS)
    for missing in ("names", "patterns", "functions"):
        part = {name: value for name, value in tree.items() if name != missing}
        with pytest.raises(sysid.InputError, match="its expressions are damaged"):
            decode(part, SYMBOLS)


def test_sums_over_indices_of_two_sizes_are_refused():
    """CasADi checks no dimensions, and reads beyond the arrays."""
    expression = CASES["sum of products"]
    tree = tree_of(expression)
    code = tree["functions"][-1]["code"].tolist()
    sizes = [i for i in range(len(code) - 2) if code[i : i + 3] == [2, 3, 3]]
    code[sizes[0] + 2] = 300
    with pytest.raises(sysid.InputError, match="its expressions are damaged"):
        decode(edited(tree, code), SYMBOLS)


TOO_MUCH = {
    "kron": (["kron"], [part for i in range(2, 40) for part in (0, 2, i, i, 0)]),
    "horzrepmat": (["horzrepmat"], [0, 1, 2, 1, 10**9]),
    "vertcat": (["vertcat"], [part for i in range(4, 40) for part in (0, 2, i - 1, i - 1, 0)]),
    "diagcat": (["diagcat"], [part for i in range(4, 40) for part in (0, 2, i - 1, i - 1, 0)]),
    "getnonzeros": (["getnonzeros"], [0, 1, 0, 5, 0, 1, 0, 0, 10**12]),
}


@pytest.mark.parametrize("name", TOO_MUCH)
def test_a_file_that_asks_for_too_large_a_matrix_is_refused_before_it_is_made(name, monkeypatch):
    names, code = TOO_MUCH[name]
    monkeypatch.setattr(operations, "LIMITS", operations.FileLimits(entries=10_000))
    with pytest.raises(sysid.InputError, match="its expressions ask for too much: the size of a matrix"):
        decode(edited(tree_of(ca.sin(X)), code, tuple(names)), SYMBOLS)


def test_a_file_that_states_too_large_a_pattern_is_refused_before_it_is_made():
    tree = tree_of(ca.sin(X))
    for shape in ([10**6, 10**6, 1], [2**62, 2**62, 1], [10**9, 0, 1]):
        tree["patterns"] = np.array(shape)
        with pytest.raises(sysid.InputError, match="its expressions ask for too much: the size of a matrix"):
            decode(tree, SYMBOLS)


def test_calls_in_calls_multiply_and_are_limited():
    """Thirty functions, each of which calls the one before it twice: 2³⁰ evaluations of the first."""
    tree = tree_of(ca.sin(NESTED(X)))
    first = tree["functions"][0]
    one = {**first, "kind": "mx", "inputs": np.array([0]), "outputs": np.array([1]), "numbers": np.zeros(0)}
    functions = [{**one, "code": np.array([0, 1, 0, 0])}]
    for i in range(40):
        twice = [1, 1, 0, 1, i, 1, 1, 1, 1, i]
        functions.append({**one, "code": np.array(twice), "outputs": np.array([2])})
    made = {"names": ("sin", "call"), "patterns": np.array([3, 1, 1]), "functions": functions}
    with pytest.raises(sysid.InputError, match="ask for too much: the work of one evaluation"):
        decode(made, [X])


@pytest.mark.parametrize(("value", "as_written"), [(1.5, "all_1.5(40000x1)"), (np.nan, "nan(40000x1)")])
def test_a_number_for_all_entries_is_kept_once(value, as_written):
    """Else a short list could ask for any amount of memory; CasADi writes a matrix otherwise entry by entry."""
    tree = encode([X], [ca.MX(ca.DM.ones(40_000) * value)], [])
    (made,) = decode(tree, [X])
    assert str(made) == as_written
    np.testing.assert_array_equal(made.to_DM().nonzeros(), np.full(40_000, value))


def test_a_list_of_too_many_operations_is_refused(monkeypatch):
    monkeypatch.setattr(operations, "LIMITS", operations.FileLimits(operations=5))
    with pytest.raises(sysid.InputError, match="ask for too much: the number of operations is 6, at most 5 is read"):
        decode(edited(tree_of(ca.sin(X)), [0, 1, 0, 0] * 6), SYMBOLS)


def test_an_evaluation_that_needs_too_much_memory_is_refused(monkeypatch):
    tree = tree_of(ca.kron(A, A) @ ca.kron(A, A))
    monkeypatch.setattr(operations, "LIMITS", operations.FileLimits(memory=50))
    with pytest.raises(sysid.InputError, match="ask for too much: memory of one evaluation"):
        decode(tree, SYMBOLS)


def test_of_mutated_lists_none_ends_in_anything_but_an_input_error_or_expressions():
    """In this process: a crash of CasADi would end the tests. `hostile` has 2,400 of them."""
    rng, trees = np.random.default_rng(8), [tree_of(expression) for expression in CASES.values()]
    refused = 0
    for k in range(300):
        try:
            made = decode(changed(trees[k % len(trees)], rng), SYMBOLS)
        except sysid.InputError:
            refused += 1
        else:
            assert all(isinstance(one, ca.MX) for one in made)
    assert refused > 100


def test_the_package_reads_no_text_of_casadi():
    folder = Path(sysid.__file__).parent
    assert [path.name for path in folder.rglob("*.py") if "deserialize(" in path.read_text(encoding="utf-8")] == []
