"""A user's own effect is an effect like any other, through every door; its code runs only where
the user allowed it.
"""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from casadi_models import EFFECTS
from casadi_models.child import trial
from casadi_models.child.trial import EffectFileError
from identification import load_joint
from identification.data.own_effects import STORE, register
from identification.errors import InputError
from workbench.cli.main import main

DEMO = Path(__file__).resolve().parents[3] / "workbench" / "demo"
KEY = "rubbing_seal"
OWN = """
import casadi as ca
from casadi_models import amplitude, effect, shape


@effect("rubbing_seal", title="rubbing shaft seal", family="friction", acts_on=("motor", "link"),
        parameters=(amplitude("seal_torque", "N.m", "torque where it rubs most", typical=9.0),
                    shape("seal_width", "rad", "half the angle over which it rubs",
                          (0.1, 0.2, 0.4), "position",
                          start=0.2, low=0.01, high=3.0, typical=0.15)),
        absence="friction in one sector", excitation="a slow turn in both directions",
        source="this test",
        dissipative=True, needs=("coulomb",), confused_with=("cyclic_friction",),
        separate_by="a run through less than the sector")
def rubbing_seal(s, p):
    return p.seal_torque * ca.exp(-((s.position / p.seal_width) ** 2)) * s.direction
"""


def forget() -> None:
    """As in a new process: the file was never loaded."""
    for path, found in list(EFFECTS._loaded.items()):
        if KEY in found.keys:
            del EFFECTS._loaded[path]
    EFFECTS._effects.pop(KEY, None)


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv(STORE, str(tmp_path / "state" / "allowed.txt"))
    path = tmp_path / "seal.py"
    path.write_text(OWN)
    yield path
    forget()


@pytest.fixture
def joint(own: Path, tmp_path: Path) -> Path:
    """A joint file with the effect in it, as `irj add` writes it, in a process that has not
    loaded the effect.
    """
    made = tmp_path / "joint.toml"
    assert (
        main(
            [
                "--effects",
                str(own),
                "add",
                f"{KEY}@motor",
                "--joint",
                str(DEMO / "joint.toml"),
                "-o",
                str(made),
            ]
        )
        == 0
    )
    forget()
    return made


def said(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The one line with which irj refuses."""
    capsys.readouterr()
    assert main(list(words)) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def test_a_joint_file_loads_the_file_it_remembers(joint: Path, own: Path) -> None:
    text = joint.read_text()
    assert re.search(
        rf'"{re.escape(str(own))}" = {{ sha256 = "[0-9a-f]{{64}}", keys = \["{KEY}"\] }}', text
    )
    assert KEY not in EFFECTS
    assert f"{KEY}@motor" in load_joint(joint).model().effects
    assert KEY in EFFECTS


def test_a_joint_file_without_own_effects_has_no_such_table(own: Path, tmp_path: Path) -> None:
    made = tmp_path / "plain.toml"
    assert (
        main(
            [
                "--effects",
                str(own),
                "add",
                "stribeck",
                "--joint",
                str(DEMO / "joint.toml"),
                "-o",
                str(made),
            ]
        )
        == 0
    )
    assert "own_effects" not in made.read_text()


def test_the_file_is_found_beside_a_joint_file_that_was_moved(
    joint: Path, own: Path, tmp_path: Path
) -> None:
    other = tmp_path / "elsewhere"
    other.mkdir()
    own.rename(other / own.name)
    joint.rename(other / joint.name)
    assert f"{KEY}@motor" in load_joint(other / joint.name).model().effects


def test_code_that_was_never_allowed_here_does_not_run(
    joint: Path,
    own: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    trace = tmp_path / "it_ran"
    own.write_text(OWN + f"\nopen({str(trace)!r}, 'w').close()\n")
    assert (
        main(
            [
                "--effects",
                str(own),
                "add",
                f"{KEY}@motor",
                "--joint",
                str(DEMO / "joint.toml"),
                "-o",
                str(joint),
            ]
        )
        == 0
    )
    forget()
    trace.unlink()
    monkeypatch.setenv(STORE, str(tmp_path / "another_machine.txt"))
    command = ("simulate", "--joint", str(joint), "--seconds", "1", "-o", str(tmp_path / "r.csv"))
    line = said(capsys, *command)
    assert "never allowed on this machine" in line
    assert f"--effects {own}" in line
    assert not trace.exists()
    assert KEY not in EFFECTS
    assert main([*command, "--effects", str(own)]) == 0
    assert trace.exists()
    forget()
    assert main(list(command)) == 0


def test_code_that_has_changed_is_asked_for(
    joint: Path, own: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own.write_text(OWN.replace("** 2", "** 4"))
    command = ("simulate", "--joint", str(joint), "--seconds", "1", "-o", str(tmp_path / "r.csv"))
    line = said(capsys, *command)
    assert "its content has changed" in line
    assert f"--effects {own}" in line
    assert main([*command, "--effects", str(own)]) == 0


def test_the_doors_to_fmi_take_the_file_too(
    joint: Path, own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(STORE, str(tmp_path / "another_machine.txt"))
    assert (
        main(
            [
                "export",
                "casadi",
                "--joint",
                str(joint),
                "--effects",
                str(own),
                "--out",
                str(tmp_path / "code"),
            ]
        )
        == 0
    )
    names = [p["name"] for p in json.loads((tmp_path / "code" / "parameters.json").read_text())]
    assert "motor_seal_width" in names


def test_a_file_that_is_gone_and_a_table_that_is_none(joint: Path, own: Path) -> None:
    own.unlink()
    with pytest.raises(
        InputError, match=r"effect file .*seal.py is not there; give the file with --effects"
    ):
        load_joint(joint)
    joint.write_text(f'[joint]\ngear_ratio = 2.0\n[own_effects]\n"{KEY}.py" = "abc"\n')
    with pytest.raises(InputError, match=r"must be a table, as"):
        load_joint(joint)


def test_an_effect_that_names_an_unknown_one_is_refused_as_a_whole(
    own: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own.write_text(OWN.replace('needs=("coulomb",)', 'needs=("culomb",)'))
    assert "names 'culomb', which is not in the library" in said(
        capsys, "--effects", str(own), "effects"
    )
    assert KEY not in EFFECTS


@pytest.mark.parametrize(
    ("code", "why"),
    [
        ("import os; os._exit(0)", "it ends the process that runs it: exit code 0"),
        (
            "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)",
            "it ends the process that runs it: SIGSEGV",
        ),
        ("while True: pass", "it takes more than 1.2 s"),
        ("raise KeyboardInterrupt", "KeyboardInterrupt"),
        (
            OWN.replace("    return p.", "    import os; os._exit(0)\n    return p."),
            "it ends the process that runs it: exit code 0",
        ),
    ],
)
def test_a_file_that_ends_its_process_is_one_line(
    code: str, why: str, own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trial, "SECONDS", 1.2 if "while" in code else trial.SECONDS)
    own.write_text(code)
    with pytest.raises(InputError) as refused:
        register(own)
    assert str(refused.value) == f"{own}: cannot be used as effects ({why})"


def test_an_interrupt_is_the_users_only_where_it_was_pressed(own: Path) -> None:
    """Where a file that was tried before is run at once."""
    with pytest.raises(EffectFileError, match="KeyboardInterrupt"):
        EFFECTS.load_code(own, b"raise KeyboardInterrupt", tried=True)
    pressed = b"import os, signal; os.kill(os.getpid(), signal.SIGINT); [0 for _ in range(9)]"
    with pytest.raises(KeyboardInterrupt):
        EFFECTS.load_code(own, pressed, tried=True)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_file_is_tried_once_for_its_content(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    register(own)
    forget()
    monkeypatch.setattr(trial, "Child", None)  # no other process is started
    assert register(own).keys == (KEY,)
    monkeypatch.setattr(trial, "_GOOD", set())
    assert register(own).keys == (KEY,)  # the machine knows it
    with pytest.raises(TypeError, match="not callable"):
        EFFECTS.load(own)


def test_a_file_may_name_an_effect_of_one_that_was_loaded_before(own: Path, tmp_path: Path) -> None:
    register(own)
    other = tmp_path / "other.py"
    other.write_text(OWN.replace(KEY, "other_seal").replace('("coulomb",)', f'("{KEY}",)'))
    try:
        assert EFFECTS.load(other) == ("other_seal",)
    finally:
        EFFECTS._loaded.pop(other.resolve(), None)
        EFFECTS._effects.pop("other_seal", None)
