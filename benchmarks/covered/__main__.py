"""Lines of the workbench that its tests run: ``python -m benchmarks.covered [TEST ...]``.

Runs the tests (by default all of tests/workbench, and the pages of docs, which run every command as
a user would) and counts lines in every process that they start: the server, the processes in which
sessions work, the command line, and copies of them that a test kills (see sitecustomize.py beside
this file). Printed is a line per module under the limit and the total; the exit code is 1 below the
limit. Needs coverage, which is in the extra ``test``.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def counted(tests: list[str], over: str, folder: Path) -> int:
    """Run the tests, each process with a file of its own in `folder`; the exit code of pytest."""
    paths = [str(Path(__file__).parent), str(ROOT), os.environ.get("PYTHONPATH", "")]
    env = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, paths)),
        "IRJ_COVERAGE": str(folder / "lines"),
        "IRJ_COVERED": str(ROOT / over),
    }
    command = [sys.executable, "-m", "pytest", "-q", *tests]
    return subprocess.run(command, cwd=ROOT, env=env, check=False).returncode


def main() -> int:
    """Run, combine, print."""
    import coverage

    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("tests", nargs="*", default=["tests/workbench", "tests/test_docs.py"])
    parser.add_argument("--over", default="workbench", help="folder whose lines are counted")
    parser.add_argument("--least", type=float, default=90.0, help="limit of the total [%%]")
    parser.add_argument("--missing", action="store_true", help="name the lines that were not run")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        failed = counted(given.tests, given.over, folder)
        whole = coverage.Coverage(data_file=str(folder / "whole"), config_file=False)
        whole.combine([str(p) for p in folder.glob("lines.*")], keep=True)
        files = sorted(p for p in (ROOT / given.over).rglob("*.py"))
        ran = statements = 0
        for path in files:
            _, own, _, missed, text = whole.analysis2(str(path))
            ran, statements = ran + len(own) - len(missed), statements + len(own)
            share = 100.0 * (1 - len(missed) / len(own)) if own else 100.0
            if share < given.least:
                lines = f"  {text}" if given.missing else ""
                print(f"{path.relative_to(ROOT)!s:<44} {share:5.1f} % of {len(own)}{lines}")
        total = 100.0 * ran / max(statements, 1)
        print(f"{given.over}: {total:.1f} % of {statements} lines (at least {given.least:g})")
    return failed or int(total < given.least)


if __name__ == "__main__":
    sys.exit(main())
