"""Reference joints: plants whose parameters are known, to try estimators on, and a motion that
shows all of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, final

from casadi_models import JointModel, thesis
from identification.data.joint_file import Joint
from identification.data.plain_text import from_json
from identification.errors import InputError

_HD: Final[Mapping[str, float]] = {
    "motor_inertia": 4.447,
    "link_inertia": 10.277,
    "gravity_torque": 105.18,
    "stiffness": 2.1513e4,
    "structural_damping": 40.0,
    "motor_viscous": 23.63,
    "motor_coulomb": 21.5,
    "link_viscous": 9.73,
    "motor_stribeck_extra": 8.0,
    "motor_stribeck_velocity": 0.05,
    "motor_loss_constant": 21.5,
    "motor_loss_viscous": 23.63,
    "motor_loss_cubic": 6.0,
    "motor_loss_sine": 2.0,
    "motor_loss_cosine": 1.0,
    "kinematic_error_sine": 2e-4,
    "kinematic_error_cosine": 1e-4,
    "kinematic_error_sine_2": 1e-4,
    "kinematic_error_cosine_3": 1e-4,
}
"""Magnitudes of tables 4.1 and 4.3 of the thesis; losses, Stribeck part and kinematic errors of
usual size.
"""
_HD_EFFECTS: Final = {
    "hd1": ("viscous@motor", "coulomb@motor", "gravity"),
    "hd2": ("gravity",),
    "hd3": ("viscous@motor", "coulomb@motor", "stribeck@motor", "viscous@link", "gravity"),
    "hd4": ("viscous@motor", "coulomb@motor", "stribeck@motor", "viscous@link", "gravity"),
}
_RATIO: Final = {"1": 161.0, "2": -160.0, "IRJ": -160.0}
_THESIS: Final = {
    "irj1a": thesis.model_1a,
    "irj1b": thesis.model_1b,
    "irj2a": thesis.model_2a,
    "irj2b": thesis.model_2b,
    "irj_ts": thesis.model_ts,
}
NAMES: Final = (*_HD_EFFECTS, *_THESIS)
PER_COUNT: Final = thesis.TORQUE_PER_COUNT.value


def reference_joint(name: str, configuration: str = "IRJ") -> Joint:
    """A joint whose every parameter has a value.

    Parameters
    ----------
    name : str
        One of :data:`NAMES`.
    configuration : {"1", "2", "IRJ"}
        Of the harmonic drive: which port is held.

    Raises
    ------
    InputError
        Unknown name or configuration.
    """
    if name not in NAMES or configuration not in _RATIO:
        raise InputError(
            f"reference joint {name!r} in configuration {configuration!r}: there are "
            f"{', '.join(NAMES)} in 1, 2, IRJ"
        )
    ratio = _RATIO[configuration]
    if name in _THESIS:
        model = _THESIS[name]()
        return of_model(
            replace(model, gear_ratio=ratio), name, math.copysign(PER_COUNT * 1000, ratio)
        )
    effects = _HD_EFFECTS[name]
    joint = Joint(
        name=name,
        gear_ratio=ratio,
        torque_per_current=math.copysign(8.84, ratio),
        model_name=name,
        effects=effects,
    )
    known = set(joint.model().parameter_names)
    return replace(joint, fitted=_all_values(joint, {k: v for k, v in _HD.items() if k in known}))


def of_model(model: JointModel, model_name: str, torque_per_current: float | None = None) -> Joint:
    """A joint file for a model of a known name, all its values filled in."""
    joint = Joint(
        name=model_name,
        gear_ratio=model.gear_ratio,
        torque_per_current=torque_per_current,
        model_name=model_name,
    )
    return replace(
        joint,
        fitted=_all_values(
            joint, dict(zip(model.parameter_names, model.value_vector(), strict=True))
        ),
    )


def _all_values(joint: Joint, values: Mapping[str, float]) -> dict[str, float]:
    model = joint.model()
    own = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    return {**own, **{k: v for k, v in values.items() if k in own}}


def published_joint(
    path: Path, name: str, *, link_inertia: float = 0.5, gravity_torque: float = 15.0
) -> Joint:
    """A joint of the published friction models M1 to M6 of geared servo modules.

    Parameters
    ----------
    path : Path
        ``params.json`` of github.com/Rhoban/bam (Duclusaud et al., ICRA 2025, arXiv 2410.08650).
    name : str
        A key, e.g. ``erob80_50/m1``.
    link_inertia, gravity_torque : float
        Load on the module [kg m2, N m]; the set does not hold one.

    Raises
    ------
    InputError
        Where the file or the key is missing, or the module has no gear ratio in its name.
    """
    try:
        table: dict[str, Any] = from_json(Path(path).read_text(encoding="utf-8"), str(path))
        row = table[name]
        needed = {n: float(row[n]) for n in ("armature", "friction_viscous", "friction_base", "kt")}
        needed |= {
            n: float(row[n])
            for n in ("dtheta_stribeck", "alpha")
            if float(row.get("friction_stribeck", 0.0)) > 1e-3
        }
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); give the path of a table of published "
            "parameters"
        ) from None
    except KeyError as error:
        if name not in table:
            raise InputError(
                f"{path}: no parameters {name!r}; "
                f"{'there are ' + ', '.join(sorted(table)) if table else 'it holds none at all'}"
            ) from None
        raise InputError(
            f"{path}: {name} has no {error.args[0]}; give a table with a row of numbers for each "
            "module"
        ) from None
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path}: not a table of published parameters ({error}); give the params.json of the "
            "set"
        ) from None
    digits = name.partition("/")[0].rpartition("_")[2]
    if not digits.isdigit():
        raise InputError(f"{name}: the module's name does not say its gear ratio")
    effects = ["viscous@motor", "coulomb@motor", "gravity"]
    values = {
        "motor_inertia": needed["armature"],
        "link_inertia": link_inertia,
        "gravity_torque": gravity_torque,
        "motor_viscous": needed["friction_viscous"],
        "motor_coulomb": needed["friction_base"],
    }
    if float(row.get("friction_stribeck", 0.0)) > 1e-3:
        effects.insert(2, "stribeck@motor")
        values |= {
            "motor_stribeck_extra": float(row["friction_stribeck"]),
            "motor_stribeck_velocity": needed["dtheta_stribeck"],
            "motor_stribeck_exponent": min(2.0, max(0.5, needed["alpha"])),
        }
    joint = Joint(
        name=name.replace("/", "_"),
        gear_ratio=float(digits),
        torque_per_current=needed["kt"],
        model_name="hd1",
        effects=tuple(effects),
    )
    return replace(joint, fitted=_all_values(joint, values))


def start_of(joint: Joint) -> Joint:
    """The joint before a fit: what an estimator holds is known, everything it estimates is
    forgotten.
    """
    from identification.online.estimator import estimated_parameters

    forgotten = set(estimated_parameters(joint))
    return replace(joint, fitted={k: v for k, v in joint.fitted.items() if k not in forgotten})


@final
@dataclass(frozen=True)
class Motion:
    """A motion that shows stiffness, inertias, gravity and friction at slow and fast speeds.

    A slow swing over the whole range, and a faster sum of sines that swells and dies away every 20
    s, so that both fast parts and undisturbed slow reversals occur.

    Attributes
    ----------
    range : float
        Amplitude of the slow swing [rad].
    speed : float
        Factor on all frequencies.
    """

    range: float = 0.8
    speed: float = 1.0

    def expressions(self, t: Any) -> tuple[Any, Any, Any]:
        """Position, velocity and acceleration as CasADi expressions of a time symbol or
        expression.
        """
        import casadi as ca

        now = ca.SX.sym("now")
        s = 2 * math.pi * self.speed
        swell = ca.sin(math.pi * self.speed * now / 20) ** 2
        fast = (
            0.2 * ca.sin(s * 0.37 * now)
            + 0.06 * ca.sin(s * 1.13 * now + 1)
            + 0.015 * ca.sin(s * 2.9 * now + 2)
        )
        q = self.range * ca.sin(s * 0.07 * now) + swell * fast + 0.02 * ca.sin(s * 0.31 * now)
        v = ca.jacobian(q, now)
        found = ca.Function("motion", [now], [q, v, ca.jacobian(v, now)])(t)
        return found[0], found[1], found[2]

    def start(self) -> tuple[float, float]:
        """Position and velocity at the beginning."""
        q, v, _ = self.expressions(0.0)
        return float(q), float(v)


def selected_motion(joint: Joint) -> Motion:
    """The built-in motion, fast enough to pass the velocity of a Stribeck law."""
    top = 1.3  # rad/s, at speed 1
    shapes = (
        p for t in joint.model().terms for p in t.parameters if p.is_shape and p.scale == "velocity"
    )
    velocities = [joint.fitted[p.name] for p in shapes if p.name in joint.fitted]
    return Motion(speed=max(1.0, *(1.2 * v / top for v in velocities)) if velocities else 1.0)
