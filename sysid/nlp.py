"""A nonlinear program: unknowns, equalities and bounds collected piece by piece, one run of IPOPT, its monitor."""

from __future__ import annotations

import contextlib
import functools
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import casadi as ca
import numpy as np
import scipy
from numpy.typing import NDArray
from threadpoolctl import OpenBLASController, ThreadpoolController, register

from sysid.errors import listed

Array = NDArray[np.floating[Any]]

OBJECTIVE_SCALE = 1e3  # lifts a residual of 1e-8 above IPOPT's tolerance
_TOLERANCE = 1e-9  # of IPOPT, of constraints too
_ENDED = {
    "Solve_Succeeded": "the solver ended as it should",
    "Solved_To_Acceptable_Level": "the solver ended near enough to its optimum",
    "Maximum_Iterations_Exceeded": "the solver ran out of iterations",
    "Maximum_WallTime_Exceeded": "the solver ran out of time",
    "Infeasible_Problem_Detected": "the solver found no point that keeps the constraints",
}
_LOADED = 3.0  # times the seconds of an idle processor that work may take on a machine that does other things too
GRACE = 0.4  # s, by which work may end late: what each of the last steps has, however late it begins
_TOO_SMALL = "Search_Direction_Becomes_Too_Small"  # IPOPT's word, where no step shows in the objective
_LATE = "Maximum_WallTime_Exceeded"  # IPOPT's word, which does not count the making of the graphs


def ended_in_words(status: str) -> str:
    """IPOPT's status, and what that means."""
    return f"IPOPT: {status}" + (f" ({_ENDED[status]})" if status in _ENDED else "")


def suffices(left: float, seconds: float) -> bool:
    """True where the time that is `left` is enough for work that takes about so many seconds of a processor."""
    return _LOADED * seconds < left + GRACE


def time_too_short(seconds: float) -> str:
    """The status of a run whose graphs would have taken so many seconds, and the time did not allow them."""
    return f"not begun, as its derivatives take some {seconds:.1g} s to set up: too little time"


def quiet_options(max_iterations: int, **ipopt: float | str) -> dict[str, Any]:
    """Options of a run of IPOPT that prints nothing, with further ones of IPOPT's own."""
    return {
        "print_time": False,
        "show_eval_warnings": False,  # a step too long is IPOPT's to shorten
        # Nobody asks for multipliers of parameters; their expressions take a seventh of a fit.
        "no_nlp_grad": True,
        "calc_lam_p": False,
        "ipopt": {"print_level": 0, "sb": "yes", "max_iter": max_iterations, **ipopt},
    }


class _BlasOfIpopt(OpenBLASController):
    """The OpenBLAS that CasADi's wheels bring for IPOPT, under a name that threadpoolctl does not know."""

    filename_prefixes = ("libcasadi-tp-openblas", "casadi-tp-openblas")


register(_BlasOfIpopt)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Hold NumPy's, SciPy's and IPOPT's linear algebra to one thread: the same bits on any number of processors."""
    with _blas().limit(limits=1):
        yield


@functools.cache
def _blas() -> ThreadpoolController:
    """Libraries of linear algebra, which take milliseconds to find."""
    import scipy.linalg  # noqa: F401 - only libraries that are loaded can be limited

    ca.has_nlpsol("ipopt")  # loads it
    return ThreadpoolController()


def product(one: ca.MX, other: ca.MX) -> ca.MX:
    """A dense product by BLAS, not by CasADi's own loops."""
    return ca.mtimes(one, other, "classic")


class NumpyFunction(ca.Callback):
    """A function that NumPy computes, as CasADi calls it: of a column and other matrices, to matrices.

    It must live as long as what calls it: CasADi holds no Python object, and takes Ctrl-C for an error (`interrupt`).
    """

    def __init__(
        self, call: Callable[..., Sequence[Any]], inputs: Sequence[ca.Sparsity], outputs: Sequence[ca.Sparsity]
    ) -> None:
        ca.Callback.__init__(self)
        self.call_numpy, self.inputs, self.outputs = call, inputs, outputs
        self.interrupt: KeyboardInterrupt | None = None
        self.construct("by_numpy", {})

    def get_n_in(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    def get_n_out(self) -> int:
        """Number of outputs."""
        return len(self.outputs)

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Pattern of an input."""
        return self.inputs[i]

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Pattern of an output."""
        return self.outputs[i]

    def eval(self, arg: list) -> list:
        """Values at a column, which NumPy is given as an array."""
        try:
            return [*self.call_numpy(np.asarray(arg[0]).ravel(), *arg[1:])]
        except KeyboardInterrupt as interrupt:
            self.interrupt = interrupt
            raise


class NonlinearProgram:
    """Unknowns z, and the equalities and inequalities between them."""

    def __init__(self) -> None:
        self.pieces: list[ca.MX] = []
        self.names: list[str] = []
        self.labels: list[str] = []
        self.start: list[Array] = []
        self.lower: list[Array] = []
        self.upper: list[Array] = []
        self.constraints: list[ca.MX] = []
        self._lower: list[Array] = []
        self._upper: list[Array] = []

    @property
    def z(self) -> ca.MX:
        """All unknowns, (p, 1)."""
        return ca.vertcat(*self.pieces)

    @property
    def rows(self) -> ca.MX:
        """All constraints, a column."""
        return ca.vertcat(ca.MX(0, 1), *self.constraints)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of all unknowns, (p,) each."""
        return np.concatenate(self.lower), np.concatenate(self.upper)

    @property
    def limits(self) -> tuple[Array, Array]:
        """Lower and upper bounds of all constraints."""
        below, above = (np.concatenate([np.zeros(0), *part]) for part in (self._lower, self._upper))
        return below, above

    def gradient(self, value: ca.MX, slope: ca.MX) -> ca.Function:
        """An objective's value and gradient by the unknowns, as nlpsol's `grad_f`, in IPOPT's scale."""
        outputs = [OBJECTIVE_SCALE * value, OBJECTIVE_SCALE * slope]
        return ca.Function("gradient", [self.z, ca.MX.sym("p", 0)], outputs, ["x", "p"], ["f", "grad_f_x"])

    def hessian(self, of_objective: ca.MX, *, curved: int | None = None) -> ca.Function:
        """Hessian of the Lagrangian with that of the objective as given, as nlpsol's `hess_lag`.

        That of the constraints is CasADi's own: of the first `curved` rows, the others counting as straight; of all
        where None.
        """
        at, rows = self.z, self.rows
        p, factor, multipliers = ca.MX.sym("p", 0), ca.MX.sym("factor"), ca.MX.sym("multipliers", rows.numel())
        hessian = OBJECTIVE_SCALE * factor * of_objective
        count = rows.numel() if curved is None else curved
        if count:
            hessian += ca.hessian(ca.dot(multipliers[:count], rows[:count]), at)[0]
        return ca.Function(
            "hessian", [at, p, factor, multipliers], [ca.triu(hessian)],
            ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"],
        )  # fmt: skip

    def variable(
        self,
        name: str,
        start: Array,
        lower: Array | float = -np.inf,
        upper: Array | float = np.inf,
        labels: Sequence[str] | None = None,
    ) -> ca.MX:
        """Further unknowns of the shape of `start`.

        In messages `labels` follow the name; without them the unknowns are numbered from 1.
        """
        shape = start.shape if start.ndim == 2 else (start.size, 1)
        symbol = ca.MX.sym(name, *shape)
        self.pieces.append(ca.vec(symbol))
        self.names += [name] * start.size
        self.labels += labels or [f" {i + 1}" for i in range(start.size)]
        self.start.append(start.ravel(order="F"))
        self.lower.append(np.broadcast_to(lower, start.shape).ravel(order="F"))
        self.upper.append(np.broadcast_to(upper, start.shape).ravel(order="F"))
        return symbol

    def constrain(self, expression: ca.MX, lower: Array | float = 0.0, upper: Array | float = 0.0) -> None:
        """Hold an expression, a column, between bounds; at zero by default."""
        self.constraints.append(expression)
        self._lower.append(np.broadcast_to(lower, expression.numel()))
        self._upper.append(np.broadcast_to(upper, expression.numel()))

    def minimize(
        self,
        objective: ca.MX,
        monitor: IterationMonitor,
        max_iterations: int,
        derivatives: dict[str, ca.Function] | None = None,
        *,
        acceptable: float = 1e2,
        barrier: Literal["adaptive", "monotone"] = "adaptive",
    ) -> tuple[Array, str]:
        """Run IPOPT on `objective`, which is 1 where nothing is explained; the unknowns at its end, and its status.

        `derivatives` are functions in the place of CasADi's own, as `nlpsol` names them; `acceptable` is the tolerance
        that five iterates in a row must meet, in units of the tolerance; `barrier` is IPOPT's way to lower its barrier
        parameter. Where the monitor was stopped the status is "stopped", and the unknowns are the last iterate's.
        """
        nlp = {"x": self.z, "f": OBJECTIVE_SCALE * objective, "g": self.rows}
        (lower, upper), (below, above) = self.bounds, self.limits
        start = np.clip(np.concatenate(self.start), lower, upper)
        call = monitor.callback(start, below.size)

        def run(at: Array, tolerance: float) -> tuple[str, Array]:
            monitor.begun = monitor.taken
            limits = {"max_wall_time": max(monitor.left, 0.1)} if np.isfinite(monitor.left) else {}
            quiet = quiet_options(
                max_iterations, tol=tolerance, acceptable_tol=acceptable * tolerance, acceptable_iter=5,
                constr_viol_tol=1e-11, mu_strategy=barrier, **limits,
            )  # fmt: skip
            options = {**quiet, "iteration_callback": call, **(derivatives or {})}
            solver = ca.nlpsol("local", "ipopt", nlp, options)
            answer = solver(x0=at, lbx=lower, ubx=upper, lbg=below, ubg=above)
            status = solver.stats()["return_status"]
            if status == "User_Requested_Stop":
                status = _LATE if monitor.is_over or not monitor.stands_still else _TOO_SMALL
            return status, np.asarray(answer["x"]).ravel()

        try:
            status, best = run(start, _TOLERANCE)
            if status == _TOO_SMALL and monitor.stopped is None:
                # Noise can leave the gradient's round-off above the tolerance: the same point is judged by a wider one.
                status, best = run(best, 1e3 * _TOLERANCE)
        except KeyboardInterrupt as interrupt:
            monitor.stopped = interrupt
        if monitor.stopped is not None:
            return monitor.z, "stopped"
        return best, status

    def finished(self, rows: ca.MX, at: Array) -> Array:
        """Unknowns nearer to a zero of `rows`, by Gauss-Newton steps for as long as each halves what is left.

        For small residuals: a step solves the linear least squares by orthogonal factors, so that neither squares nor a
        barrier hide what `rows` hardly shows. Equalities are kept; a step over a bound is not taken.
        """
        (lower, upper), (below, above) = self.bounds, self.limits
        held, g = below == above, self.rows
        outputs = [rows, ca.densify(ca.jacobian(rows, self.z)), g, ca.densify(ca.jacobian(g, self.z))]
        function = ca.Function("rows", [self.z], outputs)
        best, left, violated = at, np.inf, np.inf
        while np.all((at >= lower) & (at <= upper)):
            r, J, c, A = (np.asarray(part) for part in function(at))
            r, c = r.ravel(), c.ravel()
            over = np.concatenate([below - c, c - above, [_TOLERANCE]]).max()
            if not (np.linalg.norm(r) < left / 2 and over <= violated):
                break
            best, left, violated = at, float(np.linalg.norm(r)), over
            free = scipy.linalg.null_space(A[held]) if np.any(held) else np.eye(at.size)
            back = np.linalg.lstsq(A[held], (below - c)[held])[0]
            at = at + back - free @ np.linalg.lstsq(J @ free, r + J @ back)[0]
        return best

    def on_bounds(self, at: Array) -> str:
        """Which unknowns press against a finite bound at a solution, in words."""
        lower, upper = self.bounds
        free = upper > lower  # what is held fixed rests on no bound
        with np.errstate(invalid="ignore"):
            near = 1e-6 * np.where(np.isfinite(upper - lower), upper - lower, 1.0)
            low, high = np.isfinite(lower) & (at - lower < near), np.isfinite(upper) & (upper - at < near)
        ended: dict[str, list[str]] = {}
        for name, label, is_low, is_high in zip(self.names, self.labels, low & free, high & free, strict=True):
            if is_low or is_high:
                ended.setdefault(name, []).append(f"{label} ({'lower' if is_low else 'upper'})")
        return "; ".join(f"{name}{listed(which, ',')}" for name, which in ended.items())


class IterationMonitor:
    """Monitor of the iterations of all runs of IPOPT: the curve, the listener, and its wish to stop.

    The listener is called with (iteration, objective) after each iteration; whatever it raises stops the solver.
    `max_time`, in s, is for all runs and what is made before them.
    """

    def __init__(self, listener: Callable[[int, float], object] | None, max_time: float | None) -> None:
        self.listener = listener
        self.deadline = np.inf if max_time is None else time.perf_counter() + max_time
        self.curve: list[float] = []
        self.begun = 0  # iterates before the run
        self.stopped: BaseException | None = None
        self.z: Array = np.zeros(0)

    @property
    def left(self) -> float:
        """Seconds until the deadline."""
        return self.deadline - time.perf_counter()

    @property
    def is_over(self) -> bool:
        """True where the deadline has passed."""
        return self.left <= 0

    def allows(self, seconds: float) -> bool:
        """True where work that cannot be stopped, and takes about so many seconds of a processor, may begin."""
        return suffices(self.left, seconds)

    @property
    def stands_still(self) -> bool:
        """True where no iterate of the last 20 of a run changed the objective but for its round-off."""
        last = self.curve[max(self.begun, self.taken - 20) :]
        return len(last) == 20 and max(last) - min(last) < 1e-12 * last[-1]

    @property
    def taken(self) -> int:
        """Iterates so far."""
        return len(self.curve)

    def callback(self, start: Array, n_constraints: int) -> ca.Callback:
        """The callback that `nlpsol` calls after each iteration."""
        self.z = start
        n = start.size
        sizes = {"x": n, "f": 1, "g": n_constraints, "lam_x": n, "lam_g": n_constraints, "lam_p": 0}
        inputs = [ca.Sparsity.dense(sizes[ca.nlpsol_out(i)]) for i in range(ca.nlpsol_n_out())]
        # A nonzero answer stops IPOPT.
        return NumpyFunction(lambda z, f, *_: [int(self.record(z, float(f)))], inputs, [ca.Sparsity.dense(1)])

    def record(self, z: Array, objective: float) -> bool:
        """Record an iterate; whether to stop."""
        try:
            self.z = z
            self.curve.append(float(np.sqrt(max(objective, 0.0) / OBJECTIVE_SCALE)))
            if self.listener is not None:
                self.listener(len(self.curve) - 1, self.curve[-1])
        except BaseException as error:  # must not unwind through IPOPT; the caller raises it again
            self.stopped = error
        return self.stopped is not None or self.is_over or self.stands_still
