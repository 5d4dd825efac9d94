"""The Cramer-Rao bound of an experiment: how small the error of any unbiased estimate
can be.

The true system is integrated together with its sensitivities to the parameters and to
the starting state of every trajectory, with Jacobians from SymPy and an integrator from
SciPy. Nothing of phsi_opt is used, so that the bound can check it. The noise is normal,
independent and of known size; a noise that has to be estimated as well does not change
the bound of the parameters, because the information matrix has no entries between the
two.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import sympy
from scipy.integrate import solve_ivp

RTOL = 1e-11
ATOL = 1e-13
TINY = 1e-300  # keeps quotients finite


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """States (n_trajectories, n_samples, n_states) with their slopes in the starting
    state (..., n_states, n_states) and in the parameters (..., n_states, n_parameters).
    """

    states: np.ndarray
    in_start: np.ndarray
    in_theta: np.ndarray


@dataclass(frozen=True)
class TrueSystem:
    """dx/dt = rates(t, x, parameters) as SymPy text, with the true values of the
    parameters.

    ``names`` are the names under which a fitted model knows the parameters, in their
    order.
    """

    states: tuple[str, ...]
    rates: tuple[str, ...]
    values: Mapping[str, float]
    names: tuple[str, ...]

    @property
    def truth(self) -> dict[str, float]:
        """True values by the names of the fitted model."""
        return dict(zip(self.names, self.values.values(), strict=True))

    @cached_property
    def rates_and_slopes(self) -> Callable[..., Any]:
        """NumPy function of (t, x, theta): rates, their slopes in x, those in theta."""
        names = (*self.states, *self.values, "t")
        symbols = {name: sympy.Symbol(name, real=True) for name in names}
        rates = sympy.Matrix(
            [sympy.sympify(text, locals=dict(symbols)) for text in self.rates]
        )
        x = [symbols[name] for name in self.states]
        theta = [symbols[name] for name in self.values]
        everything = [list(rates), list(rates.jacobian(x)), list(rates.jacobian(theta))]
        arguments = (symbols["t"], x, theta)
        return sympy.lambdify(arguments, everything, "numpy", cse=True)

    def sensitivities(self, starts: np.ndarray, t: np.ndarray) -> Sensitivities:
        """True states from ``starts`` (n_trajectories, n_states), and their slopes."""
        m, n = starts.shape
        theta = list(self.values.values())
        p = len(theta)
        both = self.rates_and_slopes
        shape = (m, n, 1 + n + p)  # the state, slopes in the start, in the parameters

        def f(at: float, flat: np.ndarray) -> np.ndarray:
            z = flat.reshape(shape)
            rates, in_x, in_theta = (
                _filled(part, m) for part in both(at, z[:, :, 0].T, theta)
            )
            slopes = in_x.T.reshape(m, n, n) @ z[:, :, 1:]
            slopes[:, :, n:] += in_theta.T.reshape(m, n, p)
            return np.concatenate([rates.T[:, :, None], slopes], axis=2).ravel()

        start = np.zeros(shape)
        start[:, :, 0] = starts
        start[:, :, 1 : 1 + n] = np.eye(n)
        solved = solve_ivp(
            f, (t[0], t[-1]), start.ravel(), "DOP853", t, rtol=RTOL, atol=ATOL
        )
        if not solved.success:
            raise ArithmeticError(
                f"the true system cannot be integrated: {solved.message}"
            )
        z = solved.y.T.reshape(len(t), *shape).transpose(1, 0, 2, 3)
        return Sensitivities(z[..., 0], z[..., 1 : 1 + n], z[..., 1 + n :])


def _filled(rows: Sequence[Any], m: int) -> np.ndarray:
    """Constants repeated for every trajectory: (n_rows, n_trajectories)."""
    full = [np.broadcast_to(row, m) for row in rows]
    return np.array(full, dtype=float).reshape(len(rows), m)


def pseudo_hamiltonian(
    states: Sequence[str],
    S: np.ndarray,
    H: str,
    R: Mapping[str, str],
    F: Mapping[str, str],
) -> tuple[str, ...]:
    """(S - R) grad H + F as text, by SymPy; R and F by equation."""
    symbols = {name: sympy.Symbol(name) for name in states}

    def read(text: str) -> Any:
        return sympy.sympify(text, locals=dict(symbols))

    energy = read(H)
    efforts = [sympy.diff(energy, symbols[name]) for name in states]
    rows = []
    for i, name in enumerate(states):
        row = sympy.Integer(0)
        for entry, effort in zip(S[i], efforts, strict=True):
            # Halves and whole numbers, as S has them, stay exact.
            row += sympy.nsimplify(entry) * effort
        row -= read(R.get(name, "0")) * efforts[i]
        rows.append(str(row + read(F.get(name, "0"))))
    return tuple(rows)


def _told(
    slopes: Sensitivities, sigma: np.ndarray, measured: np.ndarray | None
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """What each trajectory tells of the parameters alone."""
    in_theta = slopes.in_theta
    weight = np.broadcast_to(1 / np.asarray(sigma), in_theta.shape[:-1]).copy()
    if measured is not None:
        weight[~measured] = 0.0
    for w, start, theta in zip(weight, slopes.in_start, in_theta, strict=True):
        column = w.reshape(-1, 1)
        J0 = start.reshape(w.size, -1) * column
        J = theta.reshape(w.size, -1) * column
        length = np.maximum(np.linalg.norm(J0, axis=0), TINY)
        span = np.linalg.qr(J0 / length)[0]
        yield w, J - span @ (span.T @ J)


def covariance_bound(
    slopes: Sensitivities, sigma: np.ndarray, measured: np.ndarray | None = None
) -> np.ndarray:
    """Least covariance of an unbiased estimate of the parameters, (n_parameters,
    n_parameters): the inverse of their Fisher information, starting states unknown.
    """
    n_theta = slopes.in_theta.shape[-1]
    matrix = np.zeros((n_theta, n_theta))
    for _, left in _told(slopes, sigma, measured):
        matrix += left.T @ left
    scale = 1 / np.sqrt(np.diag(matrix))
    products = np.outer(scale, scale)
    return np.linalg.inv(matrix * products) * products


def efficient_error(
    slopes: Sensitivities,
    sigma: np.ndarray,
    noise: np.ndarray,
    measured: np.ndarray | None = None,
) -> np.ndarray:
    """Error of the estimate that attains the bound: least squares on the experiment
    linearised at the truth, which nobody can compute who does not know the truth.
    """
    pull = np.zeros(slopes.in_theta.shape[-1])
    told = _told(slopes, sigma, measured)
    for (w, left), one in zip(told, noise, strict=True):
        pull += left.T @ np.where(w > 0, w * one, 0.0).ravel()
    return covariance_bound(slopes, sigma, measured) @ pull
