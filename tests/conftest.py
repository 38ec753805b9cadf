"""What holds for every test."""

import os
import shutil
import signal
import tempfile
from collections.abc import Iterator
from multiprocessing.util import Finalize

import pytest
from threadpoolctl import threadpool_limits

from casadi_models import EFFECTS

# matrices are small: where two workers have a thread for every processor each they wait for each
# other, and a fit takes five times as long
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
threadpool_limits(1, user_api="blas")

if (
    signal.getsignal(signal.SIGINT) is signal.SIG_IGN
):  # pytest was started in the background: Ctrl-C would not reach the programs that tests start
    signal.signal(signal.SIGINT, signal.default_int_handler)


LONGEST = (
    "test_app_browser.py",
    "test_chains.py",
    "test_docs.py",
    "test_dataset.py",
    "test_app.py",
    "test_hidden_effect_campaign.py",
    "test_native_twin.py",
    "test_jobs.py",
    "test_estimator_fmu.py",
    "test_other_payload.py",
    "test_app_known.py",
    "test_app_sets.py",
    "test_doors.py",
    "test_user_fmu_explore.py",
    "test_odds.py",
    "test_app_charts.py",
    "test_app_clumsy.py",
    "test_app_views.py",
)
"""Files of two thirds of a minute and more each, first: a worker that begins one when the others
have done all the rest keeps the suite waiting. Those of the browser, which wait for a third of
their time, stand between those that calculate."""


WIDE = (
    "test_user_fmu_track.py",
    "test_user_fmu_batch.py",
    "test_user_fmu_explore.py",
    "test_native_twin.py::test_equals_python_at_coarse",
    "test_native_twin.py::test_equals_python_for_other_joints",
    "test_native_twin.py::test_the_step_is_that_of_the_records",
    "test_native_fmi3.py::test_every_output",
    "test_app_charts.py",
    "test_app_clumsy.py",
    "test_app_draft.py",
    "test_import_browser.py",
    "test_sensor_sets.py",
    "test_clocks.py::test_a_torque_beside",
    "test_clocks.py::test_part_of_a_sample",
    "test_changed.py::test_changes_are_told_with_fewer_sensors",
    "test_changed.py::test_changes_planted",
    "test_learned.py::test_what_only_longer_rows_show",
    "test_learned.py::test_the_loop",
    "test_lines.py::test_line_",
    "test_slow_noise.py::test_what_a_drift_foretells",
    "test_metamorphic.py",
    "test_app_views.py",
    "test_app_known.py",
    "test_desk_browser.py",
    "test_shown.py",
    "test_user_fmu_makes.py",
    "test_user_fmu_coupling.py",
    "test_estimator_two_step.py",
    "test_unseen_link.py",
    "test_drive_delay.py",
    "test_left_open.py",
    "test_next_run.py",
    "test_examples.py::test_each_joint",
)
"""Files and tests that `.ci/run` runs last, where a machine has time for them, and says so where it
has not. Most look at more joints, hosts, sensor sets or views for what others hold already; some
are all that there is of a subject (an FMU that is tracked, the next run, a delay of the drive) and
stand here because they take long."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first, in this order, all others as they were collected."""
    place = {name: k for k, name in enumerate(LONGEST)}
    for item in items:
        if item.nodeid.rpartition("/")[2].startswith(WIDE):
            item.add_marker("wide")
    items.sort(key=lambda item: place.get(item.path.name, len(LONGEST)))


@pytest.fixture(autouse=True, scope="session")
def _allowed_effects(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What tests allow to run, and the traces of what fails, are kept in a folder of their own."""
    with pytest.MonkeyPatch.context() as patched:
        state = tmp_path_factory.mktemp("state")
        patched.setenv("IRJ_ALLOWED_EFFECTS", str(state / "allowed-effects.txt"))
        patched.setenv("IRJ_CRASHES", str(state / "crashes"))
        yield


@pytest.fixture(autouse=True, scope="session")
def _temporary_files(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What tests leave behind, as those do that kill a process on purpose, goes with this one."""
    tmp_path_factory.getbasetemp()  # of pytest's own, which keeps some: outside
    made = tempfile.mkdtemp(prefix="irj-tests-")
    # after the folders that multiprocessing has in it, which it removes itself
    Finalize(None, shutil.rmtree, (made, True), exitpriority=-200)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(tempfile, "tempdir", made)
        patched.setenv("TMPDIR", made)
        yield


@pytest.fixture(autouse=True)
def _typed_laws_forgotten() -> Iterator[None]:
    """A law that a test types in this process does not stay in the library of the other tests."""
    before = {key for found in EFFECTS.typed for key in found.keys}
    yield
    for found in EFFECTS.typed:
        for key in set(found.keys) - before:
            EFFECTS.forget(key)
