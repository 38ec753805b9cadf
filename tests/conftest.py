"""What holds for every test."""

import signal
from collections.abc import Iterator

import pytest

if (
    signal.getsignal(signal.SIGINT) is signal.SIG_IGN
):  # pytest was started in the background: Ctrl-C would not reach the programs that tests start
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True, scope="session")
def _allowed_effects(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What tests allow to run, and the traces of what fails, are kept in a folder of their own."""
    with pytest.MonkeyPatch.context() as patched:
        state = tmp_path_factory.mktemp("state")
        patched.setenv("IRJ_ALLOWED_EFFECTS", str(state / "allowed-effects.txt"))
        patched.setenv("IRJ_CRASHES", str(state / "crashes"))
        yield
