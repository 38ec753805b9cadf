"""`irj linear`: known plants come back through the command, and what cannot be answered is said in
one line.
"""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt
import pytest
from scipy.signal import cont2discrete, lfilter

from workbench.cli.main import main

FloatArray = npt.NDArray[np.float64]

MOTOR, LINK, STIFFNESS, DAMPING = 1.0, 2.0, 12000.0, 3.0
MOTOR_VISCOUS, LINK_VISCOUS = 4.0, 2.0
RATIO, DT = -100.0, 2e-3
JOINT = f"""
[joint]
name = "two masses"
gear_ratio = {RATIO}
motor_constant = 0.05
model = "hd3"
"""


def two_masses() -> tuple[FloatArray, FloatArray]:
    """A and B, discrete, of q_m, v_m, q_l, v_l driven by a held torque on the motor, link side."""
    k, d = STIFFNESS, DAMPING
    a = np.array(
        [
            [0, 1, 0, 0],
            [-k / MOTOR, -(d + MOTOR_VISCOUS) / MOTOR, k / MOTOR, d / MOTOR],
            [0, 0, 0, 1],
            [k / LINK, d / LINK, -k / LINK, -(d + LINK_VISCOUS) / LINK],
        ]
    )
    b = np.array([[0], [1 / MOTOR], [0], [0]])
    found = cont2discrete((a, b, np.eye(4), np.zeros((4, 1))), DT)
    return found[0], found[1]


def write(path: Path, seed: int, samples: int, *, gain: float = 0.0) -> None:
    """A record of the two masses; with a gain a controller of the motor position closes the loop
    and its sensor's noise goes round.
    """
    rng = np.random.default_rng(seed)
    a, b = two_masses()
    asked = 40.0 * lfilter([0.3], [1.0, -0.7], rng.standard_normal(samples))
    x = np.zeros(4)
    rows = np.empty((samples, 4))
    for k in range(samples):
        seen = x[[0, 2]] + 1e-5 * rng.standard_normal(2)
        torque = asked[k] - gain * seen[0]
        rows[k] = torque, *seen, x[1] + 1e-3 * rng.standard_normal()
        x = a @ x + b[:, 0] * torque
    table = {
        "time_s": DT * np.arange(samples),
        "motor_torque_Nm": rows[:, 0] / RATIO,
        "motor_position_rad": rows[:, 1] * RATIO,
        "link_position_rad": rows[:, 2],
        "motor_velocity_rad_s": rows[:, 3] * RATIO,
    }
    np.savez(path, **table)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("linear")
    (folder / "joint.toml").write_text(JOINT)
    write(folder / "train.npz", 1, 6000)
    write(folder / "held_out.npz", 2, 3000)
    write(folder / "closed.npz", 3, 6000, gain=300.0)
    write(folder / "short.npz", 4, 60)
    still = {**np.load(folder / "train.npz")}
    still["motor_torque_Nm"] = np.full(6000, 0.4)
    np.savez(folder / "still.npz", **still)
    return folder


def resonance() -> complex:
    """The oscillating pole of the plant [rad/s]."""
    poles = np.log(np.linalg.eigvals(two_masses()[0]).astype(complex)) / DT
    return complex(poles[np.argmax(poles.imag)])


def test_an_elastic_joint_comes_back(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Order 3 from torque to motor velocity and torsion, with the resonance inside its band."""
    arguments = [
        *("linear", str(place / "train.npz"), "--held-out", str(place / "held_out.npz")),
        *("--joint", str(place / "joint.toml"), "--family", "moesp", "arx", "oe"),
        *("--every", "1", "--max-order", "4"),
        *("--json", str(place / "out.json"), "--picture", str(place / "out.svg")),
    ]
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    assert "from drive [N.m] to motor_velocity [rad/s], torsion [rad], link-referred" in printed
    found = json.loads((place / "out.json").read_text())
    assert found["held_out"].endswith("held_out")
    models = {m["family"]: m for m in found["models"]}
    moesp = models["moesp"]
    assert moesp["order"] == 3
    assert min(moesp["held_out_vaf_percent"].values()) > 99.0
    true = resonance()
    pair = next(p for p in moesp["poles"] if p["imaginary"] > 1e-6)
    for name, value in (
        ("frequency_hz", abs(true) / 2 / np.pi),
        ("damping", -true.real / abs(true)),
    ):
        deviation = pair[name.replace("_hz", "") + "_deviation" + ("_hz" if "hz" in name else "")]
        assert abs(pair[name] - value) < 4.0 * deviation, name
        assert deviation < 0.1 * value
    assert max(m["held_out_vaf_percent"]["torsion"] for m in found["models"]) > 99.0
    ElementTree.parse(place / "out.svg")


def test_without_held_out_records_blocks_are_held_out_and_it_is_said(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["linear", str(place / "train.npz"), "--family", "fir"]) == 0
    printed = capsys.readouterr().out
    assert "held out: the last 25 % of every stretch" in printed
    assert "from motor_torque [N.m] to motor_velocity [rad/s]\n" in printed


def test_a_closed_loop_without_an_instrument_is_said(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--joint", str(place / "joint.toml"), "--family", "arx", "--max-order", "3"]
    assert main(["linear", str(place / "closed.npz"), *arguments]) == 0
    assert "A controller closes the loop" in capsys.readouterr().out
    assert main(["linear", str(place / "train.npz"), *arguments]) == 0
    assert "No feedback from the outputs to the input shows" in capsys.readouterr().out


REFUSED = (
    (["still.npz"], "motor_torque is constant (0.4 in every row)"),
    (["short.npz"], "no stretch of the records has 64 samples"),
    (["train.npz", "--to", "torsion"], "the torsion needs --joint"),
    (["train.npz", "--from", "motor_position", "--to", "motor_position"], "is input and output"),
    (["train.npz", "--family", "tree"], "family 'tree' is unknown"),
    (["train.npz", "--max-order", "40"], "max_order is 40"),
    (["train.npz", "--held-out", "train.npz"], "given as training and as held out"),
)


@pytest.mark.parametrize(("arguments", "said"), REFUSED, ids=[said for _, said in REFUSED])
def test_what_cannot_be_answered_is_refused_in_one_line(
    arguments: list[str], said: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [str(place / a) if a.endswith(".npz") else a for a in arguments]
    assert main(["linear", *given]) == 2
    lines = capsys.readouterr().err.splitlines()  # what the check gate warns of comes first
    assert said in lines[-1]
    assert all(line.startswith("irj: ") for line in lines)
