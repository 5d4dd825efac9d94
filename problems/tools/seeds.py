"""One question asked of many seeds, and the page of the answers."""

from collections.abc import Callable
from typing import TypeVar

from phsi_opt.sweeps.sweep import sweep
from problems.tools import provenance
from problems.tools.command_line import option
from problems.tools.workers import workers

Answer = TypeVar("Answer")


def ask_and_write(
    answer: Callable[[int], Answer],
    first: int,
    n_seeds: int,
    page: Callable[[dict[str, Answer]], str],
    name: str,
) -> None:
    """Ask every seed, side by side, and write the page.

    The command line may choose other seeds; their page is only printed.

    Args:
        answer: what a seed gives.
        first: seed of the page.
        n_seeds: how many, where there is no ``--seeds``.
        page: of all answers.
        name: of its file.
    """
    begin = int(option("first", str(first)))
    n_asked = int(option("seeds", str(n_seeds)))
    cases = {str(seed): seed for seed in range(begin, begin + n_asked)}
    with workers() as executor:
        found = {d.key: d.result for d in sweep(answer, cases, executor=executor)}
    answers = {seed: found[seed] for seed in cases}
    if begin == first:
        provenance.write(name, page(answers))
        return
    for seed, one in answers.items():
        print(seed, one)
    print(page(answers))
