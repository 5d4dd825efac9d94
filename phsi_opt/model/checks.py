"""Checks of what a model is made from: structure matrix and dictionaries.

Each returns the part in the form in which the model keeps it.
"""

from typing import Any

import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.model.terms import Dictionary


def checked_structure(S: Any, n: int) -> tuple[tuple[float, ...], ...]:
    """The structure matrix S, (n, n), as rows; zero where none is given.

    Raises:
        ModelError: S is no n x n matrix of numbers, or is not skew-symmetric.
    """
    try:
        matrix = np.zeros((n, n)) if S is None else np.array(S, dtype=float)
    except (TypeError, ValueError):
        raise ModelError(
            f"S={S!r} is not a matrix of numbers; expected {n} x {n}."
        ) from None
    if matrix.shape != (n, n):
        raise ModelError(
            f"S has shape {matrix.shape}; expected ({n}, {n}), "
            "one row and column per state."
        )
    wrong = ~np.isfinite(matrix) | (matrix != -matrix.T)
    if np.any(wrong):
        i, j = np.argwhere(wrong)[0]
        raise ModelError(
            f"S is not skew-symmetric: S[{i}, {j}]={matrix[i, j]:g} "
            f"but S[{j}, {i}]={matrix[j, i]:g}; "
            "expected S[j, i] = -S[i, j]. Put losses into R."
        )
    return tuple(map(tuple, matrix.tolist()))


def checked_dictionary(terms: Any, where: str) -> Dictionary:
    """The terms themselves, if they are a dictionary.

    Raises:
        ModelError: they are something else.
    """
    if not isinstance(terms, Dictionary):
        raise ModelError(
            f"{where}={terms!r} is not a dictionary of terms; "
            "write formula('...') or polynomials([...], n)."
        )
    return terms
