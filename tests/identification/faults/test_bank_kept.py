"""Levels and limits are worked out once for the same bank and the same healthy readings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from casadi_models import JointModel
from identification.faults.bank import FaultBank, Tuning
from identification.faults.bank_kept import calibrated
from identification.faults.bank_levels import Piece
from identification.online.filter import Doubts, Levels

MEASURED = (True, True, False, True, False, True)
JOINT = JointModel.by_name("hd3", 100.0, effects=("viscous@motor",)).with_values(
    {"motor_inertia": 0.5, "link_inertia": 2.0, "stiffness": 1e4, "motor_viscous": 3.0}
)
TUNING = Tuning(
    Levels(disturbance=(0.1, 2.5e-7, 3.0), shift=-0.5), np.array([[1.0, np.inf], [1 / 3, 4.0]])
)


def bank(model: JointModel = JOINT, dt: float = 1e-3, late: float = 0.0) -> FaultBank:
    """A bank that was not calibrated."""
    return FaultBank(model, dt, MEASURED, late=(0.0, 0.0, 0.0, late, 0.0, 0.0))


def test_the_same_question_is_answered_from_the_cache_and_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[FaultBank] = []

    def calibrate(self: FaultBank, _healthy: object) -> Tuning:
        asked.append(self)
        return TUNING

    monkeypatch.setenv("IDENTIFICATION_CACHE", str(tmp_path))
    monkeypatch.setattr(FaultBank, "calibrate", calibrate)
    piece = Piece(np.arange(4.0), np.arange(24.0).reshape(4, 6))
    first, second = calibrated(bank(), [piece]), calibrated(bank(), [piece])
    assert len(asked) == 1
    assert first.levels == second.levels == TUNING.levels
    assert (first.limits == TUNING.limits).all()
    assert (second.limits == TUNING.limits).all()
    nudged = piece.rows.copy()
    nudged[2, 3] += 1e-12
    others = [
        (bank(), [Piece(piece.time, nudged)]),
        (bank(), [piece, piece]),
        (bank(dt=2e-3), [piece]),
        (bank(late=1e-4), [piece]),
        (bank(JOINT.with_values({"motor_viscous": 3.1})), [piece]),
        (FaultBank(JOINT, 1e-3, (*MEASURED[:5], False)), [piece]),
        (FaultBank(JOINT, 1e-3, MEASURED, doubts=Doubts(("stiffness",), np.eye(1))), [piece]),
    ]
    for count, (other, pieces) in enumerate(others, 2):
        calibrated(other, pieces)
        assert len(asked) == count
    for kept in tmp_path.glob("bank-*"):
        kept.write_bytes(kept.read_bytes()[:-1] + b"?")  # damaged: made anew
    assert calibrated(bank(), [piece]).levels == TUNING.levels
    assert len(asked) == len(others) + 2
