"""A gap that the joint file lists three times too wide is found, and is not taken for a law of the
stiffness, with a further effect of the transmission hidden beside it.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from identification.balance.balances import balances_of
from identification.balance.dataset import Dataset
from identification.data.joint_file import load_joint
from identification.data.read import read
from identification.fitting.engine import Solution, load_dataset, posed, prepared_model, solve
from identification.fitting.weak_form import WeakForm, _Shares
from tests.recorded_world import backlash
from tests.recorded_world.world import make_case, write_case
from workbench.cli.main import improve_json

HALF_GAP = 3.987e-4
"""Of the joint 310000 [rad]: a quarter of a step of its link encoder."""


@pytest.mark.parametrize("effect", ["", pytest.param("hysteresis", marks=pytest.mark.slow)])
def test_a_gap_listed_three_times_too_wide(effect: str) -> None:
    seen = backlash.ask(9003, effect, "all", 0.0)
    assert seen is not None
    assert not seen.error
    assert seen.good, seen.share
    assert seen.false_stiffness == ()
    assert seen.found


@cache
def coarse() -> tuple[Dataset, Solution]:
    """A joint that lists the gap and all else that it has, through a coarse encoder."""
    with TemporaryDirectory() as made:
        folder = Path(made)
        write_case(make_case(310000, kind="triple", size=1.0), folder, "all")
        text = (folder / "joint.toml").read_text()
        whole = '"gravity", "coulomb", "quadratic_drag", "backlash"'
        (folder / "joint.toml").write_text(text.replace('"gravity"', whole))
        joint = load_joint(folder / "joint.toml")
        train = read(folder / "train.csv", joint=joint)
    model = prepared_model(joint, train)
    data = load_dataset([train], [], joint, model)
    return data, solve(model, data)


def test_a_gap_takes_no_more_of_the_stiffness_than_there_is() -> None:
    """It was a quarter as wide, and the joint pushed itself over it with four times its
    stiffness.
    """
    _, found = coarse()
    loss, stiffness = (found.values[n] for n in ("backlash_stiffness_loss", "stiffness"))
    assert loss <= stiffness * (1 + 1e-12)
    assert found.values["backlash"] == pytest.approx(HALF_GAP, rel=0.1)


def test_a_share_of_the_stiffness_moves_rows_as_its_columns_say() -> None:
    """Central differences, and back."""
    data, found = coarse()
    values, free, limits, _ = posed(found.model, data, found.values, frozenset())
    balances = balances_of(found.model, data.sensing, wrt=[n for n in free if "[" not in n])
    own = tuple(n for n in free if "[" not in n)
    form = WeakForm(balances, data, values, own, found.weights)
    shares = _Shares.of(form, limits)
    part = own.index("backlash_stiffness_loss")
    assert shares.parts == (part,)
    x = shares.into(np.array([values[n] for n in own]))
    assert 0 <= x[part] <= 1
    x[part] = 0.7
    assert shares.into(shares.out(x)) == pytest.approx(x)
    columns = shares.jacobian(x)
    for i in (part, own.index("stiffness")):
        step = np.zeros(len(x))
        step[i] = 1e-6 * x[i]
        slope = (shares.residual(x + step) - shares.residual(x - step)) / (2 * step[i])
        assert columns[:, i] == pytest.approx(slope, rel=1e-5, abs=1e-6 * np.abs(slope).max())


@pytest.mark.slow
def test_a_gap_through_a_coarse_encoder_is_in_the_set(tmp_path: Path) -> None:
    """Noise makes a bow of its corners. A law of two knots follows that, and passes on more noise
    where it is steeper: it was named alone, 29 nats ahead.
    """
    write_case(make_case(310000, kind="triple", size=1.0), tmp_path, "all")
    train, held_out = ([tmp_path / f"{name}.csv"] for name in ("train", "test"))
    found = improve_json(train, held_out, tmp_path / "joint.toml")
    assert any({"backlash", "piecewise_stiffness"} <= set(c["effects"]) for c in found["claims"])
