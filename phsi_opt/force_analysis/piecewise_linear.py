"""Piecewise linear functions: what a force may be as a function of one variable or two.

Each basis is a set of columns, (n, n_knots), whose linear combinations are the
functions; at every value they sum to one, so that constants are among them.
"""

import numpy as np

N_KNOTS = 12  # of functions of one variable
N_PAIR_KNOTS = 7  # of functions of two variables, for each
# Quantiles of the variable at the outer knots: the extreme hundredths share them.
OUTER_QUANTILES = (0.01, 0.99)


def piecewise_linear_basis(z: np.ndarray, n_knots: int = N_KNOTS) -> np.ndarray:
    """Functions of a variable z (n,) that are linear between knots, (n, n_knots).

    Each is one at its knot and zero at the others; beyond the outer knots all are
    constant. Knots stand half way between even spacing and even occupation; there are
    fewer columns where they fall together.
    """
    quantiles = np.quantile(z, np.linspace(*OUTER_QUANTILES, n_knots))
    even = np.linspace(quantiles[0], quantiles[-1], n_knots)
    knots = np.unique((quantiles + even) / 2)
    peaks = np.eye(len(knots))
    return np.column_stack([np.interp(z, knots, peak) for peak in peaks])


def product_basis(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products of piecewise linear functions of two variables (n,), (n, n_products)."""
    of_a = piecewise_linear_basis(a, N_PAIR_KNOTS)
    of_b = piecewise_linear_basis(b, N_PAIR_KNOTS)
    products = of_a[:, :, None] * of_b[:, None, :]
    return np.asarray(products.reshape(len(a), -1))


def odd_basis(z: np.ndarray) -> np.ndarray:
    """Odd piecewise linear functions of a variable z (n,); they jump at zero."""
    of_size = piecewise_linear_basis(np.abs(z), N_KNOTS // 2)
    return np.asarray(np.sign(z)[:, None] * of_size)
