"""Failures in words, and which of them are the machine's: of its disk, memory, network or GPU."""

from collections.abc import Iterator
from dataclasses import dataclass
from errno import EDQUOT, EIO, EMFILE, ENFILE, ENOLCK, ENOMEM, ENOSPC, EROFS, ESTALE, ETIMEDOUT

from lerobot_constructskill.errors import MachineError, TakenError, full_traceback, kind_of

ERRNOS = (ENOSPC, EDQUOT, EROFS, EIO, EMFILE, ENFILE, ENOMEM, ESTALE, ENOLCK, ETIMEDOUT)
"""What an `OSError` says of the machine, its disks and its network."""

NETWORK = {"ConnectionError", "TimeoutError", "HTTPError"}
"""Classes of errors of the network: of Python, requests and httpx."""

NO_MEMORY = ("can't allocate memory", "out of memory", "OutOfDeviceMemory", "OutOfHostMemory")
"""What torch, on a CPU and on a GPU, and Vulkan say in a `RuntimeError` when memory runs out."""

OF_THE_MACHINE = (
    *(*NO_MEMORY, "No space left on device", "Disk quota exceeded", "CUDA error", "NVIDIA driver"),
    *("ConnectError", "ConnectionError", "ConnectTimeout", "ReadTimeout", "Connection reset"),
)
"""What a `RuntimeError` says of a disk, the network or a GPU, which may work the next time."""


@dataclass(frozen=True)
class Failure:
    """Why something could not be made, in words: some exceptions cannot be sent to another process.

    Args:
        kind: as `errors.kind_of` calls it; "machine" for all failures of the machine.
        said: the exception in one line.
        traceback: the exception with all of its causes.
        is_of_the_machine: whether it may work the next time.
    """

    kind: str
    said: str
    traceback: str
    is_of_the_machine: bool

    @classmethod
    def of(cls, error: Exception) -> "Failure":
        said = " ".join(f"{type(error).__name__}: {error}".split())
        by_machine = is_of_the_machine(error)
        return cls(MachineError.kind if by_machine else kind_of(error), said, full_traceback(error), by_machine)

    def error(self) -> MachineError:
        """The failure as an exception again."""
        return MachineError(self.said.removeprefix(f"{MachineError.__name__}: "))


def is_of_the_machine(error: BaseException) -> bool:
    """Whether an exception, or one that led to it, is a failure of the disk, the memory, the network or the GPU."""
    return isinstance(error, TakenError | MachineError | MemoryError) or any(map(_says_so, _chain(error)))


def _says_so(error: BaseException) -> bool:
    if isinstance(error, RuntimeError):
        return any(words in str(error) for words in OF_THE_MACHINE)
    is_of_network = not NETWORK.isdisjoint(kind.__name__ for kind in type(error).__mro__)
    return is_of_network or (isinstance(error, OSError) and error.errno in ERRNOS)


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__
