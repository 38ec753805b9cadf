"""`irj`: what its verbs print, write and return."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from casadi_models import EFFECTS, JointModel
from identification import load_joint, read
from identification.data.typical import true_values
from identification.faults.bank import WAITS
from tests.workbench.test_outputs import given
from workbench.cli import files as outputs
from workbench.cli import loop
from workbench.cli.first.help import EXAMPLES
from workbench.cli.main import main, parser
from workbench.cli.online import fault_text
from workbench.show.words import untested_lines

ROOT = Path(__file__).resolve().parents[2]
DEMO = Path(str(files("workbench"))) / "demo"
HIDDEN = "stribeck"
"""What the demo's records hide; this test is the only reader that is told."""


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the results of one run of the demo's job, and of a fit of the start model."""
    folder = tmp_path_factory.mktemp("demo")
    command = [
        "improve",
        str(DEMO / "train.npz"),
        "--held-out",
        str(DEMO / "held_out.npz"),
        "--joint",
        str(DEMO / "joint.toml"),
    ]
    command += [
        "--json",
        str(folder / "result.json"),
        "--report",
        str(folder / "report.html"),
        "-o",
        str(folder / "better.toml"),
    ]
    with (folder / "out.txt").open("w") as out:
        done = subprocess.run(
            [sys.executable, "-m", "workbench", *command],
            cwd=ROOT,
            stdout=out,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    (folder / "err.txt").write_text(done.stderr)
    assert done.returncode == 0, done.stderr
    return folder


def data(folder: Path, name: str = "result.json") -> Any:
    return json.loads((folder / name).read_text())


# --- the main job ---------------------------------------------------------------------------------


def test_improve_names_what_the_demo_hides_and_the_error_falls(demo: Path) -> None:
    found = data(demo)
    assert found["added"] == [HIDDEN]
    assert found["claims"][0]["effects"] == [HIDDEN]
    assert found["verdict"] == "complete"
    first, last = (s["held_out"] for s in (found["steps"][0], found["steps"][-1]))
    assert last["relative_error_percent"] < 0.5 * first["relative_error_percent"]
    assert first["balances"]["motor"]["ratio"] > 10
    assert last["balances"]["motor"]["ratio"] < 1.5


def test_improve_prints_the_ledger_the_claim_and_the_verdict(demo: Path) -> None:
    text = (demo / "out.txt").read_text()
    found = data(demo)
    lines = text.splitlines()
    start = next(line for line in lines if line.startswith("start model"))
    added = next(line for line in lines if line.startswith(f"+ {HIDDEN}"))
    for line, step in ((start, found["steps"][0]), (added, found["steps"][-1])):
        for part in ("train", "held_out"):
            assert f"{step[part]['relative_error_percent']:.3f}" in line
        for balance, error in step["held_out"]["balances"].items():
            assert f"{balance} {error['ratio']:.3g}" in line
    assert (
        f"missing: {HIDDEN}, motor balance, held-out RMS falls by "
        f"{found['claims'][0]['held_out_drop_percent']:.1f} %" in text
    )
    assert f"not testable ({len(found['not_testable'])}): -v lists them" in text
    assert lines[0] == found["reason"]


def test_no_progress_bar_where_there_is_no_terminal(demo: Path) -> None:
    assert "\r" not in (demo / "err.txt").read_text() + (demo / "out.txt").read_text()


def test_demo_data_are_what_simulate_makes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The commands of docs/guide.md."""
    for name, seconds, seed in (("train", 20, 11), ("held_out", 12, 12)):
        made = tmp_path / f"{name}.npz"
        command = [
            "simulate",
            "--joint",
            str(DEMO / "joint.toml"),
            "--hide",
            HIDDEN,
            "--set",
            "gravity_cosine=0",
            "--seconds",
            str(seconds),
            "--rate",
            "400",
        ]
        assert main([*command, "--seed", str(seed), "-o", str(made)]) == 0
        with np.load(made) as new, np.load(DEMO / f"{name}.npz") as old:
            assert new.files == old.files
            for column in new.files:
                spread = float(np.std(old[column]))
                assert np.sqrt(np.mean((new[column] - old[column]) ** 2)) <= 1e-3 * spread, column
        assert made.stat().st_size < 400_000
    capsys.readouterr()


def test_demo_answer_is_not_in_its_files() -> None:
    assert sorted(p.name for p in DEMO.iterdir()) == ["held_out.npz", "joint.toml", "train.npz"]
    assert HIDDEN not in (DEMO / "joint.toml").read_text().lower()
    for name in ("train.npz", "held_out.npz"):
        with np.load(DEMO / name) as archive:
            assert all(archive[k].ndim == 1 and archive[k].dtype.kind == "f" for k in archive.files)
            assert not any(HIDDEN in k for k in archive.files)


def test_demo_writes_its_report_into_the_current_folder(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-m", "workbench", "demo"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
        env=environment,
    )
    assert f"missing: {HIDDEN}" in done.stdout
    page = (tmp_path / "irj-demo.html").read_text()
    assert page.lower().startswith("<!doctype html>")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["irj-demo.html"]


def test_report_keeps_a_part_of_the_record_back_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target, result = tmp_path / "page.html", tmp_path / "r.json"
    assert (
        main(
            [
                "report",
                *given(tmp_path / "axis"),
                "-o",
                str(target),
                "--json",
                str(result),
            ]
        )
        == 0
    )
    assert "irj report " in target.read_text()
    assert "the last 30 % of each training record" in data(tmp_path, "r.json")["records"]["note"]
    assert str(target) in capsys.readouterr().out


def test_improved_joint_file_is_a_joint_file_with_the_true_values(
    demo: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    better = load_joint(demo / "better.toml")
    assert f"{HIDDEN}@motor" in better.effects
    hidden = JointModel.harmonic_drive(3).add("viscous").add("coulomb").add("gravity").add(HIDDEN)
    truth = true_values(hidden, load_joint(DEMO / "joint.toml"))
    for name in ("stiffness", "motor_inertia", "link_inertia", "gravity_torque"):
        assert better.fitted[name] == pytest.approx(truth[name], rel=0.02), name
    for name in ("motor_stribeck_extra", "motor_stribeck_velocity"):
        assert better.fitted[name] == pytest.approx(truth[name], rel=0.15), name
    result = demo / "compared.json"
    command = [
        "compare",
        str(DEMO / "held_out.npz"),
        "--joint",
        str(demo / "better.toml"),
        "--fit",
        str(DEMO / "train.npz"),
        "--json",
        str(result),
    ]
    assert main(command) == 0
    assert "held_out: fit" in capsys.readouterr().out
    after = data(demo)["steps"][-1]["held_out"]["relative_error_percent"]
    assert data(demo, "compared.json")["relative_error_percent"] == pytest.approx(after, rel=0.05)


def test_what_a_fit_has_written_is_compared_as_it_stands(
    demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Values were fitted anew to the very record that they were to be judged on: a joint file with
    twice the true stiffness was as good as the right one.
    """

    def asked(joint: Path) -> tuple[dict[str, Any], str]:
        command = ["compare", str(DEMO / "held_out.npz"), "--joint", str(joint), "--no-linear"]
        assert main([*command, "--json", str(tmp_path / "compared.json")]) == 0
        return data(tmp_path, "compared.json"), capsys.readouterr().out

    found, said = asked(demo / "better.toml")
    after = data(demo)["steps"][-1]["held_out"]["relative_error_percent"]
    # the clock of the current is read from the held-out record alone here
    assert found["relative_error_percent"] == pytest.approx(after, rel=0.01)
    assert (found["fitted_to"], "as they stand" in said) == ([], True)
    right = (demo / "better.toml").read_text()
    wrong = tmp_path / "wrong.toml"
    wrong.write_text(
        re.sub(r"(?m)^stiffness = \{ value = [\d.]+", "stiffness = { value = 44e3", right)
    )
    other, _ = asked(wrong)
    assert other["balances"]["transmission"]["ratio"] > 20
    motor = found["balances"]["motor"]["ratio"]
    assert other["balances"]["motor"]["ratio"] == pytest.approx(motor, rel=0.02)
    start, said = asked(DEMO / "joint.toml")
    assert (start["fitted_to"], "fitted to these very records" in said) == (["held_out"], True)


def test_fit_prints_values_with_errors_and_writes_a_joint_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "fitted.toml"
    assert (
        main(
            [
                "fit",
                str(DEMO / "train.npz"),
                "--joint",
                str(DEMO / "joint.toml"),
                "-o",
                str(target),
                "--json",
                str(tmp_path / "fit.json"),
            ]
        )
        == 0
    )
    text = capsys.readouterr().out
    found = data(tmp_path, "fit.json")
    assert f"relative error {found['train']['relative_error_percent']:.3f} %" in text
    stiffness = next(line for line in text.splitlines() if line.split()[:1] == ["stiffness"])
    assert "+-" in stiffness
    assert "N.m/rad (link side)" in stiffness
    assert load_joint(target).fitted["stiffness"] == pytest.approx(
        found["parameters"]["stiffness"]["value"], rel=1e-9
    )
    assert "warnings" in found


def test_diagnose_ranks_and_says_what_cannot_be_tested(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [
        "diagnose",
        str(DEMO / "train.npz"),
        "--held-out",
        str(DEMO / "held_out.npz"),
        "--joint",
        str(DEMO / "joint.toml"),
    ]
    assert main([*command, "--json", str(tmp_path / "d.json")]) == 0
    text = capsys.readouterr().out
    found = data(tmp_path, "d.json")
    answer, first, *_ = text.splitlines()
    assert answer == found["reason"]
    assert first.startswith("1. Stribeck effect  -")
    assert f"not testable ({len(found['not_testable'])}): -v lists them" in text
    assert "extra_inertia: " not in text
    assert "\x1b" not in text  # colours are for a terminal
    items = [SimpleNamespace(**n) for n in found["not_testable"]]
    assert "not testable: extra_inertia: " in "\n".join(untested_lines(items, verbose=True))
    assert found["claims"][0]["effects"] == [HIDDEN]
    assert found["ranking"][0]["effect"] == HIDDEN


# --- check ----------------------------------------------------------------------------------------


def test_check_returns_one_for_a_record_that_would_be_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joint = tmp_path / "j.toml"
    joint.write_text((DEMO / "joint.toml").read_text().replace("-160.0", "160.0"))
    assert main(["check", str(DEMO / "train.npz"), "--joint", str(DEMO / "joint.toml")]) == 0
    assert (
        main(
            [
                "check",
                str(DEMO / "train.npz"),
                "--joint",
                str(joint),
                "--json",
                str(tmp_path / "c.json"),
            ]
        )
        == 1
    )
    assert "refuse: train: the positions show a gear ratio of" in capsys.readouterr().out
    assert any(f["severity"] == "refuse" for f in next(iter(data(tmp_path, "c.json").values())))


# --- library --------------------------------------------------------------------------------------


def test_effects_lists_every_effect_and_describes_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["effects"]) == 0
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert set(listed) == set(EFFECTS)
    assert main(["effects", "backlash", "--json", str(tmp_path / "e.json")]) == 0
    text = capsys.readouterr().out
    effect = EFFECTS["backlash"]
    assert effect.absence in text
    assert effect.source in text
    assert data(tmp_path, "e.json")[0]["key"] == "backlash"


OWN = """
import casadi as ca
from casadi_models import effect, signed

@effect("test_seal", title="drag of the seal", family="friction", acts_on=("motor",),
        parameters=(signed("seal_drag", "N.m", "torque of the seal"),),
        absence="a step at zero velocity", excitation="reversals", source="this test",
        candidate=False)
def seal(s, p):
    return p.seal_drag * s.direction
"""


@pytest.fixture
def own_effect(tmp_path: Path) -> Iterator[Path]:
    path = tmp_path / "my_effects.py"
    path.write_text(OWN)
    yield path
    EFFECTS._effects.pop("test_seal", None)


def test_own_effects_from_a_file(
    own_effect: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "more.toml"
    assert (
        main(
            [
                "--effects",
                str(own_effect),
                "add",
                "test_seal",
                "--joint",
                str(DEMO / "joint.toml"),
                "-o",
                str(target),
            ]
        )
        == 0
    )
    assert "test_seal" in load_joint(target).effects
    EFFECTS._effects.pop("test_seal")
    assert (
        main(["fit", str(DEMO / "train.npz"), "--joint", str(target), "--effects", str(own_effect)])
        == 0
    )
    assert "seal_drag" in capsys.readouterr().out


# --- simulate -------------------------------------------------------------------------------------

IN_START_MODEL = {"viscous", "coulomb", "gravity", "transmission_compliance", "structural_damping"}


START_MODEL = load_joint(DEMO / "joint.toml").model()


@pytest.mark.parametrize(
    "key", sorted(k for k in set(EFFECTS) - IN_START_MODEL if not START_MODEL.has_form_of(k))
)
def test_every_effect_can_be_hidden_and_changes_the_record(key: str, tmp_path: Path) -> None:
    tables = []
    for hide in ([], ["--hide", key]):
        target = tmp_path / f"{len(tables)}.npz"
        command = [
            "simulate",
            "--joint",
            str(DEMO / "joint.toml"),
            "--seconds",
            "1.5",
            "--rate",
            "250",
            "-o",
            str(target),
            *hide,
        ]
        assert main([*command, "--truth", str(tmp_path / "truth.json")]) == 0
        tables.append(read(target))
    truth = data(tmp_path, "truth.json")
    assert truth["hidden"] == [key]
    plain, hidden = tables
    change = max(
        float(np.sqrt(np.mean((hidden[c] - plain[c]) ** 2)) / np.std(plain[c]))
        for c in plain.channels
    )
    assert change > 5e-4  # the noise is the same in both: without the effect this is 0


def test_simulated_linear_axis_has_units_of_a_linear_axis(tmp_path: Path) -> None:
    joint = tmp_path / "axis.toml"
    joint.write_text(
        '[joint]\nkind = "linear"\ngear_ratio = 1.0\nmodel = "hd1"\neffects = ["viscous"]\n'
    )
    target = tmp_path / "axis.csv"
    assert (
        main(
            [
                "simulate",
                "--joint",
                str(joint),
                "--hide",
                "coulomb",
                "--seconds",
                "3",
                "--set",
                "motor_inertia=80",
                "-o",
                str(target),
            ]
        )
        == 0
    )
    record = read(target, kind="linear")
    assert set(record.channels) == {"motor_torque", "motor_position", "motor_velocity"}
    assert np.ptp(record["motor_position"]) > 0.1
    assert "motor_torque_N," in target.read_text().splitlines()[0]


@pytest.mark.parametrize(
    ("place", "name", "channel"),
    [
        ("drive", "drive_delay", "motor_current"),
        ("torque_sensor", "torque_sensor_delay", "link_torque"),
    ],
)
def test_late_channel_is_late_by_the_delay(
    place: str, name: str, channel: str, tmp_path: Path
) -> None:
    made = []
    for hide in ([], ["--hide", f"channel_delay@{place}", "--set", f"{name}=0.01"]):
        target = tmp_path / f"{len(made)}.npz"
        assert (
            main(
                [
                    "simulate",
                    "--joint",
                    str(DEMO / "joint.toml"),
                    "--seconds",
                    "4",
                    "--rate",
                    "500",
                    "-o",
                    str(target),
                    *hide,
                ]
            )
            == 0
        )
        made.append(read(target))
    prompt, late = (r[channel][50:] for r in made)
    mismatch = [
        float(np.std(late[20:-20] - prompt[20 - shift : len(prompt) - 20 - shift]))
        for shift in range(10)
    ]
    assert int(np.argmin(mismatch)) == 5
    assert np.array_equal(made[0]["motor_position"], made[1]["motor_position"])


def test_simulation_is_repeated_by_its_seed(tmp_path: Path) -> None:
    made = []
    for seed in ("3", "3", "4"):
        target = tmp_path / f"{len(made)}.csv"
        assert (
            main(
                [
                    "simulate",
                    "--joint",
                    str(DEMO / "joint.toml"),
                    "--seconds",
                    "1",
                    "--seed",
                    seed,
                    "-o",
                    str(target),
                ]
            )
            == 0
        )
        made.append(target.read_bytes())
    assert made[0] == made[1] != made[2]


# --- track and plan -------------------------------------------------------------------------------


def test_track_follows_the_parameters_and_finds_no_fault_in_a_healthy_record(
    demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [
        "track",
        str(DEMO / "held_out.npz"),
        "--joint",
        str(demo / "better.toml"),
        "--healthy",
        str(DEMO / "train.npz"),
    ]
    assert main([*command, "--json", str(tmp_path / "t.json"), "--fail-on-fault"]) == 0
    assert "no sensor fault" in capsys.readouterr().out
    found = data(tmp_path, "t.json")["records"][0]
    fitted = load_joint(demo / "better.toml").fitted
    for name in ("stiffness", "motor_inertia", "link_inertia", "gravity_torque", "motor_coulomb"):
        assert found["parameters"][name]["value"] == pytest.approx(fitted[name], rel=0.05), name
    assert len(found["time"]) == len(found["parameters"]["stiffness"]["history"]) > 10
    assert found["detector"]


def test_track_finds_a_link_sensor_that_fails(
    demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with np.load(DEMO / "held_out.npz") as archive:
        table = {k: archive[k].astype(float) for k in archive.files}
    late = table["time_s"] > 9.0
    table["link_position_rad"] = np.where(
        late, table["link_position_rad"] + 0.05, table["link_position_rad"]
    )
    np.savez(tmp_path / "failed.npz", **table)
    command = [
        "track",
        str(tmp_path / "failed.npz"),
        "--joint",
        str(demo / "better.toml"),
        "--healthy",
        str(DEMO / "train.npz"),
    ]
    assert main([*command, "--json", str(tmp_path / "t.json"), "--fail-on-fault"]) == 1
    capsys.readouterr()
    events = data(tmp_path, "t.json")["records"][0]["events"]
    assert 9.0 <= events[0]["first"] <= 9.2
    assert events[0]["time"] <= events[0]["first"] + WAITS[-1]
    assert events[0]["text"].startswith("link position")


def test_fault_codes_in_words() -> None:
    assert fault_text(4) == "link position: sensor failed"
    assert fault_text(16) == "torque: reading missing"
    assert fault_text(31) == "motor current: reading of wrong scale"
    assert "friction" in fault_text(7)
    assert "joint changed" in fault_text(8)


def test_plan_writes_the_best_motion_of_those_that_keep_the_limits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from identification.planning import trajectories as excite

    few = excite.sinusoidal_grid([0.3, 0.7], [2.0], duration=6.0)
    monkeypatch.setattr(excite, "sinusoidal_grid", lambda: few)
    monkeypatch.setattr(excite, "triangular_grid", lambda limit: [])
    target = tmp_path / "motion.csv"
    command = [
        "plan",
        "--joint",
        str(DEMO / "joint.toml"),
        "-o",
        str(target),
        "--json",
        str(tmp_path / "p.json"),
    ]
    assert main([*command, "--max-speed", "30"]) == 0
    text = capsys.readouterr().out
    assert "1 break the limits" in text
    assert "typical ones were taken" in text
    found = data(tmp_path, "p.json")
    assert found["parameters"]["speed"] == pytest.approx(0.3)
    assert 0 < found["relative_deviation"]["stiffness"] < 0.01
    motion = excite.Motion.load(target)
    assert np.abs(motion.velocity).max() <= np.deg2rad(30)
    assert main([*command, "--max-speed", "1"]) == 2
    assert "no motion keeps the limits (speed)" in capsys.readouterr().err


# --- export ---------------------------------------------------------------------------------------


def test_export_of_the_casadi_functions_gives_the_same_numbers(
    demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import casadi as ca

    assert (
        main(
            [
                "export",
                "casadi",
                "--joint",
                str(demo / "better.toml"),
                "--out",
                str(tmp_path / "out"),
            ]
        )
        == 0
    )
    loaded = ca.Function.load(str(tmp_path / "out" / "dynamics.casadi"))
    model = load_joint(demo / "better.toml").model()
    parameters = json.loads((tmp_path / "out" / "parameters.json").read_text())
    assert [p["name"] for p in parameters] == list(model.parameter_names)
    values = [p["value"] for p in parameters]
    x, u = [0.3, -0.2, 0.301, -0.25], [20.0, 0.0, 0.0]
    assert np.allclose(
        np.array(loaded(x, u, values)),
        np.array(model.dynamics(x, u, model.value_vector())),
        rtol=1e-12,
    )
    capsys.readouterr()
    assert (
        main(["export", "c", "--joint", str(demo / "better.toml"), "--out", str(tmp_path / "out")])
        == 0
    )
    assert "dynamics" in (tmp_path / "out" / "joint.h").read_text()


# --- manners --------------------------------------------------------------------------------------


def test_interrupt_is_one_line_and_130(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(loop, "fit", stop)
    assert main(["fit", str(DEMO / "train.npz"), "--joint", str(DEMO / "joint.toml")]) == 130
    assert capsys.readouterr().err.strip() == "irj: interrupted"


def test_reader_that_has_seen_enough_is_no_error() -> None:
    command = f"{shlex.quote(sys.executable)} -m workbench effects | head -n 1"
    done = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {command}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0
    assert done.stderr == ""


def test_progress_bar_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    outputs.progress_bar("fitting", 0.5)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    outputs.progress_bar("fitting", 0.5)
    outputs.progress_bar("done", 1.0)
    shown = capsys.readouterr().err
    assert "[###############...............] fitting" in shown
    assert shown.endswith("\n")


def test_old_result_stays_where_the_new_one_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "result.json"
    target.write_text("old")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ValueError, match="No space left on device"):
        outputs.write_text(target, "new")
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["result.json"]


def test_result_through_a_link_replaces_the_file_and_keeps_the_link(tmp_path: Path) -> None:
    (tmp_path / "real.json").write_text("old")
    (tmp_path / "link.json").symlink_to(tmp_path / "real.json")
    outputs.write_text(tmp_path / "link.json", "new")
    assert (tmp_path / "link.json").is_symlink()
    assert (tmp_path / "real.json").read_text() == "new"


def test_numbers_that_are_not_finite_become_null(tmp_path: Path) -> None:
    outputs.write_json(
        str(tmp_path / "x.json"),
        {"a": float("nan"), "b": [np.float64("inf"), np.int64(3)], "c": (1.5,)},
    )
    assert data(tmp_path, "x.json") == {"a": None, "b": [None, 3], "c": [1.5]}


def test_every_verb_has_help(capsys: pytest.CaptureFixture[str]) -> None:
    verbs = (
        "demo",
        "check",
        "fit",
        "compare",
        "diagnose",
        "improve",
        "report",
        "effects",
        "add",
        "simulate",
        "track",
        "plan",
        "export",
        "cosim",
        "app",
    )
    for verb in verbs:
        with pytest.raises(SystemExit) as stopped:
            main([verb, "--help"])
        assert stopped.value.code == 0
        text = capsys.readouterr().out
        assert "--json" in text, verb


# --- first steps ----------------------------------------------------------------------------------


def test_irj_alone_shows_three_examples_and_every_example_is_understood(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main([]) == 0
    text = capsys.readouterr().out
    assert text.count("\n  irj ") == 3
    shown = [line.split("  ")[1] for line in text.splitlines() if line.startswith("  irj ")]
    own = {name for name, sub in parser().verbs.items() if sub.add_help}
    assert set(EXAMPLES) == own
    for line in [*shown, *(line for lines in EXAMPLES.values() for line in lines)]:
        words = shlex.split(line.partition(" > ")[0].removeprefix('eval "$(').removesuffix(')"'))
        assert words[0] == "irj"
        assert parser().parse_args(words[1:]).verb in own
    with pytest.raises(SystemExit):
        main(["check", "--help"])
    assert capsys.readouterr().out.endswith(f"examples:\n  {EXAMPLES['check'][0]}\n")


def test_a_slip_gets_the_word_that_was_meant(capsys: pytest.CaptureFixture[str]) -> None:
    for words, meant in (
        (["diagnos", "x.csv"], "did you mean 'diagnose'?"),
        (["check", "x.csv", "--jont", "j.toml"], "did you mean '--joint'?"),
    ):
        with pytest.raises(SystemExit):
            main(words)
        assert meant in capsys.readouterr().err
    with pytest.raises(SystemExit):  # an option of another command, and none here is like it
        main(["compare", "x.csv", "--joint", "j.toml", "--held-out", "y.csv"])
    assert "did you mean" not in capsys.readouterr().err


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_the_completion_script_completes(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "bash"]) == 0
    script = capsys.readouterr().out
    for words, expected in (
        ("irj dia", "diagnose"),
        ("irj improve --held", "--held-out"),
        ("irj joints comp", "compare"),
    ):
        ask = f'COMP_WORDS=({words}); COMP_CWORD={len(words.split()) - 1}; _irj; echo "$COMPREPLY"'
        done = subprocess.run(
            ["bash", "-c", f"{script}\n{ask}"], capture_output=True, text=True, check=True
        )
        assert done.stdout.split() == [expected]
