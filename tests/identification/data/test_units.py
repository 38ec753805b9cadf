"""Units: factors against definitions, dimension checks, FMI base units."""

from __future__ import annotations

import math

import numpy as np
import pytest

from identification.data.units import QUANTITIES, base_unit, check_unit, from_si, to_si
from identification.errors import InputError

G0 = 9.80665
POUND = 0.45359237

FACTORS = [
    ("rad", 1.0),
    ("deg", math.pi / 180),
    ("rev", 2 * math.pi),
    ("turn", 2 * math.pi),
    ("rpm", 2 * math.pi / 60),
    ("deg/s", math.pi / 180),
    ("mA", 1e-3),
    ("mV", 1e-3),
    ("kN", 1e3),
    ("lbf", POUND * G0),
    ("N.m", 1.0),
    ("Nm", 1.0),
    ("mNm", 1e-3),
    ("kNm", 1e3),
    ("lbf.in", POUND * G0 * 0.0254),
    ("kg.m2", 1.0),
    ("g.cm2", 1e-7),
    ("kg.cm2", 1e-4),
    ("mm", 1e-3),
    ("um", 1e-6),
    ("µm", 1e-6),
    ("in", 0.0254),
    ("ms", 1e-3),
    ("us", 1e-6),
    ("m/s", 1.0),
    ("Nm/A", 1.0),
    ("N.m/rad", 1.0),
    ("N.m/deg", 180 / math.pi),
    ("N.m.s/rad", 1.0),
    ("N.m/rad3", 1.0),
    ("Nm/deg^3", (180 / math.pi) ** 3),
    ("N*m/(rad*s)", 1.0),
    ("rad.s-2", 1.0),
    ("kip", 1e3 * POUND * G0),
    ("%", 0.01),
    ("1", 1.0),
]


@pytest.mark.parametrize(("unit", "factor"), FACTORS)
def test_factor_is_that_of_the_definition(unit: str, factor: float) -> None:
    assert base_unit(unit).factor == pytest.approx(factor, rel=1e-14)


@pytest.mark.parametrize(
    ("unit", "exponents"),
    [
        ("N.m", (1, 2, -2, 0, 0, 0, 0, 0)),
        ("N.m/rad", (1, 2, -2, 0, 0, 0, 0, -1)),
        ("N.m/rad3", (1, 2, -2, 0, 0, 0, 0, -3)),
        ("Nm/A", (1, 2, -2, -1, 0, 0, 0, 0)),
        ("V", (1, 2, -3, -1, 0, 0, 0, 0)),
        ("rpm", (0, 0, -1, 0, 0, 0, 0, 1)),
        ("degC", (0, 0, 0, 0, 1, 0, 0, 0)),
        ("J/kg/K", (0, 2, -2, 0, -1, 0, 0, 0)),
    ],
)
def test_exponents_are_those_of_fmi(unit: str, exponents: tuple[int, ...]) -> None:
    assert base_unit(unit).exponents == exponents


def test_volt_times_ampere_is_newton_metre_per_second() -> None:
    assert base_unit("V.A") == base_unit("N.m/s") == base_unit("W")


def test_temperature_has_an_offset() -> None:
    assert to_si([0.0, 100.0], "degC", "temperature") == pytest.approx([273.15, 373.15])
    assert to_si(212.0, "degF") == pytest.approx(373.15)
    assert to_si(20.0, "C", "K") == pytest.approx(293.15)


def test_counts_need_counts_per_turn() -> None:
    assert to_si(1024.0, "counts", "angle", counts_per_turn=4096.0) == pytest.approx(math.pi / 2)
    assert to_si(4096.0, "counts/s", "rad/s", counts_per_turn=4096.0) == pytest.approx(2 * math.pi)
    with pytest.raises(InputError, match=r"motor_position.*counts_per_turn"):
        to_si(1.0, "counts", "angle", channel="motor_position")
    with pytest.raises(InputError, match="positive number"):
        to_si(1.0, "counts", "angle", counts_per_turn=0.0)


@pytest.mark.parametrize("unit", [u for u, _ in FACTORS] + ["degC", "degF"])
def test_from_si_is_the_inverse(unit: str) -> None:
    values = np.array([-3.5, 0.0, 2.25])
    np.testing.assert_allclose(from_si(to_si(values, unit), unit), values, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("unit", "kind"),
    [
        ("Nm", "current"),
        ("deg", "rad/s"),
        ("Hz", "angular_velocity"),
        ("1/s", "rad/s"),
        ("m", "angle"),
        ("g", "m/s2"),
        ("N.m/A", "N.m"),
    ],
)
def test_wrong_dimension_is_refused_with_unit_and_channel(unit: str, kind: str) -> None:
    with pytest.raises(InputError) as caught:
        check_unit(unit, kind, channel="motor_current")
    assert repr(unit) in str(caught.value)
    assert "motor_current" in str(caught.value)


@pytest.mark.parametrize(
    "unit", ["furlong", "", "m^x", "(m", "m)", "N.m/rad.s", "m..s", "/s", "7", "Nm rad"]
)
def test_unreadable_unit_is_refused(unit: str) -> None:
    with pytest.raises(InputError):
        base_unit(unit)


def test_radian_is_free_where_mass_enters() -> None:
    check_unit("N.m", "stiffness")
    check_unit("N.m.s", "damping")


def test_every_quantity_is_si() -> None:
    for unit in QUANTITIES.values():
        base = base_unit(unit)
        assert (base.factor, base.offset) == (1.0, 0.0)
