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


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first, in this order, all others as they were collected."""
    place = {name: k for k, name in enumerate(LONGEST)}
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
