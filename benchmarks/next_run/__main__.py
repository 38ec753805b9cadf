"""The command line: ``python -m benchmarks.next_run``."""

from benchmarks.next_run import main

raise SystemExit(main())
