"""One question asked of many seeds."""

from collections.abc import Callable
from typing import TypeVar

from phsi_opt.sweeps.sweep import sweep
from problems.tools.command_line import option
from problems.tools.workers import workers

Answer = TypeVar("Answer")


def asked(
    answer: Callable[[int], Answer], first: int, n_seeds: int
) -> dict[str, Answer]:
    """The answer to each seed, side by side; the command line may choose others.

    Args:
        answer: what a seed gives.
        first: seed, where there is no ``--first``.
        n_seeds: how many, where there is no ``--seeds``.
    """
    first = int(option("first", str(first)))
    n_seeds = int(option("seeds", str(n_seeds)))
    cases = {str(seed): seed for seed in range(first, first + n_seeds)}
    with workers() as executor:
        found = {d.key: d.result for d in sweep(answer, cases, executor=executor)}
    return {name: found[name] for name in cases}
