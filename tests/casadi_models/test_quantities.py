"""A unit is its exponents: side of the gear ratio, linear twin and FMI base unit follow by
arithmetic.
"""

from __future__ import annotations

from types import SimpleNamespace

import casadi as ca
import numpy as np
import numpy.typing as npt
import pytest

from casadi_models import EFFECTS, LocalSignals
from casadi_models.effect import Effect
from casadi_models.quantities import TABLE, UnitError, base_unit, linear_unit, side_power
from casadi_models.sides import side_factor
from casadi_models.term import INERTIAS, LOAD_COMPLIANCE, LOAD_DAMPING, smoothing
from identification.data.joint_file import parse_joint
from identification.errors import InputError

FloatArray = npt.NDArray[np.float64]
PLACES = [(k, p) for k in sorted(EFFECTS) for p in EFFECTS[k].acts_on]
RATIOS = (-160.0, 160.0, -3.0)
ANGLES = ("torsion", "motor_position_sensor", "link_position_sensor")
"""Places whose law returns an angle; elsewhere it returns a torque."""
SAMPLES = 400


def path() -> dict[str, FloatArray]:
    """A motion of the link side with two reversals: what a law may use, link-referred."""
    t = np.linspace(0.0, 1.0, SAMPLES)
    q, v, a = 0.7 * np.sin(5 * t), 3.5 * np.cos(5 * t), -17.5 * np.sin(5 * t)
    torsion, rate = 1.2e-3 * np.sin(7 * t + 0.3), 8.4e-3 * np.cos(7 * t + 0.3)
    torque = 4500.0 * np.sin(6 * t + 0.4)
    return {
        "time": t,
        "position": q,
        "velocity": v,
        "acceleration": a,
        "torsion": torsion,
        "torsion_rate": rate,
        "torque": torque,
        "torque_rate": 27000.0 * np.cos(6 * t + 0.4),
        "temperature": 10.0 * t,
    }


def run(
    effect: Effect, place: str, values: dict[str, float], ratio: float, *, motor: bool
) -> FloatArray:
    """The law along the path: in link coordinates, or in those of the motor shaft, q_M = n q."""
    s = path()
    angle, torque = (ratio, 1 / ratio) if motor else (1.0, 1.0)
    # a law "per turn of the link" counts the angle of the link on either side of the gear
    per_turn = effect.angular or any("per turn" in p.meaning for p in effect.parameters)
    turns = (np.sign(ratio) if motor else 1.0) if per_turn else angle
    read_angle = place in ("motor_position_sensor", "link_position_sensor")
    drive = s["position"] if read_angle else s["torque"]
    drive_rate = s["velocity"] if read_angle else s["torque_rate"]
    reading = angle if read_angle else torque
    states: tuple[float, ...] = (0.0,) * effect.states
    parameters = SimpleNamespace(**values)
    smooth = 0.05 * (abs(ratio) if motor else 1.0)
    twist = effect.family == "transmission"
    along = s["torsion" if twist else "position"] * (angle if twist else turns)
    signals = {
        "position": along,
        "velocity": s["velocity"] * angle,
        "acceleration": s["acceleration"] * angle,
        "direction": np.tanh(s["velocity"] * angle / smooth),
        "torsion": s["torsion"] * angle,
        "torsion_rate": s["torsion_rate"] * angle,
        "torque": s["torque"] * torque,
        "load": s["torque"] * torque,
        "reading": drive * reading,
        "reading_rate": drive_rate * reading,
        "motor_angle": s["position"] * ratio,
        "time": s["time"],
        "temperature": s["temperature"],
    }
    fixed = {"gear_ratio": 1.0 if motor else ratio, "clock": float(s["time"][1])}
    if effect.memory is None:  # all samples at once
        whole = LocalSignals(**{n: ca.DM(x) for n, x in signals.items()}, **fixed, memory=())
        return np.ones(SAMPLES) * ca.DM(effect.law(whole, parameters)).full()[:, 0]
    out = np.zeros(SAMPLES)
    for k in range(SAMPLES):
        now = {n: float(x[k]) for n, x in signals.items()}
        at = LocalSignals(**now, **fixed, memory=states)
        if k:
            step = float(along[k] - along[k - 1])
            states = tuple(float(ca.DM(z)) for z in effect.memory(states, step, at, parameters))
            at = LocalSignals(**now, **fixed, memory=states)
        out[k] = float(ca.DM(effect.law(at, parameters)))
    return out


def motor_values(effect: Effect, ratio: float) -> dict[str, float]:
    """Values of usual size on the link, taken to the motor shaft."""
    link = {}
    for i, p in enumerate(effect.parameters):
        size = {"rad": 7e-4, "rad/s": 0.4, "1": 0.8, "Hz": 9.0}.get(p.unit, 3.0 + i)
        link[p.name] = min(max(p.start, size), p.high) if p.is_shape else size
    return {p.name: link[p.name] / side_factor(effect, p, ratio) for p in effect.parameters}


@pytest.mark.parametrize("ratio", RATIOS)
@pytest.mark.parametrize(("key", "place"), PLACES)
def test_a_law_on_the_motor_shaft_is_the_law_on_the_link(
    key: str, place: str, ratio: float
) -> None:
    """Torque on the shaft is that on the link over n, angle on the shaft that on the link times
    n.
    """
    effect = EFFECTS[key]
    # a ratio that turns the sense mirrors a table, which no factor does: given on the link only
    ratio = abs(ratio) if effect.table else ratio
    on_motor = motor_values(effect, ratio)
    on_link = {p.name: on_motor[p.name] * side_factor(effect, p, ratio) for p in effect.parameters}
    link = run(effect, place, on_link, ratio, motor=False)
    shaft = run(effect, place, on_motor, ratio, motor=True)
    wanted = link * ratio if place in ANGLES else link / ratio
    assert np.ptp(link) > 0 or np.any(link != 0), "the path must show the effect"
    # 1e-6 N2.m2 under the root of a load and 1e-12 beside a squared velocity are not scaled with it
    np.testing.assert_allclose(shaft, wanted, rtol=1e-5, atol=2e-4 * float(np.max(np.abs(wanted))))


@pytest.mark.parametrize("key", sorted(EFFECTS))
def test_a_wrong_power_or_sign_is_seen_by_that_comparison(key: str) -> None:
    effect = EFFECTS[key]
    ratio = 160.0 if effect.table else -160.0
    place = effect.acts_on[0]
    values = motor_values(effect, ratio)
    wanted = run(effect, place, values, ratio, motor=True)
    for p in effect.amplitudes:
        one = {**values, **{q.name: 0.0 for q in effect.amplitudes if q.name != p.name}}
        shaft = run(effect, place, one, ratio, motor=True) * (
            1 / ratio if place in ANGLES else ratio
        )
        if effect.table and not shaft.any():
            continue  # a knot beyond the path tells nothing
        for wrong in (ratio, 1 / ratio, -1.0):
            link = {q.name: one[q.name] * side_factor(effect, q, ratio) for q in effect.parameters}
            link[p.name] *= wrong
            other = run(effect, place, link, ratio, motor=False)
            assert np.max(np.abs(other - shaft)) > 0.1 * np.max(np.abs(shaft)), (p.name, wrong)
    assert np.any(wanted != 0)


@pytest.mark.parametrize(
    ("unit", "power"),
    [
        ("N.m", 1),
        ("N.m/rad", 2),
        ("N.m/rad3", 4),
        ("kg.m2", 2),
        ("N.m.s/rad", 2),
        ("N.m.s2/rad2", 3),
        ("N.m.s3/rad3", 4),
        ("rad/(N.m)", -2),
        ("rad", -1),
        ("rad/s", -1),
        ("N.m/K", 1),
        ("N.m.s/(rad.K)", 2),
        ("s", 0),
        ("Hz", 0),
        ("1", 0),
        ("J", 0),
        ("W", 0),
        ("N.m/A", 1),
        ("kg.m2/s", 2),
    ],
)
def test_power_of_the_ratio(unit: str, power: int) -> None:
    assert side_power(unit) == power
    if power and linear_unit(unit) != unit:
        assert side_power(linear_unit(unit)) == power, (
            "the twin of a linear axis goes with the ratio alike"
        )


@pytest.mark.parametrize(
    ("rotary", "linear"),
    [
        ("N.m", "N"),
        ("N.m.s/rad", "N.s/m"),
        ("N.m.s3/rad3", "N.s3/m3"),
        ("N.m/rad", "N/m"),
        ("N.m/rad3", "N/m3"),
        ("rad", "m"),
        ("rad/s2", "m/s2"),
        ("kg.m2", "kg"),
        ("rad/(N.m)", "m/N"),
        ("N.m.s/(rad.K)", "N.s/(m.K)"),
        ("N.m/A", "N/A"),
        ("Hz", "Hz"),
        ("1", "1"),
        ("s", "s"),
        ("N", "N"),
        ("m/s", "m/s"),
        ("furlong", "furlong"),
    ],
)
def test_linear_twin(rotary: str, linear: str) -> None:
    assert linear_unit(rotary) == linear
    assert linear_unit(linear) == linear


def test_every_parameter_of_a_joint_has_a_side_and_a_linear_twin_without_angles() -> None:
    own = [*INERTIAS.values(), LOAD_COMPLIANCE, LOAD_DAMPING, smoothing("motor")]
    for p in [*own, *(p for e in EFFECTS.values() for p in e.parameters)]:
        found = base_unit(linear_unit(p.unit))
        assert found.rad == 0, p.name
        assert side_power(p.unit) == side_power(linear_unit(p.unit))


def test_inertia_and_compliance_by_the_equation_of_motion() -> None:
    """J q'' of the link, and c T, from the shaft's own acceleration and torque."""
    n, acceleration, torque = -160.0, 2.5, 30.0
    inertia, compliance = 4e-5, 0.7
    on_shaft = inertia * (n * acceleration)
    assert inertia * side_factor(
        None, INERTIAS["motor_inertia"], n
    ) * acceleration == pytest.approx(n * on_shaft)
    twist = compliance * (torque / n)
    assert compliance * side_factor(None, LOAD_COMPLIANCE, n) * torque == pytest.approx(twist / n)


def test_an_energy_is_no_torque_though_the_exponents_are_equal() -> None:
    assert base_unit("J") == base_unit("N.m")
    assert side_power("J") != side_power("N.m")


def test_a_unit_with_length_and_angle_has_no_side() -> None:
    with pytest.raises(UnitError, match="both a length and an angle"):
        side_power("N/rad")


def test_every_name_of_the_table_reads_as_itself() -> None:
    for name, unit in TABLE.items():
        if name != "g0":
            assert base_unit(name).exponents == unit.exponents
            assert base_unit(name).factor == unit.factor
    assert base_unit("MN").factor == 1e6
    with pytest.raises(UnitError):
        base_unit("kmin")


# --- the joint file -------------------------------------------------------------------------------


def known(
    name: str, entry: object, effect: str, ratio: float = -160.0, kind: str = "rotary"
) -> tuple[float | None, ...]:
    table = {"gear_ratio": ratio, "model": "hd3", "effects": [effect], "kind": kind}
    found = parse_joint({"joint": table, "known": {name: entry}}).known[name]
    return found.value, found.low, found.high


@pytest.mark.parametrize(
    ("name", "effect", "power"),
    [
        ("motor_cubic_viscous", "cubic_viscous@motor", 4),
        ("motor_quadratic_drag", "quadratic_drag@motor", 3),
        ("motor_loss_cubic", "transmission_losses@motor", 4),
        ("sensor_compliance", "torque_sensor_compliance", -2),
        ("motor_thermal_viscous", "thermal_friction@motor", 2),
        ("motor_coulomb", "coulomb@motor", 1),
        ("motor_inertia", "coulomb@motor", 2),
        ("stiffness", "coulomb@motor", 2),
        ("motor_smoothing_velocity", "coulomb@motor", -1),
        ("structural_damping", "coulomb@motor", 2),
    ],
)
def test_a_known_value_of_the_motor_side_goes_through_the_gear(
    name: str, effect: str, power: int
) -> None:
    value, low, high = known(
        name, {"value": 2e-6, "low": 1e-6, "high": 3e-6, "side": "motor"}, effect
    )
    assert (value, low, high) == pytest.approx(
        (2e-6 * 160.0**power, 1e-6 * 160.0**power, 3e-6 * 160.0**power)
    )
    assert known(name, {"value": 2e-6, "side": "link"}, effect)[0] == pytest.approx(2e-6)


def test_bounds_change_places_where_link_and_motor_are_counted_against_each_other() -> None:
    value, low, high = known(
        "motor_asymmetric_coulomb",
        {"value": 1.0, "low": 0.5, "high": 2.0, "side": "motor"},
        "asymmetric_coulomb@motor",
    )
    assert (value, low, high) == (-160.0, -320.0, -80.0)
    value, low, high = known(
        "motor_asymmetric_coulomb",
        {"value": 1.0, "low": 0.5, "side": "motor"},
        "asymmetric_coulomb@motor",
    )
    assert (value, low, high) == (-160.0, None, -80.0)


def test_a_linear_axis_goes_through_its_ratio_too() -> None:
    assert known(
        "motor_viscous",
        {"value": 2.0, "side": "motor", "unit": "N.s/m"},
        "viscous@motor",
        5.0,
        "linear",
    )[0] == pytest.approx(50.0)
    with pytest.raises(InputError, match="must be one like N.s/m"):
        known("motor_viscous", {"value": 2.0, "unit": "N.m.s/rad"}, "viscous@motor", 5.0, "linear")
