"""The one error type a user's input can raise."""

from __future__ import annotations


class InputError(ValueError):
    """Input that cannot be used: one line that says what, where and what to do.

    The command line prints the message as it stands and exits with 2.
    """
