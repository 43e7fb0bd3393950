"""One thread for small tensors."""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_thread() -> Iterator[None]:
    """Have torch compute in one thread within the block, or, as a decorator, within a function.

    The tensors of a simulator have a few dozen numbers: to wake a second thread takes longer than to add them up, and
    takes a core from whatever else is running. The number is the calling thread's; a thread that first uses torch
    within the block has one as well, and keeps it.
    """
    import torch

    before = torch.get_num_threads()
    if before > 1:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        if before > 1:
            torch.set_num_threads(before)
