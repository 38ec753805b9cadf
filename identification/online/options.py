"""What an online estimator of a joint file estimates, from which balances, with which tuning."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, final

from casadi_models import JointModel
from casadi_models.hold import CLOCKS, HOLD_DELAY
from identification.balance.calibration import unknowns_of
from identification.balance.sensing import Sensing, adapt
from identification.data.joint_file import Joint
from identification.errors import InputError
from identification.online.rows import linear_parameters
from identification.online.shapes.rows import shape_parameters


@final
@dataclass(frozen=True)
class OnlineOptions:
    """Tuning of the online estimator.

    Attributes
    ----------
    has_link, has_torque : bool
        Whether there are a link encoder and a torque sensor.
    warm_up : float
        First window, from which the recursion starts [s]; 7 s in the thesis.
    drift, alarm_drift : float
        Forgetting: drift of a parameter as a share of its prior range per sqrt(s), in calm and in
        an alarm.
    floor_share : float
        A balance's floor is never below this share of the torque it balances.
    detect : bool
        Run the fault detector; it needs an elastic joint whose values are known.
    optimise : bool
        Search the shapes of friction and stiffness laws (two-step algorithm) where the linear
        parameters do not explain the residuals, and after the first window where the joint file has
        no values for them.
    portions : int
        Portions of a search per sample.
    """

    has_link: bool = True
    has_torque: bool = True
    warm_up: float = 7.0
    drift: float = 3e-3
    alarm_drift: float = 1.0
    floor_share: float = 1e-3
    detect: bool = True
    optimise: bool = True
    portions: int = 1


def sensing_of(model: JointModel, options: OnlineOptions) -> Sensing:
    """Balances that the joint's sensors allow.

    Raises
    ------
    InputError
        Where the model is elastic and there is no link encoder.
    """
    common: dict[str, Any] = {
        "both_positions": options.has_link,
        "has_drive": True,
        "has_temperature": False,
    }
    if options.has_torque:
        found = ["motor", *(["link"] if options.has_link else [])]
        if model.is_elastic:
            if not options.has_link:
                raise InputError(
                    f"{model.name}: an elastic model needs the link position; use a rigid one "
                    "(hd1, hd2)"
                )
            found.append("transmission")
        return Sensing(tuple(found), has_torque=True, **common)
    if model.is_elastic:
        if not options.has_link:
            raise InputError(
                f"{model.name}: an elastic model needs the link position; use a rigid one (hd1, "
                "hd2)"
            )
        return Sensing(("sum", "deflection"), has_torque=False, **common)
    return Sensing(("axis",), has_torque=False, **common)


def prepared(joint: Joint, options: OnlineOptions) -> tuple[JointModel, Sensing]:
    """The joint's model adapted to its sensors, known values filled in.

    A current is commanded and held, so that its reading is early by part of a sample: the model has
    the same freedom as in a fit (:func:`identification.balance.dataset.prepared_model`), and the
    same unknowns of the sensors.
    """
    model = joint.model()
    sensing = sensing_of(model, options)
    model = adapt(model, sensing, joint.known)
    if joint.torque_per_current is not None and not model.named("delay", "drive"):
        model = model.add(HOLD_DELAY)
    known = {
        k: v.value
        for k, v in joint.known.items()
        if v.value is not None and k in model.parameter_names
    }
    own = unknowns_of(model, sensing)
    if joint.lacks(model):  # derivatives at values that are none tell no clock
        own = tuple(n for n in own if n not in CLOCKS)
    return replace(model.with_values(known), calibration=own), sensing


def held_parameters(joint: Joint) -> frozenset[str]:
    """Parameters the estimator leaves alone: known ones, delays, kinematic errors, and what shapes
    a stand-in for a signal: it has neither.

    A kinematic error multiplies the stiffness, so that one of the two must be held; it is the
    geometry.
    """
    model = joint.model()
    delays = frozenset(model.named("delay"))
    geometry = {n for t in model.terms if t.place == "torsion" for n in t.names}
    known = {k for k, v in joint.known.items() if v.value is not None}
    stand_ins = {p.name for p in model.parameters if p.in_place_of}
    return frozenset(known | geometry | stand_ins) | delays


def searched_parameters(joint: Joint, options: OnlineOptions | None = None) -> tuple[str, ...]:
    """Names of the shape parameters that an estimator of this joint can search, in the order of
    ``eta[k]``.
    """
    model, sensing = prepared(joint, options or OnlineOptions())
    held = held_parameters(joint)
    return shape_parameters(model, sensing, linear_parameters(model, sensing, held), held)


def estimated_parameters(joint: Joint, options: OnlineOptions | None = None) -> tuple[str, ...]:
    """Names of the parameters that an estimator of this joint follows, in the order of
    ``theta[k]``.
    """
    model, sensing = prepared(joint, options or OnlineOptions())
    return linear_parameters(model, sensing, held_parameters(joint))
