"""What somebody else's model description says: declared types, bounds, arrays, and what is wrong
with it, in one line.
"""

from __future__ import annotations

import math
import re
import tomllib
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from identification.data.joint_file import load_joint
from identification.errors import InputError
from irj_fmu.first_joint import first_joint
from irj_fmu.host.fmu import Fmu, FmuError
from irj_fmu.imported.file import load_user_joint
from irj_fmu.imported.fit import fit
from irj_fmu.imported.library import NAMED, UserFmu
from irj_fmu.imported.model import load_user_model
from tests.user_fmus.make import Make, build, build_state_space
from tests.user_fmus.makes import CS
from tests.user_fmus.records import axis

Change = Callable[[str], str]
INERTIA = '<Real start="2.0"/>'
TYPES = (
    '<UnitDefinitions><Unit name="deg"><BaseUnit rad="1" factor="0.017453292519943295"/></Unit>'
    '<Unit name="kg.m2"/></UnitDefinitions><TypeDefinitions>'
    '<SimpleType name="Angle"><Real quantity="Angle" unit="deg"/></SimpleType>'
    '<SimpleType name="Inertia"><Real unit="kg.m2" min="0.5" max="1.5"/></SimpleType>'
    "</TypeDefinitions>"
)


def swapped(old: str, new: str) -> Change:
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new)

    return change


def described(source: Path, change: Change, name: str = "changed") -> Path:
    """The same FMU with another description."""
    out = source.with_name(f"{name}.fmu")
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(out, "w") as new:
        for entry in old.namelist():
            content = old.read(entry)
            if entry == "modelDescription.xml":
                content = change(content.decode()).encode()
            new.writestr(entry, content)
    return out


def axis_fmu(folder: Path, change: Change, version: int = 2) -> Path:
    return described(build("Axis", folder, Make(version, CS)), change)


def typed(text: str) -> str:
    """Units and bounds stand in declared types, as tools of Modelica write them."""
    text = text.replace("<ModelVariables>", f"{TYPES}<ModelVariables>")
    text = text.replace(INERTIA, '<Real declaredType="Inertia" start="1.0"/>')
    return text.replace("<Real />", '<Real declaredType="Angle"/>', 1)


def test_a_unit_and_bounds_of_the_declared_type_hold(tmp_path: Path) -> None:
    path = axis_fmu(tmp_path, typed)
    written = tmp_path / "first.toml"
    written.write_text(first_joint(path, axis(seconds=1.0)))
    model = load_user_joint(written)
    (angle,) = model.outputs
    assert (angle.variable, angle.scale) == ("angle", pytest.approx(180 / math.pi))
    inertia = next(p for p in model.parameters if p.name == "inertia")
    assert (inertia.low, inertia.high) == (0.5, 1.5)
    assert Fmu(path).variables["angle"].unit == "deg"  # batch and the other hosts read it, too


BOUNDED = swapped(INERTIA, '<Real start="2.0" min="1.5" max="2.5"/>')


@pytest.mark.parametrize(
    ("entry", "wanted"),
    [
        ("{}", (1.5, 2.5)),
        ("{ low = 1.9 }", (1.9, 2.5)),
        ("{ high = 2.1 }", (1.5, 2.1)),
        ("{ low = 0.1, high = 10.0 }", (0.1, 10.0)),
    ],
)
def test_bounds_that_a_joint_file_leaves_out_are_those_of_the_fmu(
    tmp_path: Path, entry: str, wanted: tuple[float, float]
) -> None:
    axis_fmu(tmp_path, BOUNDED)
    joint = tmp_path / "user.toml"
    joint.write_text(
        '[joint]\nname = "a"\n[model]\nfmu = "changed.fmu"\n[model.channels]\n'
        'motor_torque = "torque"\nmotor_position = "angle"\n[model.parameters]\n'
        f"inertia = {entry}\n"
    )
    (found,) = load_user_joint(joint).parameters
    assert (found.low, found.high) == wanted


def test_a_name_with_a_zero_character_is_no_name(tmp_path: Path) -> None:
    joint = tmp_path / "user.toml"
    joint.write_text('[joint]\nname = "a"\n[model]\nfmu = "a\\u0000b"\n')
    with pytest.raises(InputError, match="is not the name of an FMU"):
        load_user_joint(joint)
    with pytest.raises(InputError, match="not the name of a file"):
        load_joint(tmp_path / "a\0b")


def test_a_fit_stays_within_the_bounds_of_the_fmu(tmp_path: Path) -> None:
    """The true inertia is 2.5."""
    model = load_user_model(
        axis_fmu(tmp_path, swapped(INERTIA, '<Real start="2.0" min="1.5" max="2.2"/>')),
        {"motor_torque": "torque", "motor_position": "angle"},
        {"inertia": (None, None)},
        start={"q": "motor_position", "w": "motor_velocity"},
        window=0.5,
    )
    assert fit(model, axis(seconds=2.0, h=4e-3)).values["inertia"] == pytest.approx(2.2)


@pytest.mark.parametrize(
    ("real", "said"),
    [
        ('start="INF"', "# inertia: starts at inf and says no bounds"),
        ('start="NaN"', "# inertia: starts at nan and says no bounds"),
        ('start="1e308"', "# inertia: starts at 1e+308 and says no bounds"),
        ('start="2.0" min="5" max="1"', "# inertia: starts at 2 and says bounds 5 to 1"),
        ('start="2.0" min="1.5"', "inertia = { low = 1.5, high = 20 }"),
        ('start="2.0" min="1.5" max="3"', "inertia = {}  # bounds of the FMU"),
        ('start="2.0" min="-INF" max="INF"', "inertia = { low = 0.2, high = 20 }"),
    ],
)
def test_a_first_file_can_be_read_whatever_the_bounds_are(
    tmp_path: Path, real: str, said: str
) -> None:
    path = axis_fmu(tmp_path, swapped(INERTIA, f"<Real {real}/>"))
    text = first_joint(path, axis(seconds=1.0))
    assert said in text
    (tmp_path / "first.toml").write_text(text)
    assert load_user_joint(tmp_path / "first.toml").parameters


def test_a_first_file_can_be_read_whatever_the_names_are(tmp_path: Path) -> None:
    path = axis_fmu(tmp_path, swapped('name="idle"', 'name="a&quot;b&#10;c = 1"'))
    path = described(path, swapped(INERTIA, '<Real start="0.0"/>'), "second")
    path = described(path, swapped('name="inertia"', 'name="J&#10;K = 2"'), "third")
    text = first_joint(path, axis(seconds=1.0))
    assert "# J K = 2: starts at 0 and says no bounds" in text
    assert set(tomllib.loads(text)["model"]["parameters"]) >= {'a"b\nc = 1', "viscous"}


def test_a_state_that_is_compared_is_started_as_well(tmp_path: Path) -> None:
    """No outputs: its local variables are compared, and the position among them is a state."""
    path = axis_fmu(tmp_path, lambda text: text.replace('causality="output"', 'causality="local"'))
    (tmp_path / "first.toml").write_text(first_joint(path, axis(seconds=1.0)))
    model = load_user_joint(tmp_path / "first.toml")
    found = {m.variable: (m.channel, m.scale) for m in model.starts}
    assert found == {"q": ("motor_position", 1.0), "w": ("motor_velocity", 1.0)}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (swapped('modelIdentifier="Axis"', 'modelIdentifier="Axes"'), "holds no library"),
        (lambda text: re.sub('guid="[^"]*"', 'guid="x"', text), "cannot be instantiated as Axis"),
        (swapped('valueReference="41"', 'valueReference="999"'), "refuses to give angle"),
    ],
)
def test_an_fmu_that_does_not_run_gets_no_first_file(
    tmp_path: Path, change: Change, said: str
) -> None:
    with pytest.raises((FmuError, InputError), match=said):
        first_joint(axis_fmu(tmp_path, change), axis(seconds=1.0))


WRONG = {
    "no version": (
        2,
        swapped(' fmiVersion="2.0"', ""),
        "lacks something, or refers to what is not",
    ),
    "no such output": (
        2,
        swapped('<Outputs><Unknown index="11"/>', '<Outputs><Unknown index="1100"/>'),
        "lacks something, or refers to what is not there: IndexError",
    ),
    "no such size": (
        3,
        lambda text: re.sub(
            '(<Float64 name="angle"[^>]*)/>', r'\1><Dimension valueReference="7"/></Float64>', text
        ),
        "lacks something, or refers to what is not there: KeyError, 7",
    ),
    "two start values": (
        3,
        swapped('start="2.0"', 'start="2.0 3.0"'),
        "'2.0 3.0' of inertia is not",
    ),
    "an empty start value": (3, swapped('start="2.0"', 'start=""'), "'' of inertia is not one"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_description_is_one_line(tmp_path: Path, case: str) -> None:
    version, change, said = WRONG[case]
    with pytest.raises(InputError, match=said) as caught:
        UserFmu(axis_fmu(tmp_path, change, version))
    assert "\n" not in str(caught.value)


def test_a_long_reason_is_cut(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        UserFmu(axis_fmu(tmp_path, swapped("<Real />", f'<Real unit="{"m*" * 20000}s"/>')))
    assert len(str(caught.value)) < len(str(tmp_path)) + 500


def sized(count: int) -> Change:
    """Angle and speed as arrays."""
    shape = f'><Dimension start="{count}"/></Float64>'
    return lambda text: re.sub('(<Float64 name="(angle|speed)"[^>]*)/>', rf"\1{shape}", text)


def test_elements_of_arrays_are_mapped_and_no_whole_array(tmp_path: Path) -> None:
    """Of an array the library gives as many values as it holds, which are one here."""
    text = first_joint(axis_fmu(tmp_path, sized(1), 3), axis(seconds=1.0))
    assert '{ variable = "angle[1]", scale = 1.0 }' in text
    assert '"angle"' not in text


@pytest.mark.parametrize("count", [0, NAMED + 1, 10**12])
def test_an_array_without_elements_or_with_very_many(tmp_path: Path, count: int) -> None:
    path = axis_fmu(tmp_path, sized(count), 3)
    with pytest.raises(InputError, match=f"its {count} elements are no signals"):
        load_user_model(path, {"motor_torque": "torque", "motor_position": "angle"})
    assert '"angle' not in first_joint(path, axis(seconds=1.0))


def test_start_values_of_an_array_are_counted(tmp_path: Path) -> None:
    fewer = swapped('start="0 1 -4 -0.5"', 'start="0 1 -4"')
    with pytest.raises(InputError, match="A has 4 elements and 3 start values"):
        UserFmu(described(build_state_space(tmp_path, CS), fewer))


def test_a_state_of_very_many_elements_is_refused(tmp_path: Path) -> None:
    many = swapped(
        'name="n" valueReference="2" causality="structuralParameter" variability="fixed" start="2"',
        'name="n" valueReference="2" causality="structuralParameter" variability="fixed" '
        'start="100000"',
    )
    path = described(build_state_space(tmp_path, CS), many)
    with pytest.raises(InputError, match="holds 100000 states"):
        UserFmu(path)
