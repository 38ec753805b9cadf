"""The step and the check of the recursive least squares together, and the C source of their replay.

The formulas stand once, in CasADi. Python calls them through CasADi's FunctionBuffer, the replay of
a whole record compiles the C code that CasADi writes from them.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import final

import casadi as ca

from identification.recursive.settings import Layout
from identification.recursive.ud_check import check_function
from identification.recursive.ud_step import step_function


@final
class Formulas:
    """The two CasADi functions of an estimator and their memory layout.

    `step(fast, flags, config, y, H) -> fast, theta, error, status` for each sample (H row by row);
    `check(fast, slow, config) -> fast, slow` whenever the step left `due` at 1.
    """

    def __init__(
        self,
        n: int,
        m: int,
        method: str,
        freeze: bool,
        walking: bool,
        alike: tuple[int, ...] | None = None,
    ) -> None:
        self.layout = Layout(n, m)
        self.step = step_function(self.layout, method, freeze)
        self.check = check_function(self.layout, freeze, walking, alike or range(n))


@lru_cache(maxsize=32)
def formulas(
    n: int,
    m: int,
    method: str,
    freeze: bool,
    walking: bool,
    alike: tuple[int, ...] | None = None,
) -> Formulas:
    """The functions for n parameters and m outputs; built once per process. `alike` as in
    :class:`identification.recursive.estimator.RecursiveLeastSquares`.
    """
    return Formulas(n, m, method, freeze, walking, alike)


_REPLAY = """
#include <string.h>
#ifdef _WIN32
#define RLS_EXPORT __declspec(dllexport)
#else
#define RLS_EXPORT __attribute__((visibility("default")))
#endif
/* Runs the step over a record. theta, error, status get one row per `stride` samples. */
RLS_EXPORT void rls_replay(long long samples, long long stride, const double *y, const double *h,
                           double *fast, double *slow, const double *config,
                           double *theta, double *error, double *status) {
  static const int FAST = @FAST@, SLOW = @SLOW@;
  double other_fast[@FAST@], other_slow[@SLOW@], w[@W@];
  const double *arg[@ARG@];
  double *res[@RES@];
  casadi_int iw[@IW@];
  double *now = fast, *next = other_fast, *swap;
  long long k, row;
  for (k = 0; k < samples; ++k) {
    int keep = (k + 1) % stride == 0;
    row = k / stride;
    arg[0] = now; arg[1] = slow; arg[2] = config; arg[3] = y + k * @M@; arg[4] = h + k * @HM@;
    res[0] = next; res[1] = keep ? theta + row * @N@ : 0; res[2] = keep ? error + row * @M@ : 0;
    res[3] = keep ? status + row * 2 : 0;
    rls_step(arg, res, iw, w, 0);
    swap = now; now = next; next = swap;
    if (now[@DUE@] != 0) {
      arg[0] = now; arg[1] = slow; arg[2] = config;
      res[0] = next; res[1] = other_slow;
      rls_check(arg, res, iw, w, 0);
      swap = now; now = next; next = swap;
      memcpy(slow, other_slow, SLOW * sizeof(double));
    }
  }
  if (now != fast) memcpy(fast, now, FAST * sizeof(double));
}
"""


def replay_source(formula: Formulas) -> str:
    """C source of the replay: CasADi's code of both functions and the loop over the samples."""
    generator = ca.CodeGenerator("rls", {"with_header": False, "casadi_int": "long long int"})
    functions = (formula.step, formula.check)
    for function in functions:
        generator.add(function)
    layout = formula.layout
    sizes = {
        "FAST": layout.fast.size,
        "SLOW": layout.slow.size,
        "N": layout.n,
        "M": layout.m,
        "HM": layout.n * layout.m,
        "DUE": layout.fast["due"].start,
        "W": 1 + max(f.sz_w() for f in functions),
        "IW": 1 + max(f.sz_iw() for f in functions),
        "ARG": 8 + max(f.sz_arg() for f in functions),
        "RES": 8 + max(f.sz_res() for f in functions),
    }
    loop = _REPLAY
    for name, value in sizes.items():
        loop = loop.replace(f"@{name}@", str(value))
    return _without_null_checks(str(generator.dump())) + loop


def _without_null_checks(code: str) -> str:
    """Drop the test for a missing pointer before each access to an argument or the first
    result: none is missing.
    """
    code = re.sub(r"arg\[(\d+)\]\s*\?\s*arg\[\1\]\[(\d+)\]\s*:\s*0", r"arg[\1][\2]", code)
    return re.sub(r"if \(res\[0\]\s*!=\s*0\)\s*res\[0\]", "res[0]", code)
