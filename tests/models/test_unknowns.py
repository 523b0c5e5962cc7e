"""A variable behaves as the CasADi symbol that it stands for, and refuses what it cannot be, with its place."""

import inspect
import re

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.models.unknowns import Unknown, by_name, log_sampling, scales_of, slices_of, split, variable_of

V = np.array([1.0, 2.0, 3.0])
A = np.arange(1.0, 10.0).reshape(3, 3)
NUMBERS = {"k": np.array([0.2, 0.3, 0.4]), "s": 0.7, "S": (np.arange(9.0).reshape(3, 3) + 1) / 10}


@pytest.fixture
def names():
    """A column k, a scalar s and a matrix S."""
    return {
        "k": sysid.Variable("k", 3, lower=0, upper=1),
        "s": sysid.Variable("s", lower=0, upper=1),
        "S": sysid.Variable("S", (3, 3), lower=0, upper=1),
    }


def numbers_of(expression, names):
    """The expression at NUMBERS."""
    function = ca.Function("f", [variable.symbol for variable in names.values()], [expression])
    return np.asarray(function(*(NUMBERS[name] for name in names)))


ELEMENTWISE = [
    "-k", "abs(k)", "k + 1", "1 + k", "k - 1", "1 - k", "2 * k", "k * 2", "k / 2", "2 / k", "k**2", "2**k", "k**k",
    "k + other", "other + k", "k - other", "other - k", "k * other", "other * k", "k / other", "other / k",
    "k**other", "other**k", "s * k", "k * s", "k / s", "s - k", "s + s", "s**s", "-s", "abs(s)", "s * other",
    "other / s", "np.exp(k)", "np.sqrt(k)", "np.log(k)", "np.sin(s)", "np.tanh(k)", "np.abs(k)", "np.square(k)",
    "np.maximum(k, 0.25)", "np.minimum(0.25, k)", "np.arctan2(k, s)", "np.hypot(k, s)", "np.power(k, 2)",
    "np.add(other, k)", "np.float64(2) * k", "k * np.float64(2)", "np.float32(2) * k", "np.int64(3) - k",
    "np.array(2.0) * k", "k * np.array(2.0)",
]  # fmt: skip
OTHERS = {
    "numpy": (V, V[:, None]),
    "list": (V.tolist(), V[:, None]),
    "DM": (ca.DM(V), V[:, None]),
    "MX": (ca.MX(ca.DM(V)), V[:, None]),
    "column": (V[:, None], V[:, None]),
    "number": (1.5, 1.5),
}


@pytest.mark.parametrize(
    ("formula", "kind"),
    [(f, kind) for f in ELEMENTWISE for kind in (OTHERS if "other" in f else ["numpy"])],
)
def test_operators_and_ufuncs_give_what_numpy_gives_of_numbers(names, formula, kind):
    other, plain = OTHERS[kind]
    expression = eval(formula, {"np": np, "other": other, **names})
    assert isinstance(expression, ca.MX)
    k = NUMBERS["k"][:, None]
    expected = np.asarray(eval(formula, {"np": np, "other": plain, **NUMBERS, "k": k}))
    made = numbers_of(expression, names)
    np.testing.assert_allclose(made.reshape(expected.shape), expected, rtol=1e-14)


@pytest.mark.parametrize(
    "formula",
    ["A @ k", "S @ A", "A @ S", "S @ k", "A * S", "S * A", "S / A", "A / S", "A - S", "S - A", "S @ S", "k.T @ A",
     "k.T @ k", "k @ k.T", "S.T @ k", "A + S", "S + A", "A * s", "s * A"],
)  # fmt: skip
@pytest.mark.parametrize("kind", ["numpy", "DM", "MX"])
def test_matrix_operations_keep_the_order_of_numpy(names, formula, kind):
    other = {"numpy": A, "DM": ca.DM(A), "MX": ca.MX(ca.DM(A))}[kind]
    made = numbers_of(eval(formula, {"A": other, **names}), names)
    expected = eval(formula, {"A": A, **NUMBERS, "k": NUMBERS["k"][:, None]})
    np.testing.assert_allclose(made, expected, rtol=1e-14)


@pytest.mark.parametrize(
    ("formula", "expected"),
    [
        ("k[0]", 0.2), ("k[-1]", 0.4), ("k[1:]", [0.3, 0.4]), ("k[[0, 2]]", [0.2, 0.4]), ("k[::2]", [0.2, 0.4]),
        ("k[np.int64(1)]", 0.3), ("S[0, 2]", 0.3), ("S[2, 0]", 0.7), ("S[:, 1]", [0.2, 0.5, 0.8]),
        ("S[0:2, 0]", [0.1, 0.4]), ("sum(k)", 0.9), ("ca.sum1(k)", 0.9), ("list(k)[2]", 0.4),
        ("list(S)[1].T", [0.4, 0.5, 0.6]), ("ca.vertcat(*k)", [0.2, 0.3, 0.4]), ("ca.dot(k, k)", 0.29),
        ("ca.vertcat(k, s)", [0.2, 0.3, 0.4, 0.7]), ("ca.diag(ca.diag(k))", [0.2, 0.3, 0.4]), ("ca.trace(S)", 1.5),
        ("ca.vec(S)", [0.1, 0.4, 0.7, 0.2, 0.5, 0.8, 0.3, 0.6, 0.9]), ("ca.sqrt(s)", 0.7**0.5),
        ("ca.if_else(s > 0.5, k[0], k[1])", 0.2), ("np.sum(k)", 0.9), ("np.linalg.norm(k)", 0.29**0.5),
    ],
)  # fmt: skip
def test_slices_iteration_and_casadi_functions_take_a_variable(names, formula, expected):
    made = numbers_of(eval(formula, {"np": np, "ca": ca, **names}), names)
    np.testing.assert_allclose(made.ravel(), np.ravel(expected), rtol=1e-14)


def test_nested_lists_and_object_arrays_of_variables_are_matrices(names):
    s, k = names["s"], names["k"]
    block = ca.blockcat([[s, 0], [0, 2 * s]])
    np.testing.assert_allclose(numbers_of(block, names), np.diag([0.7, 1.4]))
    held = np.array([[s, 0], [0, k[1]]])
    assert held.dtype == object
    assert held.shape == (2, 2)
    np.testing.assert_allclose(numbers_of(np.dot(A, k)[2], names), A[2] @ NUMBERS["k"])


@pytest.mark.parametrize("relation", ["k <= 1", "k >= 1", "k < 1", "k > 1", "k == 1", "1 >= k", "1 == k", "k != 1"])
@pytest.mark.parametrize("one", [1.0, np.ones(3), ca.DM.ones(3), ca.MX.ones(3), np.float64(1)])
def test_comparisons_are_expressions(names, relation, one):
    made = eval(relation.replace("1", "one"), {"one": one, **names})
    assert isinstance(made, ca.MX)
    assert made.shape == (3, 1)


def test_a_plus_sign_changes_nothing(names):
    np.testing.assert_allclose(numbers_of(+names["k"], names).ravel(), NUMBERS["k"])


@pytest.mark.parametrize("shape", [(), 1, 3, (3,), [2, 3], (2, 3), (3, 1), (1, 3), np.array([2, 2])])
def test_shape_labels_and_entries_agree_column_by_column(shape):
    sizes = tuple(np.atleast_1d(np.asarray(shape, dtype=int)).tolist())
    variable = sysid.Variable("a b", shape, lower=0, upper=10)
    assert variable.shape == sizes
    assert variable.size == int(np.prod(sizes)) == len(variable.labels) == variable.symbol.numel()
    entries = np.arange(variable.size, dtype=float)
    shaped = variable.shaped(entries)
    assert shaped.shape == sizes
    # Each label names the entry of the array, and the entry of the symbol, that has its number.
    symbol = ca.Function("f", [variable.symbol], [variable.symbol])
    wide = np.asarray(symbol(ca.reshape(ca.DM(entries), *variable.symbol.shape)))
    for label, entry in zip(variable.labels, entries, strict=True):
        index = tuple(int(i) for i in re.findall(r"\d+", label))
        assert shaped[index] == entry
        assert wide[(*index, 0, 0)[:2]] == entry
        assert label.startswith("a b")


def test_bounds_and_guess_of_a_matrix_stand_column_by_column():
    low, high = np.arange(6.0).reshape(2, 3), np.arange(6.0).reshape(2, 3) + 10
    guess = np.arange(6.0).reshape(2, 3) + 3
    variable = sysid.Variable("A", (2, 3), lower=low, upper=high, guess=guess)
    np.testing.assert_array_equal(variable.lower, [0, 3, 1, 4, 2, 5])
    np.testing.assert_array_equal(variable.shaped(variable.upper), high)
    np.testing.assert_array_equal(variable.shaped(variable.guess), guess)
    rows = sysid.Variable("A", (2, 3), lower=0, upper=[1, 2, 3])
    np.testing.assert_array_equal(rows.shaped(rows.upper), [[1, 2, 3], [1, 2, 3]])


def test_the_guess_is_the_middle_of_the_search_on_its_own_scale():
    np.testing.assert_allclose(sysid.Variable("a", lower=-2, upper=6).guess, 2)
    np.testing.assert_allclose(sysid.Variable("a", lower=1e2, upper=1e6, log=True).guess, 1e4)
    assert not sysid.Variable("a", lower=0, upper=1).has_guess
    assert sysid.Variable("a", lower=0, upper=1, guess=0).has_guess


def test_sampling_is_logarithmic_between_the_bounds_and_unsampling_its_inverse():
    low, high = np.array([1e2, 3.0, 7.0]), np.array([1e6, 4.0, 7.0])
    variable = sysid.Variable("k", 3, lower=low, upper=high, log=True)
    s = ca.SX.sym("s", 3)
    sample = ca.Function("f", [s], [variable.sampling(s)])
    for share in np.linspace(0, 1, 7):
        x = np.asarray(sample(low + share * (high - low))).ravel()
        np.testing.assert_allclose(x, low ** (1 - share) * high**share, rtol=1e-12)
        np.testing.assert_allclose(variable.unsampling(x), low + share * (high - low), rtol=1e-9)
    plain, s = sysid.Variable("k", 3, lower=1, upper=2), ca.SX.sym("s", 3)
    assert plain.sampling(s) is s
    assert plain.unsampling(V) is V
    np.testing.assert_array_equal(np.asarray(plain.sampled()(V)).ravel(), V)


def test_a_symbol_leads_back_to_its_variable_and_to_no_other(names):
    for variable in names.values():
        (symbol,) = ca.symvar(ca.sumsqr(variable))
        assert variable_of(symbol) is variable
    assert variable_of(ca.MX.sym("k", 3)) is None


def test_split_cuts_a_vector_into_one_piece_a_variable(names):
    pieces = split(names.values(), np.arange(13.0))
    assert [piece.tolist() for piece in pieces] == [[0, 1, 2], [3], list(range(4, 13))]


def test_a_scalar_has_no_length_and_is_not_iterated(names):
    for use in (len, list):
        with pytest.raises(TypeError, match="variable 's' is a scalar"):
            use(names["s"])


def test_repr_names_bounds_unit_and_shape():
    text = repr(sysid.Variable("k", 3, lower=1, upper=2, unit="N/m"))
    assert all(part in text for part in ("k", "1 to 2", "N/m", "(3,)"))


REFUSED = {
    "reversed": (dict(lower=2, upper=1), "reversed: lower 2 is above upper 1"),
    "reversed in one entry": (dict(shape=3, lower=0, upper=[1, -1, 1]), "upper -1"),
    "infinite upper": (dict(lower=0, upper=np.inf), "finite"),
    "infinite lower": (dict(lower=-np.inf, upper=0), "finite"),
    "NaN bound": (dict(lower=np.nan, upper=0), "finite"),
    "None bound": (dict(lower=None, upper=0), "lower is not an array of real numbers: None"),
    "guess outside": (dict(lower=0, upper=1, guess=2), "guess 2 is outside the bounds 0 to 1"),
    "one guess outside": (dict(shape=2, lower=0, upper=1, guess=[0, -3]), "guess -3"),
    "NaN guess": (dict(lower=0, upper=1, guess=np.nan), "guess is not finite"),
    "infinite guess": (dict(lower=0, upper=1, guess=np.inf), "guess is not finite"),
    "equal bounds": (dict(lower=1, upper=1), "fixed=True"),
    "fixed without a guess": (dict(lower=0, upper=1, fixed=True), "needs a guess"),
    "log from zero": (dict(lower=0, upper=1, log=True), "positive bounds"),
    "log from below zero": (dict(lower=-1, upper=1, log=True), "positive bounds"),
    "text": (dict(lower="low", upper=1), "lower is not an array of real numbers: 'low'"),
    "complex": (dict(lower=0, upper=1j), "upper is complex"),
    "too few bounds": (dict(shape=3, lower=[0, 1], upper=2), "shape"),
    "ragged": (dict(shape=3, lower=[0, [1], 2], upper=3), "lower"),
    "bound of a scalar in a list": (dict(lower=0, upper=[1, 2]), "upper"),
    "guess of another shape": (dict(shape=(2, 2), lower=0, upper=1, guess=[1, 0, 1]), "guess"),
    "three axes": (dict(shape=(2, 2, 2), lower=0, upper=1), "shape"),
    "no entry": (dict(shape=0, lower=0, upper=1), "shape"),
    "negative size": (dict(shape=(2, -1), lower=0, upper=1), "shape"),
    "shape None": (dict(shape=None, lower=0, upper=1), "shape"),
    "text as shape": (dict(shape="three", lower=0, upper=1), "shape"),
}


@pytest.mark.parametrize("mistake", REFUSED)
def test_a_declaration_that_cannot_be_is_refused_with_name_file_and_line(mistake):
    given, words = REFUSED[mistake]
    with pytest.raises(sysid.InputError, match=re.escape(words)) as caught:
        sysid.Variable("stiff one", **given)
    line = inspect.currentframe().f_lineno - 1
    assert str(caught.value).startswith("variable 'stiff one' (")
    assert re.search(rf"test_unknowns\.py, line {line}\)", str(caught.value))


def test_a_column_of_casadi_numbers_is_a_bound():
    np.testing.assert_array_equal(sysid.Variable("k", 3, lower=ca.DM([0, 1, 2]), upper=5).lower, [0, 1, 2])


@pytest.mark.parametrize("given", [("k", 2.5), ("k", "3"), ("k", True), (3,), ("",), (None,)])
def test_a_shape_that_is_no_whole_number_and_a_name_that_is_no_text_are_refused(given):
    with pytest.raises(sysid.InputError):
        sysid.Variable(*given, lower=0, upper=1)


@pytest.mark.parametrize("index", [3, -4, (0, 1)])
def test_an_index_beyond_the_shape_is_refused_with_the_name(names, index):
    with pytest.raises((sysid.InputError, IndexError), match="'k'"):
        names["k"][index]


@pytest.mark.filterwarnings("ignore:overflow")
@pytest.mark.parametrize(("low", "high"), [(1e-200, 1e-180), (1e200, 1e250)])
def test_a_logarithmic_middle_is_found_whatever_the_scale(low, high):
    np.testing.assert_allclose(sysid.Variable("k", lower=low, upper=high, log=True).guess, np.sqrt(low) * np.sqrt(high))


def test_variables_are_declared_where_the_author_wrote_them_also_through_functions():
    def make(name):
        return sysid.Variable(name, lower=0, upper=1)  # the place

    variable = make("k")
    source, first = inspect.getsourcelines(inspect.currentframe())
    place = first + next(i for i, line in enumerate(source) if "# the place" in line)
    assert variable.declared.endswith(f"test_unknowns.py, line {place}")


def test_unknowns_refuse_bounds_that_disagree():
    with pytest.raises(sysid.InputError, match="disagree"):
        Unknown("x", np.zeros(2), np.ones(3))
    with pytest.raises(sysid.InputError, match="finite with lower <= upper"):
        Unknown("x", np.ones(2), np.zeros(2))
    with pytest.raises(sysid.InputError, match="x: upper holds NaN or infinite"):
        Unknown("x", np.ones(2), [2.0, np.inf])


def test_unknowns_of_models_are_counted_from_one_and_written_with_spaces():
    unknown = Unknown("mass_share", np.zeros(3), np.ones(3))
    assert unknown.title == "mass share"
    assert unknown.labels == ("mass share 1", "mass share 2", "mass share 3")
    assert Unknown("total_mass", 1.0, 2.0).labels == ("total mass",)
    assert (unknown.size, unknown.shape, unknown.fixed, unknown.has_guess) == (3, (3,), False, False)
    np.testing.assert_array_equal(unknown.shaped(V), V)


def test_a_guess_of_a_model_is_the_middle_as_the_swarm_sees_it():
    low, high = np.array([1.0, 4.0, 9.0]), np.array([4.0, 9.0, 9.0])
    sampling, unsampling = log_sampling(low, high)
    np.testing.assert_allclose(Unknown("k", low, high).guess, [2.5, 6.5, 9])
    logarithmic = Unknown("k", low, high, sampling=sampling, unsampling=unsampling, scale="log")
    np.testing.assert_allclose(logarithmic.guess, [2, 6, 9], rtol=1e-14)
    np.testing.assert_allclose(logarithmic.unsampling(np.array([2.0, 6, 9])), [2.5, 6.5, 9], rtol=1e-14)


def test_a_large_step_is_a_twentieth_of_the_range_or_the_size_itself():
    x = np.array([0.0, 3.0, -0.5, 7.0])
    unknowns = Unknown("a", np.zeros(2), [20.0, 20]), Unknown("b", [-1.0, 1], [1.0, 1e6], scale="log")
    # A twentieth of 20; the size 3 above it; and over decades the size alone.
    np.testing.assert_allclose(scales_of(unknowns, x), [1, 3, 0.5, 7])


def test_one_vector_and_an_array_a_name(names):
    assert slices_of(names.values()) == [slice(0, 3), slice(3, 4), slice(4, 13)]
    parts = by_name(names.values(), np.arange(13.0))
    np.testing.assert_array_equal(parts["k"], [0, 1, 2])
    assert parts["s"].shape == ()
    np.testing.assert_array_equal(parts["S"], [[4, 7, 10], [5, 8, 11], [6, 9, 12]])
