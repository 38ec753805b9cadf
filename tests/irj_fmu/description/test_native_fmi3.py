"""The native estimator as FMI 3.0: the numbers of the FMI 2.0 one, in arrays and enumerations."""

from __future__ import annotations

import sys
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy import extract, instantiate_fmu, read_model_description
from fmpy.validation import validate_fmu

from casadi_models.simulate import simulate
from identification.online.options import OnlineOptions
from identification.online.verdict import FAULT_TEXT
from irj_fmu.estimator.native import NativeSpec, build_native
from irj_fmu.estimator.native_fmi3 import build_native_fmi3, fault_names, slots
from irj_fmu.fmi.variables import Variable
from irj_fmu.plant.fmi3 import build_plant_fmi3
from irj_fmu.plant.joint import PlantOptions, plant_spec
from irj_fmu.plant.reference import reference_joint

STEP = 1e-3
COUNT = 3000
INPUTS = ("i_m", "q_m", "w_m", "q_l", "w_l", "tau_l")


@pytest.fixture(scope="module")
def fmus(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    folder = tmp_path_factory.mktemp("native")
    spec = NativeSpec(reference_joint("hd3"), "native", OnlineOptions(warm_up=0.4))
    return {
        2: build_native(spec, folder / "2.fmu"),
        3: build_native_fmi3(spec, folder / "3.fmu"),
    }


@pytest.fixture(scope="module")
def readings() -> np.ndarray:
    """Readings of the joint with noise; its link encoder slips at half time, (COUNT, 6)."""
    joint = reference_joint("hd3")
    t = STEP * np.arange(COUNT)
    drive = 160 * np.sin(2 * np.pi * 0.9 * t) + 60 * np.sin(2 * np.pi * 2.1 * t + 1)
    found = simulate(joint.model(), drive, STEP).readings[:COUNT]
    table = np.column_stack([drive / (joint.torque_per_current or 1.0), found])
    table[:, 1:3] *= joint.gear_ratio
    noise = np.random.default_rng(5).normal(size=table.shape)
    made: np.ndarray = table + noise * np.array([2e-3, 3e-4, 0.1, 2e-6, 1e-3, 0.05])
    made[COUNT // 2 :, 3] += 0.02
    return made


class Estimator:
    """An instance of either version and its outputs by name."""

    def __init__(self, path: Path) -> None:
        self.description = read_model_description(str(path))
        self.three = self.description.fmiVersion.startswith("3")
        # a folder as another user may have it
        folder = Path(tempfile.mkdtemp(dir=path.parent)) / "Größe und Maß #1"
        extract(str(path), str(folder))
        self.fmu: Any = instantiate_fmu(str(folder), self.description, "CoSimulation")
        self.at = {v.name: v for v in self.description.modelVariables}
        if not self.three:
            self.fmu.setupExperiment(startTime=0.0)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()

    def step(self, k: int, row: np.ndarray) -> None:
        references = [self.at[name].valueReference for name in INPUTS]
        (self.fmu.setFloat64 if self.three else self.fmu.setReal)(references, row.tolist())
        self.fmu.doStep(currentCommunicationPoint=k * STEP, communicationStepSize=STEP)

    def array(self, name: str, count: int) -> list[float]:
        if self.three:
            found = self.fmu.getFloat64([self.at[name].valueReference], nValues=count)
            return list(found)
        parts = [self.at[f"{name}[{i}]"].valueReference for i in range(1, count + 1)]
        return list(self.fmu.getReal(parts))

    def outputs(self) -> np.ndarray:
        get = {
            "Real": "getReal",
            "Integer": "getInteger",
            "Boolean": "getBoolean",
            "Float64": "getFloat64",
            "Int32": "getInt32",
            "Enumeration": "getInt64",
        }
        found: list[float] = []
        for v in self.description.modelVariables:
            if v.causality != "output":
                continue
            if v.dimensions:
                found += self.array(v.name, v.dimensions[0].start)
            else:
                name = get[v.type] if v.type != "Boolean" or not self.three else "getBoolean"
                found += [float(x) for x in getattr(self.fmu, name)([v.valueReference])]
        return np.array(found)


@pytest.fixture
def pair(fmus: dict[int, Path]) -> Iterator[tuple[Estimator, Estimator]]:
    made = Estimator(fmus[2]), Estimator(fmus[3])
    yield made
    for estimator in made:
        estimator.fmu.terminate()
        estimator.fmu.freeInstance()


def test_every_output_equals_that_of_fmi_2(
    pair: tuple[Estimator, Estimator], readings: np.ndarray
) -> None:
    faults, first = set(), pair[1].outputs()
    for k, row in enumerate(readings):
        for estimator in pair:
            estimator.step(k, row)
        if k % 10 == 9:
            two, three = (estimator.outputs() for estimator in pair)
            np.testing.assert_allclose(three, two, rtol=1e-12, atol=0.0)
            faults.add(pair[1].fmu.getInt64([pair[1].at["fault"].valueReference])[0])
    assert faults >= {0, fault_names()["q_l_failed"]}
    assert not np.array_equal(pair[1].outputs(), first)


def test_it_is_valid_with_arrays_and_enumerations(fmus: dict[int, Path]) -> None:
    assert validate_fmu(str(fmus[3])) == []
    found = {v.name: v for v in read_model_description(str(fmus[3])).modelVariables}
    old = {v.name for v in read_model_description(str(fmus[2])).modelVariables}
    for name in ("theta", "sigma", "fault_score"):
        assert found[name].dimensions[0].start == sum(n.startswith(f"{name}[") for n in old)
    for name in ("health", "fault"):
        assert found[name].type == "Enumeration"
        assert found[name].declaredType.name == name.capitalize()
    assert "motor_inertia" in found["theta"].description
    assert "[kg.m2]" in found["theta"].description


@pytest.mark.parametrize("version", [2, 3])
def test_no_file_holds_a_path_of_the_builder(version: int, fmus: dict[int, Path]) -> None:
    project = Path(__file__).resolve().parents[3]
    mine = {str(p) for p in (project, fmus[version].parent, Path(sys.prefix))}
    with zipfile.ZipFile(fmus[version]) as archive:
        for name in archive.namelist():
            content = archive.read(name)
            for text in sorted(mine):
                assert text.encode() + b"/" not in content, (name, text)


def test_every_code_of_the_documentation_has_a_name() -> None:
    import re

    spans = re.findall(r"(\d+)(?: to (\d+))?", FAULT_TEXT)
    told = {k for a, b in spans for k in range(int(a), int(b or a) + 1)}
    assert set(fault_names().values()) == told


def test_elements_in_a_row_become_one_array() -> None:
    variables = [Variable(n) for n in ("a", "b[1]", "b[2]", "c[1]", "d")]
    found = [(s.name, s.reference, len(s.parts), s.is_array) for s in slots(variables)]
    assert found == [
        ("a", 0, 1, False),
        ("b", 1, 2, True),
        ("c", 3, 1, True),
        ("d", 4, 1, False),
    ]


def test_terminals_of_plant_and_estimator_fit(fmus: dict[int, Path], tmp_path: Path) -> None:
    """By the schema, and member by member: one line in a host connects the two."""
    import fmpy
    from lxml import etree

    schema = etree.XMLSchema(
        file=str(Path(fmpy.__file__).parent / "schema" / "fmi3" / "fmi3TerminalsAndIcons.xsd")
    )
    spec = plant_spec(reference_joint("hd3"), PlantOptions(name="plant"))
    members = []
    for path in (fmus[3], build_plant_fmi3(spec, tmp_path / "plant.fmu")):
        with zipfile.ZipFile(path) as archive:
            root = etree.fromstring(archive.read("terminalsAndIcons/terminalsAndIcons.xml"))
        schema.assertValid(root)
        names = {v.name for v in read_model_description(str(path)).modelVariables}
        nodes = root.findall("Terminals/Terminal/TerminalMemberVariable")
        assert {node.get("variableName") for node in nodes} <= names
        members.append({node.get("memberName") for node in nodes})
    assert members[0] == members[1]
    assert len(members[0]) == 6


def test_state_is_kept_and_wrong_calls_are_refused(
    fmus: dict[int, Path], readings: np.ndarray
) -> None:
    from fmpy.fmi1 import FMICallException

    one = Estimator(fmus[3])
    for k in range(600):
        one.step(k, readings[k])
    state = one.fmu.getFMUState()
    kept = one.fmu.serializeFMUState(state)
    for k in range(600, 900):
        one.step(k, readings[k])
    expected = one.outputs()
    one.fmu.freeFMUState(state)
    state = one.fmu.deserializeFMUState(kept)
    one.fmu.setFMUState(state)
    assert not np.array_equal(one.outputs(), expected)
    for k in range(600, 900):
        one.step(k, readings[k])
    np.testing.assert_array_equal(one.outputs(), expected)
    theta = one.at["theta"].valueReference
    for wrong in (
        lambda: one.fmu.getFloat64([theta], nValues=3),
        lambda: one.fmu.getFloat64([theta + 1]),
        lambda: one.fmu.getInt32([theta]),
        lambda: one.fmu.getInt32([one.at["fault"].valueReference]),
        lambda: one.fmu.enterInitializationMode(),
    ):
        with pytest.raises(FMICallException):
            wrong()
    one.fmu.freeFMUState(state)
    one.fmu.terminate()
    one.fmu.freeInstance()
