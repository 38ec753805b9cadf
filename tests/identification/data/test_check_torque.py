"""The gate holds the link torque against the drive: a wrong unit or sign is refused with the
factor the data show.
"""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from identification import Record, read
from identification.data.check.checks import check, gate
from identification.data.joint_file import load_joint
from identification.errors import InputError
from workbench.cli.main import main

DEMO = Path(str(files("workbench") / "demo"))
JOINT = load_joint(DEMO / "joint.toml")


@pytest.fixture(scope="module")
def demo() -> Record:
    return read(DEMO / "train.npz", columns=JOINT.columns)


def scaled(record: Record, channel: str, factor: float) -> Record:
    return replace(record, channels={**record.channels, channel: factor * record[channel]})


def found(record: Record) -> tuple[str, str]:
    got = [
        f
        for f in check(record, JOINT.gear_ratio, torque_per_current=JOINT.torque_per_current)
        if f.code == "torque"
    ]
    return got[0].severity, got[0].message


def test_right_units_pass_and_say_the_factor(demo: Record) -> None:
    severity, message = found(demo)
    assert severity == "ok"
    assert float(message.split("factor ")[1].rstrip(")")) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(
    ("channel", "factor", "words"),
    [
        ("link_torque", 1e3, "times what link_torque says (a factor 1000"),
        ("link_torque", 1e-3, "a factor 1000"),
        ("link_torque", -1.0, "the sign of one is reversed"),
        ("motor_current", 1e3, "a factor 1000"),
        ("motor_current", -1.0, "the sign of one is reversed"),
    ],
)
def test_wrong_unit_or_sign_is_refused(
    demo: Record, channel: str, factor: float, words: str
) -> None:
    severity, message = found(scaled(demo, channel, factor))
    assert severity == "refuse"
    assert words in message
    with pytest.raises(InputError, match="correct|set sign"):
        gate(
            scaled(demo, channel, factor),
            JOINT.gear_ratio,
            torque_per_current=JOINT.torque_per_current,
        )


def test_inch_pounds_are_named_in_a_warning(demo: Record) -> None:
    severity, message = found(scaled(demo, "link_torque", 1 / 0.1129848))
    assert severity == "warn"
    assert "inch-pounds were taken for N.m" in message


def test_a_motor_constant_that_is_a_third_off_passes(demo: Record) -> None:
    assert found(scaled(demo, "motor_current", 1 / 1.3))[0] == "ok"
    assert found(scaled(demo, "motor_current", 1 / 1.8))[0] == "warn"


def test_without_torque_per_current_nothing_is_said(demo: Record) -> None:
    assert not [f for f in check(demo, JOINT.gear_ratio) if f.code == "torque"]


def test_a_torque_sensor_that_reads_something_else_is_no_unit_error(demo: Record) -> None:
    noise = replace(
        demo,
        channels={**demo.channels, "link_torque": np.random.default_rng(0).normal(size=len(demo))},
    )
    assert not [
        f
        for f in check(noise, JOINT.gear_ratio, torque_per_current=JOINT.torque_per_current)
        if f.code == "torque"
    ]


def test_newton_millimetres_stop_the_loop_with_one_line(
    demo: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "Drehmoment in N·mm.npz"
    with np.load(DEMO / "train.npz") as archive:
        columns = {k: archive[k] for k in archive.files}
    np.savez(path, **{k: v * (1e3 if k == "link_torque_Nm" else 1.0) for k, v in columns.items()})
    assert main(["improve", str(path), "--joint", str(DEMO / "joint.toml")]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert "a factor 1000" in said[0]


def test_a_record_without_motion_says_so(demo: Record) -> None:
    rng = np.random.default_rng(1)
    still = {
        c: np.full(len(demo), 1.2) + rng.normal(0, 1e-5, len(demo))
        for c in demo.channels
        if c.endswith("position")
    }
    refused = [
        f
        for f in check(replace(demo, channels={**demo.channels, **still}), JOINT.gear_ratio)
        if f.severity == "refuse"
    ]
    assert [f.code for f in refused] == ["no_motion"]
    assert "does not move" in refused[0].message


def test_a_negative_number_of_additions_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["improve", "x.csv", "--joint", "j.toml", "--max-steps", "-1"])
    assert end.value.code == 2
    assert "takes a whole number from 0 up" in capsys.readouterr().err


def test_an_effects_file_may_be_loaded_twice_and_a_broken_one_leaves_nothing(
    tmp_path: Path,
) -> None:
    from casadi_models import EFFECTS

    good = tmp_path / "own.py"
    good.write_text(
        "from casadi_models import effect\nfrom casadi_models.parameter import amplitude\n"
        '@effect("own_drag_twice", title="own drag", family="friction", acts_on=("motor",), '
        'parameters=(amplitude("own_drag_twice", "N.m.s/rad", "drag"),),'
        ' absence="-", excitation="-", source="-", dissipative=True)\n'
        "def own(s, p):\n    return p.own_drag_twice * s.velocity\n"
    )
    try:
        assert EFFECTS.load(good) == EFFECTS.load(good) == ("own_drag_twice",)
        before = set(EFFECTS)
        broken = tmp_path / "broken.py"
        broken.write_text(
            good.read_text().replace("own_drag_twice", "own_other")
            + "\nraise RuntimeError('half way')\n"
        )
        with pytest.raises(RuntimeError):
            EFFECTS.load(broken)
        assert set(EFFECTS) == before
    finally:
        EFFECTS._effects.pop("own_drag_twice", None)


def test_an_unknown_effect_names_the_nearest() -> None:
    from casadi_models import EFFECTS

    with pytest.raises(KeyError, match="did you mean 'stribeck'"):
        EFFECTS["stribek"]
