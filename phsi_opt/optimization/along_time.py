"""Factors of systems along the time, by what their patterns and sizes allow."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from phsi_opt.optimization.banded import Banded, BandLayout
from phsi_opt.optimization.chained import Chained, ChainLayout


@dataclass(frozen=True, eq=False)
class Chain:
    """Nodes along the time, and intervals that join neighbours.

    Attributes:
        begin: (n_intervals,) first node of each interval; the next node is its end.
        n_nodes: number of nodes.
        n_states: number of states at a node.
    """

    begin: np.ndarray
    n_nodes: int
    n_states: int


@dataclass(frozen=True, eq=False)
class TimeLayout:
    """A symmetric pattern of states and multipliers, filled again and again.

    Attributes:
        rows: (n_entries,) row of every entry; entries at one place are added.
        columns: (n_entries,) its column.
        order: (n,), the unknowns in the order in which they make a band.
        chain: nodes and intervals that the unknowns belong to; None: a band is all.
    """

    rows: np.ndarray
    columns: np.ndarray
    order: np.ndarray
    chain: Chain | None

    @cached_property
    def _banded(self) -> BandLayout:
        return BandLayout(self.rows, self.columns, self.order, is_symmetric=True)

    @cached_property
    def _chained(self) -> ChainLayout | None:
        chain = self.chain
        if chain is None:
            return None
        return ChainLayout.of(
            self.rows, self.columns, chain.begin, chain.n_nodes, chain.n_states
        )

    def factors(self, entries: np.ndarray) -> Banded | Chained:
        """Of the matrix with these entries (n_entries,).

        Raises:
            SolveError: the matrix is singular.
        """
        chained = self._chained and Chained.of(self._chained, entries)
        return chained or Banded.of(self._banded, entries)
