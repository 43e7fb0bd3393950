"""One thread for small tensors."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_GIVEN: ContextVar[int | None] = ContextVar("threads outside of one_thread", default=None)


def threads() -> int:
    """How many threads torch was given in the calling thread, whatever `one_thread` says."""
    import torch

    return _GIVEN.get() or torch.get_num_threads()


@contextmanager
def one_thread() -> Iterator[None]:
    """Have torch compute in one thread within the block, or, as a decorator, within a function.

    The tensors of a simulator have a few dozen numbers, and a picture has few enough: to wake a second thread takes
    longer than to add them up, and afterwards it stays awake for a while and takes a core from whatever else is
    running. The number is the calling thread's; a thread that first uses torch within the block has one as well, and
    keeps it.
    """
    import torch

    before = torch.get_num_threads()
    if before == 1:
        yield
        return
    token = _GIVEN.set(before)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _GIVEN.reset(token)
