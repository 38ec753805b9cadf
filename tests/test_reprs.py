"""What a result prints fits on a screen: every public class, and everything that can be reached
from one.
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import casadi_models
import identification
from casadi_models import EFFECTS, JointModel, LocalSignals, Signals
from identification.data.joint_file import parse_joint
from identification.two_step.algorithm import smooth_friction
from irj_fmu.host.run import Trajectory

DEMO = Path(str(files("workbench"))) / "demo"
MOST_LINES = 25
PROJECT = ("casadi_models", "identification", "irj_fmu")


def _signals(kind: type) -> dict[str, Any]:
    """Arrays for every field."""
    return {f.name: np.arange(900.0) for f in dataclasses.fields(kind)}


@cache
def instances() -> dict[type, Any]:
    """A real object of every public class, by its class."""
    joint = identification.load_joint(DEMO / "joint.toml")
    train, held = (
        identification.read(DEMO / f"{n}.npz", joint=joint).take(slice(0, 4000))
        for n in ("train", "held_out")
    )
    fitted = identification.fit(joint, train)
    model, explored = fitted.model, identification.explore(train, joint, held)
    fitted_joint = parse_joint(tomllib.loads(fitted.to_joint_file()), "joint")
    rng = np.random.default_rng(1)
    u = rng.standard_normal((600, 1))
    y = np.convolve(u[:, 0], [0.0, 0.5, 0.3, 0.1])[:600, None]
    term = model.terms[0]
    objects = (
        joint,
        train,
        fitted,
        identification.compare(fitted, held, linear=False),
        identification.diagnose(fitted, held),
        explored,
        explored.improvement,
        identification.changed(fitted_joint, held),
        identification.InputError("one line"),
        identification.RecursiveLeastSquares([0.0, 0.0], [1.0, 1.0]),
        identification.TwoStep(smooth_friction(y[:, 0])),
        identification.FaultDetector(model, 1e-3),
        identification.mcs(lambda x: float(x @ x), [(-1.0, 2.0), (-1.0, 2.0)]),
        identification.moesp(u, y, 8, 3),
        model,
        term,
        EFFECTS["stribeck"],
        EFFECTS["stribeck"].parameters[0],
        Signals(**_signals(Signals)),
        LocalSignals(**_signals(LocalSignals)),
        JointModel.harmonic_drive("hd3"),
        Trajectory(np.arange(500.0), {"q": np.arange(500.0)}),
    )
    return {type(x): x for x in objects}


def reached(value: object, seen: set[int], path: str, depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Objects of the project inside a value, along public fields and properties."""
    if id(value) in seen or depth > 6:
        return
    seen.add(id(value))
    if isinstance(value, Mapping):
        for k, inner in list(value.items())[:3]:
            yield from reached(inner, seen, f"{path}[{k!r}]", depth + 1)
    elif isinstance(value, tuple | list):
        for k, inner in enumerate(value[:3]):
            yield from reached(inner, seen, f"{path}[{k}]", depth + 1)
    elif type(value).__module__.partition(".")[0] in PROJECT:
        yield path, value
        if dataclasses.is_dataclass(value):
            for field in dataclasses.fields(value):
                if not field.name.startswith("_"):
                    inner = getattr(value, field.name)
                    yield from reached(inner, seen, f"{path}.{field.name}", depth + 1)


def test_every_public_class_is_among_them() -> None:
    made = instances()
    public = [
        getattr(package, name)
        for package in (identification, casadi_models)
        for name in package.__all__
    ]
    missing = {
        c.__name__
        for c in public
        if isinstance(c, type) and not any(issubclass(m, c) for m in made)
    }
    assert missing == set()


@pytest.mark.parametrize("form", [repr, str])
def test_what_prints_fits_on_a_screen(form: Any) -> None:
    seen: set[int] = set()
    places = [
        found for cls, thing in instances().items() for found in reached(thing, seen, cls.__name__)
    ]
    assert len({type(x) for _, x in places}) > 40  # the walk goes inside
    long = {
        path: (lines, type(x).__name__)
        for path, x in places
        if (lines := len(form(x).splitlines())) > MOST_LINES or len(form(x)) > MOST_LINES * 200
    }
    assert long == {}
