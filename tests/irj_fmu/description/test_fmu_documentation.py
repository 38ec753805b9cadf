"""What stands in an FMU beside its model: who made it, what it depends on, its documentation."""

from __future__ import annotations

import re
import zipfile
import zlib
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from fmpy import read_model_description
from fmpy.validation import validate_fmu

from irj_fmu.estimator.native import NativeSpec, build_native
from irj_fmu.fmi.documentation import SIZE
from irj_fmu.fmi.unit_definitions import quantity_of
from irj_fmu.imported.library import UserFmu, UserInstance
from irj_fmu.plant.fmi3 import build_plant_fmi3
from irj_fmu.plant.joint import PlantOptions, plant_spec
from irj_fmu.plant.library import build_plant, dependencies
from irj_fmu.plant.reference import reference_joint
from tests.irj_fmu.test_fmu_package import pack

KINDS = ("plant 2", "plant 3", "native", "slave")


@pytest.fixture(scope="module")
def fmus(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("fmus")
    joint = reference_joint("hd3")
    spec = plant_spec(joint, PlantOptions(name="plant", sensors=True))
    return {
        "plant 2": build_plant(spec, folder / "2.fmu"),
        "plant 3": build_plant_fmi3(spec, folder / "3.fmu"),
        "native": build_native(NativeSpec(joint, "native"), folder / "native.fmu"),
        "slave": pack(folder, name="slave.fmu").path,
    }


class _Links(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.links: list[str] = []
        self.cells: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag != "meta":
            self.open.append(tag)
        self.links += [value for key, value in attrs if key == "href" and value]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "td":
            self.cells.append(data)


@pytest.mark.parametrize("kind", KINDS)
def test_it_says_who_made_it_and_validates(kind: str, fmus: dict[str, Path]) -> None:
    assert validate_fmu(str(fmus[kind])) == []
    found = read_model_description(str(fmus[kind]))
    for key in ("author", "version", "copyright", "license", "generationTool"):
        assert getattr(found, key), key
    assert found.defaultExperiment.stepSize


@pytest.mark.parametrize("kind", KINDS)
def test_its_documentation_lists_every_variable_and_its_links_lead_somewhere(
    kind: str, fmus: dict[str, Path]
) -> None:
    with zipfile.ZipFile(fmus[kind]) as archive:
        names = archive.namelist()
        page = _Links()
        page.feed(archive.read("documentation/index.html").decode())
    assert page.open == []
    assert page.links
    assert all(f"documentation/{link}" in names for link in page.links)
    variables = read_model_description(str(fmus[kind])).modelVariables
    missing = {v.name for v in variables if v.causality != "independent"} - set(page.cells)
    assert missing == set()


@pytest.mark.parametrize("kind", KINDS)
def test_its_icon_is_a_picture(kind: str, fmus: dict[str, Path]) -> None:
    place = "terminalsAndIcons/icon.png" if kind == "plant 3" else "model.png"
    with zipfile.ZipFile(fmus[kind]) as archive:
        content = archive.read(place)
    assert content[:8] == b"\x89PNG\r\n\x1a\n"
    length = int.from_bytes(content[33:37], "big")
    assert len(zlib.decompress(content[41 : 41 + length])) == SIZE * (4 * SIZE + 1)


def test_quantities_tell_torque_from_energy_and_rotary_from_linear() -> None:
    told = {"N.m": "Torque", "rad/s": "AngularVelocity", "N.m/rad": "Stiffness", "N": "Force"}
    told |= {"N/m": "Stiffness", "kg.m2": "Inertia", "kg": "Mass", "A": "Current"}
    assert {unit: quantity_of(unit) for unit in told} == told
    assert quantity_of("J") is None
    assert quantity_of("1") is None


@pytest.mark.parametrize("kind", ["plant 2", "plant 3"])
def test_what_is_no_dependency_has_no_influence(kind: str, fmus: dict[str, Path]) -> None:
    """Each output and derivative, measured: it moves with nothing that is not in its list."""
    with zipfile.ZipFile(fmus[kind]) as archive:
        root = ElementTree.fromstring(archive.read("modelDescription.xml"))
    by_index = kind == "plant 2"
    names = {
        str(i if by_index else v.attrib["valueReference"]): v.attrib["name"]
        for i, v in enumerate(root.iterfind("ModelVariables/*"), 1)
    }
    structure = root.find("ModelStructure")
    assert structure is not None
    listed = {
        names[node.attrib["index" if by_index else "valueReference"]]: {
            names[k] for k in node.attrib["dependencies"].split()
        }
        for node in structure.iter()
        if "dependencies" in node.attrib
    }
    spec = plant_spec(reference_joint("hd3"), PlantOptions(name="plant", sensors=True))
    unknowns = [*(f"der({v.name})" for v in spec.states), *(v.name for v in spec.outputs)]
    assert sorted(listed) == sorted(unknowns)
    generator = np.random.default_rng(5)
    with UserInstance(UserFmu(fmus[kind]), "me") as instance:
        block = instance.block(unknowns)
        state = 0.1 * generator.standard_normal(len(spec.states))
        instance.begin(0.0)
        instance.ready()
        moving = [*(v.name for v in spec.parameters), *(v.name for v in spec.inputs)]
        seen: dict[str, set[str]] = {name: set() for name in unknowns}

        def values() -> np.ndarray:
            instance.slope(0.0, state)
            return np.array(instance.read(block))

        for name in moving:
            one = instance.block([name])
            before, old = values(), np.array(instance.read(one))
            one.array[:] = old * 1.1 + 0.01
            instance.write(one)
            for unknown in np.flatnonzero(values() != before):
                seen[unknowns[unknown]].add(name)
            one.array[:] = old
            instance.write(one)
        for i, variable in enumerate(spec.states):
            before = values()
            state[i] += 0.01
            for unknown in np.flatnonzero(values() != before):
                seen[unknowns[unknown]].add(variable.name)
            state[i] -= 0.01
    assert sum(map(len, seen.values())) > 3 * len(unknowns)
    for name in unknowns:
        assert seen[name] <= listed[name], name


def test_a_position_reading_has_no_direct_feedthrough() -> None:
    """What a host needs to see that plant and controller form no algebraic loop."""
    spec = plant_spec(reference_joint("hd3"), PlantOptions(name="plant"))
    _, readings = dependencies(spec)
    at = [v.name for v in spec.outputs].index("motor_position")
    states, others = readings[at]
    assert states
    assert all(i >= len(spec.inputs) for i in others)


def test_the_licence_names_what_is_inside(fmus: dict[str, Path]) -> None:
    with zipfile.ZipFile(fmus["slave"]) as archive:
        found = {n for n in archive.namelist() if n.startswith("documentation/licenses/")}
        text = archive.read("documentation/licenses/pythonfmu.txt").decode()
    assert found == {"documentation/licenses/license.txt", "documentation/licenses/pythonfmu.txt"}
    assert re.search("Permission|licen", text)
