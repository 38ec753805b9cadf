"""Improve: fit, see where it fails, name what is missing, add it, fit again, until nothing is
left to name.
"""

from __future__ import annotations

from collections.abc import Sequence

from identification.balance.dataset import HOLD_DELAY, visible_labels
from identification.balance.excitation import excitation_warnings
from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.diagnosis.bench import Progress
from identification.diagnosis.improvement import (
    Improvement,
    Step,
    held_drop,
    made_worse,
    ranked_json,
    visible_keys,
)
from identification.diagnosis.session import MAX_ADDITIONS, Session, with_held_out
from identification.fitting.assess import RATIO_LIMIT

__all__ = [
    "HOLD_DELAY",
    "MAX_ADDITIONS",
    "RATIO_LIMIT",
    "Improvement",
    "Step",
    "excitation_warnings",
    "held_drop",
    "improve",
    "made_worse",
    "ranked_json",
    "visible_keys",
    "visible_labels",
    "with_held_out",
]


def improve(
    records: Sequence[Record] | Record,
    joint: Joint,
    held_out: Sequence[Record] = (),
    *,
    max_additions: int = MAX_ADDITIONS,
    progress: Progress | None = None,
) -> Improvement:
    """Find the missing effects of a joint model, add them and measure the error on held-out
    records.

    Parameters
    ----------
    records : Record or sequence of Record
        Training records; checked and repaired here where they were not yet.
    joint : Joint
        What is known, and the start model (see :func:`identification.data.joint_file.load_joint`).
    held_out : sequence of Record
        Records that the fit never sees; without them blocks of the training records are held out.
    max_additions : int
    progress : callable, optional
        ``progress(text, share)``.

    Raises
    ------
    InputError
        Unusable records or joint, in one line.
    """
    session = Session.opened(records, joint, held_out, progress=progress)
    return session.run(session.start(), max_additions)
