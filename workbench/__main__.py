"""``python -m workbench`` is `irj`."""

from workbench.entry import main

if __name__ == "__main__":
    raise SystemExit(main())
