"""A function of one sample run along windows of samples: by CasADi's virtual machine, or by
compiled C for long records."""

from __future__ import annotations

import ctypes
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.recursive.compiler import NoCompilerError, build

FloatArray = npt.NDArray[np.float64]

LONG: Final = 10_000
"""Samples from which compiling pays: the compiler takes as long as the virtual machine with a few
passes over so many."""

_LOOP: Final = """
#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif
#include <string.h>
EXPORT void irj_windows(
    long long windows, long long length,
    const double *start, const double *inputs, const double *p, double *out, double *end) {{
  const double *arg[{arg}];
  double *res[{res}];
  casadi_int iw[{iw}];
  double w[{w}];
  double a[{states}], b[{states}];
  long long i, k;
  for (i = 0; i < windows; ++i) {{
    memcpy(a, start + i * {states}, sizeof a);
    for (k = 0; k < length; ++k) {{
      arg[0] = a; arg[1] = inputs; arg[2] = p;
      res[0] = b; res[1] = out;
      sample(arg, res, iw, w, 0);
      memcpy(a, b, sizeof a);
      inputs += {inputs}; out += {outputs};
    }}
    memcpy(end + i * {states}, a, sizeof a);
  }}
}}
"""


@final
class WindowRun:
    """Every window from its start, sample by sample.

    Parameters
    ----------
    sample : casadi.Function
        (state, inputs, p) -> (state one sample later, outputs at the sample).
    length : int
        Samples of a window; :meth:`run` takes others too.
    samples : int
        Samples of all windows that will be run: long records are worth a compiler, where there is
        one.
    """

    def __init__(self, sample: Any, length: int, samples: int) -> None:
        self._sample = sample
        self._outputs = int(sample.size1_out(1))
        self._native = _compiled(sample) if samples >= LONG else None
        self._windows: dict[int, Any] = (
            {} if self._native is not None else {length: sample.mapaccum("window", length)}
        )

    def __call__(self, start: FloatArray, inputs: FloatArray, p: FloatArray) -> FloatArray:
        """Outputs (windows, length, outputs); see :meth:`run`."""
        return self.run(start, inputs, p)[0]

    @property
    def is_compiled(self) -> bool:
        """True where the samples run as C."""
        return self._native is not None

    def run(
        self, start: FloatArray, inputs: FloatArray, p: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Outputs (windows, length, outputs), and the states after the last sample (windows,
        state).

        Parameters
        ----------
        start : (windows, state) array
        inputs : (windows * length, inputs) array
        p : (parameters,) array
        """
        count, length = len(start), len(inputs) // len(start)
        if self._native is None:
            if length not in self._windows:
                self._windows[length] = self._sample.mapaccum("window", length)
            states, found = self._windows[length].map(count)(start.T, inputs.T, p)
            return (
                np.asarray(found.full().T).reshape(count, length, self._outputs),
                np.asarray(states.full().T[length - 1 :: length]),
            )
        out = np.empty((count, length, self._outputs))
        given = [np.ascontiguousarray(a, dtype=np.float64) for a in (start, inputs, p)]
        end = np.empty((count, given[0].shape[1]))
        self._native(count, length, *(a.ctypes.data for a in (*given, out, end)))
        return out, end


def _compiled(sample: Any) -> Any:
    """The loop over windows in C; None where no compiler works."""
    import casadi as ca

    generator = ca.CodeGenerator("sample.c", {"with_header": False, "casadi_int": "long long"})
    generator.add(sample)
    sizes = {
        "arg": sample.sz_arg(),
        "res": sample.sz_res(),
        "iw": max(sample.sz_iw(), 1),
        "w": max(sample.sz_w(), 1),
    }
    sizes |= {
        "states": sample.size1_in(0),
        "inputs": sample.size1_in(1),
        "outputs": sample.size1_out(1),
    }
    try:
        run = build(generator.dump() + _LOOP.format(**sizes), "windows").irj_windows
    except NoCompilerError:
        return None
    run.argtypes = [ctypes.c_longlong, ctypes.c_longlong, *([ctypes.c_void_p] * 5)]
    run.restype = None
    return run
