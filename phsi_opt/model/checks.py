"""Checks of what a model is made from: names, structure matrix, dictionaries.

Each returns the part in the form in which the model keeps it.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from phsi_opt.data.checks import RESERVED_PREFIXES
from phsi_opt.errors import ModelError
from phsi_opt.model.backends import CONSTANTS, FUNCTIONS
from phsi_opt.model.terms import Dictionary


def checked_names(
    names: Sequence[str], what: str, may_be_empty: bool = False
) -> tuple[str, ...]:
    """The names as a tuple, if states, inputs or memory can be called so.

    Raises:
        ModelError: text in place of a list, a name that formulas cannot use, a name
            that stands twice, or none where one is needed.
    """
    if isinstance(names, str):
        raise ModelError(
            f"{what}={names!r} must be a list of names, such as [{names!r}]."
        )
    listed = tuple(names)
    for name in listed:
        is_name = isinstance(name, str) and name.isidentifier()
        is_taken = name in ("t", *FUNCTIONS, *CONSTANTS)
        if not is_name or is_taken or name.startswith(RESERVED_PREFIXES):
            raise ModelError(
                f"{name!r} in {what} cannot be a name here; use letters, digits and _, "
                "and not t, a function, or what begins with dH_d or dF_d, as "
                "derivatives do."
            )
    if len(set(listed)) != len(listed) or (not listed and not may_be_empty):
        raise ModelError(
            f"{what}={list(listed)!r} must name at least one, and each only once."
        )
    return listed


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
