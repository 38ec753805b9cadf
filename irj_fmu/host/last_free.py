"""Free FMU instances, and let a library that runs Python release it while that is still safe.

The library of pythonfmu holds the interpreter in a static pointer and releases it once more in a
destructor that runs after the pointer's own: memory that is freed already. Released by the
library's exported function after its last instance has gone, the pointer is empty at the end of the
process, and a later instance starts afresh.
"""

from __future__ import annotations

import ctypes
import threading
from collections import Counter
from collections.abc import Callable
from typing import Any, Final

_FINALIZER: Final = "finalizePythonInterpreter"
_lock = threading.Lock()
_living: Counter[int] = Counter()
"""Instances of each library that has such a function, by the address of that function."""


def freer(library: Any, free: Callable[[], object]) -> Callable[[], None]:
    """What frees an instance that has just been made; to be called once.

    Parameters
    ----------
    library : ctypes.CDLL
        The library that made the instance.
    free : callable
        Calls its FreeInstance.
    """
    release = getattr(library, _FINALIZER, None)
    if release is None:
        return lambda: _plain(free)
    release.argtypes, release.restype = [], None
    key = int(ctypes.cast(release, ctypes.c_void_p).value or 0)
    with _lock:
        _living[key] += 1

    def freed() -> None:
        free()
        with _lock:
            _living[key] -= 1
            if _living[key] == 0:
                del _living[key]
                release()

    return freed


def _plain(free: Callable[[], object]) -> None:
    free()


__all__ = ["freer"]
