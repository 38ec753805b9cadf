"""Where `irj` begins: an interrupt or a failure while the packages are still being loaded is
one line, too.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Run `irj`; see :func:`workbench.cli.main.main`."""
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


if __name__ == "__main__":
    raise SystemExit(main())
