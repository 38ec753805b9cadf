"""Fit: parameters of a joint model from records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, final

from casadi_models import JointModel
from identification.balance.dataset import visible_labels
from identification.balance.kinematic import without_scale
from identification.data.check.gate import gated
from identification.data.joint_file import Joint
from identification.data.record import Record, listed
from identification.errors import InputError
from identification.fitting.assess import Error, assess
from identification.fitting.dataset import dataset_of
from identification.fitting.engine import Dataset, Solution, prepared_model
from identification.fitting.first_fit import first_fit
from identification.fitting.joint_text import calibration_of, joint_text
from identification.fitting.parameters import parameter_table
from identification.representation import html_of

SHOWN: Final = 20
"""Parameters that `print` shows: the whole text stays under 25 lines."""


@final
@dataclass(frozen=True)
class Fit:
    """A fitted joint model.

    Attributes
    ----------
    joint : Joint
        What was known beforehand.
    solution : Solution
        Values, standard errors, flags.
    data : Dataset
        The prepared records.
    train : Error
        On the records of the fit.
    held_out : Error or None
    """

    joint: Joint
    solution: Solution
    data: Dataset
    train: Error
    held_out: Error | None
    records: tuple[Record, ...] = ()

    @property
    def model(self) -> JointModel:
        """The model with its fitted values."""
        return self.solution.model

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Parameter table (see :func:`identification.fitting.parameters.parameter_table`)."""
        return parameter_table(self.solution, self.data)

    @property
    def scale(self) -> str:
        """What torques are worth where none was recorded; empty where one was."""
        return without_scale(self.model, self.data.sensing, self.data.joint.known)

    def as_json(self) -> dict[str, Any]:
        """Values, errors and flags as data."""
        return {
            "records": list(self.data.train_names),
            "effects": list(self.model.effects),
            "train": self.train.as_json(),
            "held_out": self.held_out.as_json() if self.held_out else None,
            "parameters": self.parameters,
            "calibration": [c.as_json() for c in calibration_of(self.solution, self.data)],
        }

    def to_joint_file(self) -> str:
        """The fitted joint as the text of a joint file."""
        return joint_text(self.joint, self.solution, self.data)

    def __str__(self) -> str:
        effects = ", ".join(visible_labels(self.model)) or "no effect beyond the model's own"
        held = (
            f", {self.held_out.relative_error_percent:.3g} % on held-out records"
            if self.held_out
            else ""
        )
        lines = [
            f"{self.joint.name}: fitted to {', '.join(self.data.train_names)}",
            f"model: {effects}",
            f"relative error {self.train.relative_error_percent:.3g} %{held}",
            *([self.scale] if self.scale else []),
        ]
        shown = [(n, p) for n, p in self.parameters.items() if not p["nuisance"]]
        for name, p in shown[:SHOWN]:
            error = f" +- {p['stderr']:.2g}" if p["stderr"] is not None else ""
            lines.append(f"  {name:<28} {p['value']:.6g}{error} {p['unit']} ({p['side']} side)")
        if len(shown) > SHOWN:
            lines.append(f"  and {len(shown) - SHOWN} more in .parameters")
        return "\n".join(lines)

    def __repr__(self) -> str:
        return (
            f"Fit({self.joint.name!r}, {len(self.solution.free)} parameters, "
            f"{self.train.relative_error_percent:.3g} % relative error)"
        )

    def _repr_html_(self) -> str | None:
        return html_of(self)


def as_joint(model: JointModel | Joint, joint: Joint | None = None) -> Joint:
    """The joint behind a model: the joint given, with the model's effects.

    Raises
    ------
    InputError
        Neither a joint nor a model.
    """
    if isinstance(model, Joint):
        return model
    if not isinstance(model, JointModel):
        raise InputError(
            f"a joint or a model is needed, and not {type(model).__name__}: load_joint(FILE) gives "
            "one"
        )
    base = joint or Joint(name=model.name, kind=model.kind, gear_ratio=model.gear_ratio)
    return replace(
        base,
        gear_ratio=model.gear_ratio,
        kind=model.kind,
        effects=model.effects,
        model_name="hd1",
        virtual_work=model.virtual_work,
        fitted=dict(model.values),
    )


def fit(
    model: JointModel | Joint,
    records: Record | Sequence[Record],
    *,
    joint: Joint | None = None,
    held_out: Record | Sequence[Record] = (),
) -> Fit:
    """Fit a joint model to records by weighted least squares on the weak form of its balances.

    Parameters
    ----------
    model : JointModel or Joint
        The model, or a joint file read with :func:`identification.load_joint`.
    records : Record or sequence of Record
    joint : Joint, optional
        Motor constant and known values where `model` is a JointModel.
    held_out : Record or sequence of Record
        Records the fit does not see; their error is given too.

    Raises
    ------
    InputError
        Unusable records, missing channels, a parameter that moves no output.

    Examples
    --------
    >>> first = fit(load_joint("joint.toml"), read("joint3.csv"))   # doctest: +SKIP
    """
    whole = as_joint(model, joint)
    train = gated(listed(records), whole)
    if not train:
        raise InputError("no record to fit; give at least one")
    prepared = prepared_model(whole, train[0])
    data = dataset_of(train, gated(listed(held_out), whole), whole, prepared)
    solution = first_fit(prepared, data)
    return Fit(
        whole,
        solution,
        data,
        assess(solution.model, data, data.train, solution.values),
        assess(solution.model, data, data.held_out, solution.values) if data.held_out else None,
        tuple(train),
    )
