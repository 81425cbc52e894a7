"""Memory settings of a training process, where the C library is glibc; elsewhere they do nothing."""

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

# Parameters and the optimizer's state take several megabytes, all of which are touched in every step.
LARGE_PAGES = {"GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"}  # for the environment of a new process

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h


def keep_freed_memory() -> None:
    """Let freed memory stay with the process.

    It would be given back to the system in large blocks, and every step would have the gradients' pages
    mapped anew.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, 32 << 20)
        mallopt(M_TRIM_THRESHOLD, 512 << 20)


@contextmanager
def large_pages() -> Iterator[None]:
    """Let processes that are started meanwhile ask for large pages, unless their use is set already."""
    new = {key: value for key, value in LARGE_PAGES.items() if key not in os.environ}
    os.environ.update(new)
    try:
        yield
    finally:
        for key in new:
            os.environ.pop(key, None)
