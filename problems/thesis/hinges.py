"""The force of a hybrid's network of one variable as a dictionary of smooth hinges.

Then all is one program, which maximum likelihood can solve.
"""

import numpy as np

import phsi_opt as ph
from phsi_opt.learning.hybrid import Hybrid
from phsi_opt.model.terms import Dictionary, Term

DECIMALS = 6  # of places and widths in the texts of terms
DEPENDENT = 1e-10  # share of the largest singular value below which hinges are the same
KNOTS = 12


def hinges(hybrid: Hybrid, data: ph.Measurements) -> dict[str, Dictionary]:
    """A dictionary by equation, fitted to the network where the data have been.

    With knots v_k at quantiles of the visited values, w half their median distance, and
    coefficients by least squares::

        F(v) = c + a v + sum_k b_k sqrt((v - v_k)^2 + w^2)

    Args:
        hybrid: whose network depends on one state.
        data: with the states of the model, in its order.
    """
    (name,) = hybrid.force.variables
    x = np.concatenate([run.x for run in data.trajectories])
    x = x[np.isfinite(x).all(axis=1)]
    visited = x[:, hybrid.model.states.index(name)]
    places = np.quantile(visited, np.linspace(0.0, 1.0, KNOTS + 2)[1:-1])
    places = np.unique(np.round(places, DECIMALS))
    width = round(float(np.median(np.diff(places))) / 2, DECIMALS)
    bodies = ["1", name]
    columns = [np.ones_like(visited), visited]
    for place in places.tolist():
        bodies.append(f"sqrt(({name} - {place!r})**2 + {width!r}**2)")
        columns.append(np.sqrt((visited - place) ** 2 + width**2))
    terms = np.column_stack(columns)
    scale = np.sqrt(np.mean(terms**2, axis=0))
    found = np.linalg.lstsq(terms / scale, hybrid.force(x), rcond=DEPENDENT)[0]
    dictionaries = {}
    for equation, sizes in zip(hybrid.force.equations, found.T, strict=True):
        pairs = zip(bodies, (sizes / scale).tolist(), strict=True)
        summands = [Term(body, ph.Parameter(size)) for body, size in pairs]
        dictionaries[equation] = Dictionary(tuple(summands))
    return dictionaries
