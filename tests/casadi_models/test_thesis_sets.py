"""Numbers of the thesis: tables, side conversions, resonances, ready models."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from casadi_models import JointModel, thesis
from casadi_models.simulate import simulate

N = 160.0


@pytest.mark.parametrize(
    ("unit", "power"),
    [
        ("N.m/rad", 2),
        ("N.m/rad3", 4),
        ("N.m.s/rad", 2),
        ("N.m", 1),
        ("kg.m2", 2),
        ("rad", -1),
        ("rad/s", -1),
    ],
)
def test_side_conversion_powers(unit: str, power: int) -> None:
    """k_motor = k_link/N^2, k2_motor = k2_link/N^4, b/N^2, Coulomb/N; angle times N."""
    assert thesis.to_motor(1.0, unit, N) == pytest.approx(N**-power, rel=1e-14)
    assert thesis.to_link(thesis.to_motor(3.7, unit, N), unit, N) == pytest.approx(3.7, rel=1e-14)
    assert thesis.to_motor(3.7, unit, -N) == thesis.to_motor(3.7, unit, N)


def test_conversion_keeps_energy_and_power() -> None:
    """The same spring, friction and inertia store and lose the same on either side."""
    q, v = 2e-3, 0.4
    angle, speed = thesis.to_motor(q, "rad", N), thesis.to_motor(v, "rad/s", N)
    assert angle == pytest.approx(N * q)
    k, k2, b, c, j = 2.1513e4, 3.3543e8, 23.6303, 21.5057, 4.447
    to_motor = thesis.to_motor
    assert to_motor(k, "N.m/rad", N) * angle**2 / 2 == pytest.approx(k * q**2 / 2)
    assert to_motor(k2, "N.m/rad3", N) * angle**4 / 4 == pytest.approx(k2 * q**4 / 4)
    assert to_motor(b, "N.m.s/rad", N) * speed**2 == pytest.approx(b * v**2)
    assert to_motor(c, "N.m", N) * speed == pytest.approx(c * v)
    assert to_motor(j, "kg.m2", N) * speed**2 / 2 == pytest.approx(j * v**2 / 2)


def test_conversion_refuses_what_it_does_not_know() -> None:
    with pytest.raises(ValueError, match="no rule"):
        thesis.to_link(1.0, "furlong", N)
    with pytest.raises(ValueError, match="reduction 0"):
        thesis.to_link(1.0, "N.m", 0.0)


def test_catalogue_table_and_its_curve_fit() -> None:
    t, fit = thesis.numbers(thesis.TABLE_2_3), thesis.numbers(thesis.TABLE_4_1)
    assert (t["k1"], t["k2"], t["k3"], t["knot_1"], t["knot_2"]) == (3.1e4, 5.0e4, 5.7e4, 7.0, 25.0)
    assert (fit["stiffness"], fit["cubic_stiffness"]) == (4.278e4, 1.174e9)
    assert t["k1"] < fit["stiffness"] < t["k3"]


def carried(model: JointModel, twist: float) -> float:
    """Torque of the transmission at a twist, at rest."""
    return float(model.functions.outputs([twist, 0, 0, 0], np.zeros(3), model.value_vector())[4])


def test_catalogue_stiffness_has_its_knots_at_the_printed_torques() -> None:
    model = thesis.catalogue_stiffness()
    t = thesis.numbers(thesis.TABLE_2_3)
    first, second = model.values["stiffness_knot_1"], model.values["stiffness_knot_2"]
    assert carried(model, first) == pytest.approx(t["knot_1"], rel=1e-12)
    assert carried(model, second) == pytest.approx(t["knot_2"], rel=1e-12)
    assert carried(model, -second) == pytest.approx(-t["knot_2"], rel=1e-12)
    at_range = second + (t["range"] - t["knot_2"]) / t["k3"]
    assert carried(model, at_range) == pytest.approx(t["range"], rel=1e-12)


def test_curve_fit_lies_closer_to_the_knots_of_size_25() -> None:
    """Largest gap of eq. 2.69 to the catalogue over its range: 10.7 N.m as printed, 5.4 N.m
    with knots 14 and 48.
    """
    fit = thesis.numbers(thesis.TABLE_4_1)
    gaps = []
    for knots in (None, (14.0, 48.0)):
        model = thesis.catalogue_stiffness(knots)
        twists = np.linspace(0, thesis.TABLE_2_3["relative_position"].value, 400)
        cubic = fit["stiffness"] * twists + fit["cubic_stiffness"] * twists**3
        gaps.append(float(np.abs(cubic - [carried(model, d) for d in twists]).max()))
    assert gaps[0] == pytest.approx(10.7, abs=0.1)
    assert gaps[1] == pytest.approx(5.4, abs=0.1)


def test_motor_constant_is_18_percent_above_the_catalogue() -> None:
    catalogue = thesis.TABLE_4_1["torque_per_count"].value
    assert catalogue == 0.00746
    assert thesis.TORQUE_PER_COUNT.value == 0.00884
    assert thesis.TORQUE_PER_COUNT.value / catalogue - 1 == pytest.approx(0.18, abs=0.006)
    assert thesis.TORQUE_PER_COUNT.value * 2**14 == pytest.approx(
        thesis.TABLE_2_3["range"].value, rel=0.04
    )


def test_stiffness_of_model_2a_is_1_23_times_the_catalogue() -> None:
    assert thesis.STIFFNESS_2A.value / thesis.TABLE_4_1["stiffness"].value == pytest.approx(
        1.23, abs=0.006
    )


@pytest.mark.parametrize(
    ("make", "variant", "inertia", "gravity", "coulomb"),
    [
        (thesis.model_1a, "y1", 8.7143, 108.570, None),
        (thesis.model_1a, "y2", 9.9550, 112.672, None),
        (thesis.model_1a, "coupled", 9.3346, 110.621, None),
        (thesis.model_1b, "y1", 8.4032, 111.277, 28.1358),
        (thesis.model_1b, "y2", 9.9550, 112.672, 0.0),
        (thesis.model_1b, "coupled", 9.1791, 111.975, 28.1442),
    ],
)
def test_rigid_models(
    make: Callable[[str], JointModel],
    variant: str,
    inertia: float,
    gravity: float,
    coulomb: float | None,
) -> None:
    model = make(variant)
    values = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    assert not model.is_elastic
    assert model.gear_ratio == -N
    assert (values["link_inertia"], values["gravity_torque"]) == (inertia, gravity)
    assert values["motor_inertia"] == 4.447
    assert values.get("motor_coulomb") == coulomb


def test_coupled_values_lie_between_the_decoupled_ones() -> None:
    """The thesis: coupled inertia and gravity are almost the mean of the decoupled ones."""
    for model in ("1a", "1b"):
        rows = [thesis.numbers(thesis.TABLE_4_2[f"{model}_{v}"]) for v in ("y1", "y2", "coupled")]
        for name in ("link_inertia", "gravity_torque"):
            assert rows[2][name] == pytest.approx((rows[0][name] + rows[1][name]) / 2, rel=1e-4)


def test_model_2b_is_table_4_3() -> None:
    model = thesis.model_2b()
    values = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    for name, value in {
        "stiffness": 2.1513e4,
        "cubic_stiffness": 3.3543e8,
        "motor_added_spring": 86.2313,
        "motor_coulomb": 21.5057,
        "motor_viscous": 23.6303,
        "link_coulomb": 0.4124,
        "link_viscous": 9.7285,
        "motor_inertia": 4.447,
        "link_inertia": 10.277,
        "gravity_torque": 105.18,
    }.items():
        assert values[name] == value


def test_resonances_of_table_4_3() -> None:
    """Locked motor 7.3 Hz, free 13.2 Hz: the 15 Hz prefilter of the thesis stands on the
    resonance.
    """
    names = [
        "gravity_torque",
        "motor_added_spring",
        "motor_coulomb",
        "link_coulomb",
        "motor_viscous",
        "link_viscous",
    ]
    springs = dict.fromkeys(names, 0.0)
    model = thesis.model_2b().with_values(springs)
    free = np.asarray(model.linearize().poles())
    assert free.imag.max() / (2 * math.pi) == pytest.approx(13.25, abs=0.005)
    locked = np.asarray(model.with_values({"motor_inertia": 1e12}).linearize().poles())
    assert locked.imag.max() / (2 * math.pi) == pytest.approx(7.28, abs=0.005)


def test_friction_of_the_ts_model_is_equation_4_18() -> None:
    model = thesis.model_ts()
    bare = model.with_values({"motor_added_spring": 0.0, "stiffness": 0.0, "cubic_stiffness": 0.0})
    for w in (-0.4, -0.0251, 0.003, 0.06, 0.8):
        a = float(bare.dynamics([0.0, w, 0.0, 0.0], np.zeros(3), bare.value_vector())[1])
        torque = 9 * w + 29 * math.tanh(w / 0.0595) + 480 * w * math.exp(-abs(w) / 0.0251)
        assert -4.447 * a == pytest.approx(torque, rel=1e-6)


def test_peak_of_the_smooth_stribeck_term_is_at_its_velocity() -> None:
    """C2 w exp(-w/wS) peaks at wS with C2 wS/e = 4.43 N.m."""
    w = np.linspace(1e-4, 0.2, 20001)
    term = 480 * w * np.exp(-w / 0.0251)
    assert w[np.argmax(term)] == pytest.approx(0.0251, rel=1e-3)
    assert term.max() == pytest.approx(4.43, abs=0.005)


def test_cyclic_torque_has_amplitude_and_phase_of_the_thesis() -> None:
    sine, cosine = (thesis.CYCLIC[f"link_cyclic_torque_{n}"].value for n in ("sine", "cosine"))
    assert math.hypot(sine, cosine) == pytest.approx(3.7)
    assert math.degrees(math.atan2(cosine, sine)) == pytest.approx(0.05)


def test_singular_values_are_norms_of_columns() -> None:
    """sin^2 + cos^2 = 1: the two cyclic columns together are as long as the Coulomb column."""
    t4, t5 = thesis.numbers(thesis.TABLE_4_4), thesis.numbers(thesis.TABLE_4_5)
    both = math.hypot(t5["link_cyclic_torque_sine"], t5["link_cyclic_torque_cosine"])
    assert both == pytest.approx(t4["link_coulomb"], rel=5e-4)
    assert t4["link_coulomb"] ** 2 == pytest.approx(1298, abs=0.1)


def test_time_variant_test_and_sensors() -> None:
    assert thesis.TIME_VARIANT == {"linear": (16.0, 1.3), "nonlinear": (27.0, 1.2)}
    sensors = thesis.numbers(thesis.TABLE_B_1)
    assert sensors["torque"] == 0.05
    assert math.degrees(sensors["link_position"]) == pytest.approx(0.0036)
    assert math.degrees(sensors["motor_position"]) == pytest.approx(0.0010)
    assert sensors["current_bits"] == 15
    assert sensors["acceleration"] == pytest.approx(0.00098 * 9.81, rel=2e-3)


def test_every_value_has_a_source_and_a_unit() -> None:
    named = [
        thesis.TABLE_2_3,
        thesis.TABLE_4_1,
        thesis.TABLE_4_3,
        thesis.TABLE_4_4,
        thesis.TABLE_4_5,
    ]
    tables = [*named, thesis.TABLE_4_6, thesis.CYCLIC, thesis.TABLE_B_1, *thesis.TABLE_4_2.values()]
    for table in tables:
        for value in table.values():
            assert value.source
            assert value.unit
            assert value.referred_to in ("link", "motor")


@pytest.mark.parametrize(
    "make",
    [
        thesis.model_1a,
        thesis.model_1b,
        thesis.model_2a,
        thesis.model_2b,
        thesis.model_ts,
        thesis.catalogue_stiffness,
    ],
)
def test_ready_models_simulate(make: Callable[[], JointModel]) -> None:
    model = make()
    run = simulate(model, np.full(50, 20.0), 2e-3)
    assert np.isfinite(run.states).all()
    assert run.states[-1, 1] > 0.0
