"""The hold of a logged command: a delay of at most a sample, in every model with a commanded drive.

It is no effect that a diagnosis names, but a nuisance: the same law as that of a late drive, under
a number of its own, so that both can be told apart in a model.
"""

from __future__ import annotations

from typing import Final

from .effect import EFFECTS
from .term import CALIBRATION, Term, Unknown

_LATE: Final = next(e for e in EFFECTS.values() if e.is_delay and "drive" in e.acts_on)
_HOLD: Final = Term(_LATE, "drive", 0)

DRIVE_DELAY: Final = Term(_LATE, "drive").label
"""Label of the delay of the drive, of any length."""
HOLD_DELAY: Final = _HOLD.label
"""Label of the nuisance."""
HOLD_NAME: Final = _HOLD.names[0]
"""Name of its parameter [s]."""

CLOCKS: Final = {
    **{n: u for n, u in CALIBRATION.items() if u.what == "skew"},
    HOLD_NAME: Unknown("skew", "motor_current", "drive", _HOLD.parameters[0]),
}
"""Skews between the clocks of the channels by the name of their parameter; that of the drive is
the hold, which no record can tell from it.
"""
UNKNOWNS: Final = {**CALIBRATION, **CLOCKS}
"""All calibration unknowns."""
