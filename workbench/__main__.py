"""`python -m workbench` is `irj`."""

from workbench.cli import main

raise SystemExit(main())
