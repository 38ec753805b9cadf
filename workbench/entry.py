"""Where `irj` begins: an interrupt or a failure while the packages are still being loaded is
one line, too.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

_STREAMS = ("stdin", "stdout", "stderr")


def main(argv: Sequence[str] | None = None) -> int:
    """Run `irj`; see :func:`workbench.cli.main.main`."""
    _opened()
    try:
        from identification.scratch import own_folder
        from workbench.cli.main import main as run
    except KeyboardInterrupt:
        sys.stderr.write("irj: interrupted\n")
        return 130
    except Exception as error:  # a broken installation: nothing of the project can be counted on
        detail = " ".join(f"{type(error).__name__}: {error}".split())
        sys.stderr.write(f"irj: internal error, cannot be loaded ({detail}); install it again\n")
        return 3
    try:
        with own_folder():
            return run(argv)
    except KeyboardInterrupt:
        sys.stderr.write("irj: interrupted\n")
        return 130
    except Exception as error:
        from irj_fmu.command_line import crashed

        return crashed(error, "irj")


def _opened() -> None:
    """Give a process that was started without standard streams empty ones: else the next file that
    is opened takes the number of one, and what is printed goes into it.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) < len(_STREAMS):
        mode = "r" if number == 0 else "w"
        setattr(sys, _STREAMS[number], open(number, mode, encoding="utf-8", closefd=False))  # noqa: SIM115
    os.close(number)


if __name__ == "__main__":
    raise SystemExit(main())
