"""The command line: ``python -m benchmarks.trust``."""

from benchmarks.trust import main

raise SystemExit(main())
