"""Two joints, their controller, an estimator for each, a failing sensor and a payload: one SSP.

    python examples/two_joints.py [--out FOLDER]

Every part is an FMU of its own; two_joints.ssp is a zip that can be taken apart. The system runs in
fmpy.ssp. The motion of both plants is compared with their equations, integrated by scipy.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from fmpy.ssp.simulation import simulate_ssp
from fmpy.ssp.ssd import read_ssv
from scipy.integrate import solve_ivp

from casadi_models.text.compensation import RestingLoad, resting_load
from identification.data.joint_file import Joint, load_joint
from irj_fmu.estimator.native import NativeSpec, build_native
from irj_fmu.fmi.ssp import PARAMETERS, System, write_ssp
from irj_fmu.fmi.variables import Variable
from irj_fmu.plant.joint import BANDWIDTH, PlantOptions, plant_spec
from irj_fmu.plant.library import PlantSpec, build_plant
from irj_fmu.plant.reference import Motion

HERE = Path(__file__).parent
NAMES = ("shoulder", "elbow")
STEP = 2e-3
STOP = 14.0
TAKEN_AT = 9.0
"""The elbow takes up its payload [s]."""
PAYLOAD = (1.0, 12.0)
"""Its inertia [kg.m2] and gravity torque [N.m]."""
FAILS_AT = 10.0
"""The shoulder's link encoder slips [s]."""
SLIP = 0.02
"""By this angle [rad]."""
READINGS = {
    "q_m": "motor_position",
    "w_m": "motor_velocity",
    "q_l": "link_position",
    "w_l": "link_velocity",
    "tau_l": "link_torque",
}


@dataclass(frozen=True)
class Law:
    """A position controller of one joint, on the motor side.

    Attributes
    ----------
    ratio, per_current : float
        Of the joint.
    stiffness, damping, inertia : float
        Gains and feed-forward, link-referred [N.m/rad, N.m.s/rad, kg.m2].
    load : RestingLoad
        What it holds at rest.
    """

    ratio: float
    per_current: float
    stiffness: float
    damping: float
    inertia: float
    load: RestingLoad

    @staticmethod
    def of(joint: Joint) -> Law:
        """Gains for a bandwidth of :data:`BANDWIDTH` and a damping ratio of 0.8."""
        value = joint.fitted
        inertia = value["motor_inertia"] + value["link_inertia"]
        return Law(
            joint.gear_ratio,
            float(joint.torque_per_current or 1.0),
            inertia * BANDWIDTH**2,
            1.6 * inertia * BANDWIDTH,
            inertia,
            resting_load(joint.model()),
        )

    def current(self, time: Any, position: Any, velocity: Any) -> Any:
        """Motor current [A] from the readings of the motor [rad, rad/s]."""
        q, v, a = Motion().expressions(time)
        torque = self.stiffness * (q - position / self.ratio)
        torque += self.damping * (v - velocity / self.ratio) + self.inertia * a
        return (torque + self.load.drive(q)) / self.per_current


def controller(laws: dict[str, Law]) -> PlantSpec:
    """The controller of both joints as a model: its only state is the time."""
    clock, p = ca.SX.sym("t"), ca.SX.sym("p", 0)
    u = ca.SX.sym("u", 2 * len(laws))
    currents = [law.current(clock, u[2 * i], u[2 * i + 1]) for i, law in enumerate(laws.values())]
    return PlantSpec(
        name="controller",
        dynamics=ca.Function("f", [clock, u, p], [ca.SX(1)]),
        output=ca.Function("y", [clock, u, p], [ca.vertcat(*currents)]),
        states=(Variable("clock", "s", description="Time since the start."),),
        inputs=tuple(
            Variable(f"{name}.motor_{what}", unit, description=f"Reading of the {name}'s motor.")
            for name in laws
            for what, unit in (("position", "rad"), ("velocity", "rad/s"))
        ),
        parameters=(),
        outputs=tuple(
            Variable(f"{name}.current", "A", description=f"Current of the {name}.") for name in laws
        ),
        description="Position control of two joints.",
    )


def payload() -> PlantSpec:
    """What hangs on the elbow: nothing, and then something."""
    clock, u, p = ca.SX.sym("t"), ca.SX.sym("u", 0), ca.SX.sym("p", 3)
    # half a step early: the clock of a host is a sum of steps
    held = clock > p[0] - STEP / 2
    return PlantSpec(
        name="payload",
        dynamics=ca.Function("f", [clock, u, p], [ca.SX(1)]),
        output=ca.Function("y", [clock, u, p], [ca.if_else(held, p[1:], ca.SX.zeros(2))]),
        states=(Variable("clock", "s", description="Time since the start."),),
        inputs=(),
        parameters=(
            Variable("taken_at", "s", TAKEN_AT, description="When it is taken up."),
            Variable("own_inertia", "kg.m2", PAYLOAD[0], 0.0, description="About the axis."),
            Variable("own_weight", "N.m", PAYLOAD[1], description="At a level link."),
        ),
        outputs=(Variable("inertia", "kg.m2"), Variable("weight", "N.m")),
        description="A payload that is taken up.",
    )


def joints() -> dict[str, Joint]:
    """The joint files beside this script."""
    return {name: load_joint(HERE / f"{name}.toml") for name in NAMES}


def build(out: Path) -> System:
    """Build the parts and the SSP in `out`."""
    models = joints()
    parts = {"payload": build_plant(payload(), out / "payload.fmu")}
    laws = {name: Law.of(joint) for name, joint in models.items()}
    parts["controller"] = build_plant(controller(laws), out / "controller.fmu")
    links: dict[str, str] = {}
    for name, joint in models.items():
        options = PlantOptions(name=name, sensors=True, payload=name == "elbow", sample_time=STEP)
        parts[name] = build_plant(plant_spec(joint, options), out / f"{name}.fmu")
        own = f"{name}_estimator"
        parts[own] = build_native(NativeSpec(joint, own, sample_time=STEP), out / f"{own}.fmu")
        links[f"{name}.i_m"] = f"controller.{name}.current"
        links[f"{own}.i_m"] = f"{name}.motor_current"
        links |= {f"{own}.{key}": f"{name}.{reading}" for key, reading in READINGS.items()}
        for what in ("position", "velocity"):
            links[f"controller.{name}.motor_{what}"] = f"{name}.motor_{what}"
    for what in ("inertia", "weight"):
        links[f"elbow.payload_{what}"] = f"payload.{what}"
    values = {
        "payload.taken_at": TAKEN_AT,
        "shoulder.link_position.fault_start": FAILS_AT,
        "shoulder.link_position.fault_bias": SLIP,
    }
    for name in NAMES:
        values |= {f"{name}.motor_position.noise": 3e-4, f"{name}.motor_velocity.noise": 0.05}
        values |= {f"{name}.link_position.noise": 2e-6, f"{name}.link_velocity.noise": 1e-3}
        values |= {f"{name}.link_torque.noise": 0.05, f"{name}.sensor.seed": 7.0}
    system = System(parts, links, values, name="two_joints", step=STEP, stop=STOP)
    write_ssp(system, out / "two_joints.ssp")
    return system


def run(out: Path, stop: float, only: dict[str, float] | None = None) -> Any:
    """Run the SSP in fmpy.ssp; one row per step.

    Parameters
    ----------
    out : Path
        Folder of the SSP.
    stop : float
        Length [s].
    only : dict, optional
        Start values by ``part.variable`` in place of those of the SSP; others keep their own.
    """
    path = str(out / "two_joints.ssp")
    values = read_ssv(path, PARAMETERS)
    if only is not None:
        values.parameters = [p for p in values.parameters if p.name in only]
        for parameter in values.parameters:
            parameter.value = only[parameter.name]
    return simulate_ssp(path, stop_time=stop - STEP / 2, step_size=STEP, parameter_set=values)


def in_python(name: str, joint: Joint, found: Any) -> np.ndarray:
    """Link position of a joint after each step, by scipy, driven as in the system.

    A current and a payload hold for a step; fmpy.ssp begins with zeros.
    """
    model = joint.model()
    dynamics = model.functions.dynamics
    values = np.tile(model.value_vector(), (len(found), 1))
    if name == "elbow":
        for parameter, what in (("link_inertia", "inertia"), ("gravity_torque", "weight")):
            at = model.parameter_names.index(parameter)
            values[1:, at] += found[f"payload.{what}"][:-1]
    drive = np.zeros((len(found), 3))
    drive[1:, 0] = found[f"controller.{name}.current"][:-1] * float(joint.torque_per_current or 1.0)
    state, positions = np.zeros(4), []
    for now, p in zip(drive, values, strict=True):
        state = solve_ivp(
            lambda _t, x, now=now, p=p: np.asarray(dynamics(x, now, p)).ravel(),
            (0.0, STEP),
            state,
            method="DOP853",
            rtol=1e-11,
            atol=1e-13,
        ).y[:, -1]
        positions.append(state[2])
    return np.array(positions)


def first(found: Any, name: str, code: int) -> float:
    """When an estimator first told a fault [s]; NaN where it never did."""
    times = found["time"][found[f"{name}_estimator.fault"] == code]
    return float(times[0]) if len(times) else math.nan


def figures(out: Path) -> dict[str, float]:
    """Build, run, and what the run shows."""
    build(out)
    models = joints()
    # a short run without noise, the payload taken up inside it, against the equations
    short = run(out, 0.4, {"payload.taken_at": 0.2})
    told = {
        f"{name}: largest distance from scipy [rad]": float(
            np.abs(short[f"{name}.link_position"] - in_python(name, models[name], short)).max()
        )
        for name in NAMES
    }
    told["elbow: swing in it [rad]"] = float(np.ptp(short["elbow.link_position"]))
    found = run(out, STOP)
    estimators = {name: found[f"{name}_estimator.theta[3]"] for name in NAMES}
    before = round((TAKEN_AT - 0.1) / STEP)
    for name, stiffness in estimators.items():
        told[f"{name}: stiffness found over true"] = float(
            stiffness[before] / models[name].fitted["stiffness"]
        )
    told["shoulder: link encoder told after [s]"] = first(found, "shoulder", 4) - FAILS_AT
    told["elbow: change of the joint told after [s]"] = first(found, "elbow", 8) - TAKEN_AT
    for number, parameter, more in zip(
        (2, 8), ("link_inertia", "gravity_torque"), PAYLOAD, strict=True
    ):
        now = float(found[f"elbow_estimator.theta[{number}]"][-1])
        truth = models["elbow"].fitted[parameter] + more
        told[f"elbow: {parameter} with its payload found over true"] = now / truth
    for name in NAMES:
        fault = found[f"{name}_estimator.fault"][found["time"] < TAKEN_AT]
        told[f"{name}: samples with a fault before"] = float(np.count_nonzero(fault))
    return told


def main() -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="folder that keeps the FMUs and the SSP")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        for text, value in figures(given.out or Path(scratch)).items():
            print(f"{text:58s} {value:.6g}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
