"""Counts lines in every process that inherits `IRJ_COVERAGE`: Python imports this module by its
name when it starts with the folder of it on PYTHONPATH.

The work of a session is done in a copy of a process that is kept ready, and is ended by a signal
that nothing can catch. So a copy begins to count anew, and what was counted is written every half
second.
"""

import os
import threading
import time

QUIET = ["no-data-collected", "module-not-imported", "module-not-measured", "already-imported"]
"""Warnings of a process that runs nothing of the workbench: a test reads what it prints."""
EVERY = 0.5
"""Time between two writes [s]: what a killed process ran in the last one is lost."""


def begin() -> None:
    """Count from here on."""
    import coverage

    before = coverage.Coverage.current()
    if before is not None:
        before.stop()  # of the process that this one is a copy of
    made = coverage.Coverage(
        data_file=os.environ["IRJ_COVERAGE"],
        data_suffix=True,
        source=[os.environ["IRJ_COVERED"]],
        config_file=False,
        concurrency=["thread"],
        messages=False,
    )
    made.set_option("run:disable_warnings", QUIET)
    made.start()

    def keep() -> None:
        while True:
            time.sleep(EVERY)
            made.save()

    threading.Thread(target=keep, daemon=True, name="coverage").start()
    threading.Thread(target=_at_the_end, args=(made,), daemon=False, name="coverage end").start()


def _at_the_end(made: object) -> None:
    """Write what was counted when the main thread has come to its end."""
    threading.main_thread().join()
    made.stop()  # type: ignore[attr-defined]
    made.save()  # type: ignore[attr-defined]


if os.environ.get("IRJ_COVERAGE"):
    begin()
    os.register_at_fork(after_in_child=begin)
