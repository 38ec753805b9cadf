"""Figures of foreign FMUs: ``python -m benchmarks.foreign [names | variants | watch | makes |
coverage | held] [-h] ...``.

``names`` (the default) hides effects in the plant and asks for their names, ``variants`` asks
`explore` for them, ``watch`` puts sensors wrong under `track`, ``makes`` fits FMUs of other makes
in processes of their own, ``coverage`` fits laws outside the FMU over many seeds and counts the
true values inside the intervals, ``held`` shows what a held torque does to a fit of the library.
"""

from __future__ import annotations

import sys
from typing import Final

from benchmarks.foreign import coverage, held, makes, names, variants, watch

TABLES: Final = {
    "names": names.main,
    "variants": variants.main,
    "watch": watch.main,
    "makes": makes.main,
    "coverage": coverage.main,
    "held": held.main,
}


def main(arguments: list[str]) -> int:
    """Print the table that the first argument asks for."""
    given = arguments[0] if arguments and arguments[0] in TABLES else "names"
    return TABLES[given](arguments[1:] if arguments[:1] == [given] else arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
