"""One thread of torch: what is trained on small batches is then faster, and repeatable.

torch is imported inside, so that rooms which train only on request can import this.
"""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute with one thread inside, and with as many as before afterwards.

    Small batches are slower with more threads, and the order of sums, and so the last
    bits, would depend on their number.
    """
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
