"""Where `irj` begins: an interrupt while the packages are still being loaded is one line, too."""

from __future__ import annotations

import sys
from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Run `irj`; see :func:`workbench.cli.main.main`."""
    try:
        from workbench.cli.main import main as run

        return run(argv)
    except KeyboardInterrupt:
        sys.stderr.write("irj: interrupted\n")
        return 130


if __name__ == "__main__":
    raise SystemExit(main())
