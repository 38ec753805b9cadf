"""What is kept between the verbs is what would be worked out anew, and nothing else is taken for
it.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from identification import Joint, Record, load_joint, read
from identification.balance import balances as evaluated
from identification.balance.balances import Balances
from identification.data.joint_file import Known
from identification.fitting.assess import assess
from identification.fitting.engine import (
    Dataset,
    load_dataset,
    prepared_model,
    reweighed,
    solve,
    solved_once,
    stepped,
)
from identification.fitting.first_fit import first_fit
from tests.recorded_world._engine import library
from tests.recorded_world.world import make_case, write_case

DEMO = Path(str(files("workbench"))) / "demo"


@cache
def demo() -> tuple[Joint, Record, Record]:
    """Joint, training and held-out record."""
    joint = load_joint(DEMO / "joint.toml")
    train, held = (read(DEMO / n, joint=joint) for n in ("train.npz", "held_out.npz"))
    return joint, train, held


def prepared(joint: Joint, train: Record, held: Record) -> Dataset:
    """Rows of both."""
    return load_dataset([train], [held], joint, prepared_model(joint, train))


def test_the_fit_that_is_kept_is_the_one_that_would_be_made() -> None:
    joint, train, held = demo()
    data, model = prepared(joint, train, held), prepared_model(joint, train)
    first = first_fit(model, data)
    again = prepared(joint, train, held)
    assert again.train[0] is data.train[0]  # prepared once
    assert first_fit(model, again) is first
    anew = solve(model, data)
    assert anew.values == first.values
    assert anew.stderr == first.stderr


def test_a_fit_is_made_once_of_the_same_data_and_the_same_start() -> None:
    """Steps of a fit, and its weights, too; whatever else they hang on makes others of them."""
    joint, train, held = demo()
    data, model = prepared(joint, train, held), prepared_model(joint, train)
    found = solved_once(model, data, {})
    assert solved_once(model, data, dict(model.values)).values == found.values
    assert solved_once(model, data, {}) is found
    name = model.inertias[0]
    start = {name: 2 * found.values[name]}
    others = [
        solved_once(model, data, start),
        solved_once(model, replace(data), {}),  # other data, of the same rows
        solved_once(model.with_values(start), data, {}),
        solved_once(model.drop("gravity"), data, {}),
    ]
    assert not any(other is found for other in others)
    steps, cost = stepped(model, data, start, found, iterations=2)
    assert stepped(model, data, dict(start), found, iterations=2)[0] is steps
    louder = replace(found, weights={b: 2 * w for b, w in found.weights.items()})
    assert stepped(model, data, start, louder, iterations=2)[1] > 2 * cost
    assert stepped(model, data, start, found, iterations=1)[0] is not steps
    assert reweighed(louder, data) is reweighed(replace(louder), data)
    moved = replace(found, values={**found.values, **start})
    one, other = (reweighed(fit, data).weights for fit in (louder, moved))
    assert any(not np.array_equal(one[b], other[b]) for b in one)


def test_another_model_another_knowledge_and_other_rows_are_fitted_anew() -> None:
    joint, train, held = demo()
    data, model = prepared(joint, train, held), prepared_model(joint, train)
    first = first_fit(model, data)
    name = model.inertias[0]
    fixed = 1.1 * first.values[name]
    told = replace(joint, known={**joint.known, name: Known(value=fixed)})
    assert first_fit(model, replace(data, joint=told)).values[name] == fixed
    half = train.take(np.arange(len(train)) < len(train) // 2, "the first half")
    other = first_fit(model, prepared(joint, half, held))
    assert other.values[name] != first.values[name]
    smaller = first_fit(model.drop("gravity"), data)
    assert len(smaller.free) < len(first.free)


def test_an_assessment_evaluates_no_rows_twice_at_the_same_values(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    joint, train, held = demo()
    data, model = prepared(joint, train, held), prepared_model(joint, train)
    values = first_fit(model, data).values
    assess(model, data, data.held_out, values)
    made: list[object] = []
    kept = evaluated.residuals_of

    def counted(record: object, law: object, make: object) -> object:
        def told() -> object:
            made.append(law)
            return make()  # type: ignore[operator]

        return kept(record, law, told)  # type: ignore[arg-type]

    monkeypatch.setattr(evaluated, "residuals_of", counted)
    again = assess(model, data, data.held_out, values)
    assert made == []  # all of it is known, noise that was drawn included
    moved = {**values, model.inertias[0]: 1.01 * values[model.inertias[0]]}
    other = assess(model, data, data.held_out, moved)
    assert made
    assert other.relative_error_percent != again.relative_error_percent


def test_values_that_are_kept_are_those_of_the_balances() -> None:
    joint, train, held = demo()
    data, model = prepared(joint, train, held), prepared_model(joint, train)
    values = dict(first_fit(model, data).values)
    bare = Balances(model, data.sensing, wrt=())
    whole = Balances(model, data.sensing)
    for _ in range(2):  # the second time from memory
        for record in data.train:
            plain, full = bare.evaluate(record, values), whole.evaluate(record, values)
            for balance, (residual, _) in full.items():
                assert np.allclose(plain[balance][0], residual, rtol=1e-9, atol=1e-9)
    with pytest.raises(ValueError, match="read-only"):
        plain[balance][0][0] = 0.0


@pytest.mark.skipif(library() is None, reason="no C compiler")
def test_a_smoothing_velocity_that_went_to_nothing_comes_back(tmp_path: Path) -> None:
    """While a cyclic torque was missing the best friction changed its sign at once; from there no
    row tells the size of the smoothing, and friction with memory was claimed in its place.
    """
    folder = write_case(make_case(13017, seconds=20.0), tmp_path, "all")
    joint = load_joint(folder / "joint.toml")
    joint = replace(joint, effects=(*joint.effects, "cyclic_torque@motor"))
    record = read(folder / "train.csv", joint=joint)
    model = prepared_model(joint, record)
    data = load_dataset([record], [], joint, model)
    fresh, warm = (
        solve(model, data, start=start) for start in ({}, {"motor_smoothing_velocity": 7e-5})
    )
    assert 0.012 < fresh.values["motor_smoothing_velocity"] < 0.025  # 0.018 is true
    assert warm.values["motor_smoothing_velocity"] == pytest.approx(
        fresh.values["motor_smoothing_velocity"], rel=0.1
    )
