"""Where results go: links, pipes, terminals that lack a sign, file names that are no UTF-8;
what a guess of columns makes of compound words.
"""

from __future__ import annotations

import io
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from identification.data.guess import guess_columns
from tests.workbench.test_report import swing
from workbench.cli.main import main

ROOT = Path(__file__).resolve().parents[2]
DEMO = ROOT / "workbench" / "demo"


def test_compare_needs_no_other_record_to_fit_to(capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        main(
            ["compare", str(DEMO / "train.npz"), "--joint", str(DEMO / "joint.toml"), "--no-linear"]
        )
        == 0
    )
    assert "train: fit 9" in capsys.readouterr().out


def test_compare_refuses_a_record_given_twice(capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        main(
            [
                "compare",
                str(DEMO / "train.npz"),
                str(DEMO / "train.npz"),
                "--joint",
                str(DEMO / "joint.toml"),
            ]
        )
        == 2
    )
    assert "holds the same samples" in capsys.readouterr().err


def given(folder: Path) -> list[str]:
    """A record of a direct drive and its joint file, as arguments: where a report goes does not
    depend on what is in it, and that of a geared joint takes three times as long.
    """
    folder.mkdir()
    record = swing(1, "train")
    np.savez(
        folder / "run.npz",
        time_s=record.time,
        motor_torque_Nm=record["motor_torque"],
        motor_position_rad=record["motor_position"],
    )
    (folder / "joint.toml").write_text('[joint]\nname = "axis"\neffects = ["viscous"]\n')
    return [str(folder / "run.npz"), "--joint", str(folder / "joint.toml")]


def test_a_report_follows_a_link_and_fills_a_pipe(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    link, target, pipe = tmp_path / "link.html", tmp_path / "target.html", tmp_path / "pipe"
    target.write_text("old")
    link.symlink_to(target)
    command = ["report", *given(tmp_path_factory.mktemp("given") / "axis"), "-o"]
    assert main([*command, str(link)]) == 0
    assert link.is_symlink()
    assert target.read_text().lower().startswith("<!doctype html>")
    os.mkfifo(pipe)
    got = io.BytesIO()

    def drain() -> None:
        while (
            not got.getvalue().rstrip().endswith(b"</html>")
        ):  # the command opens the pipe once before, to see that it can
            with pipe.open("rb") as stream:
                got.write(stream.read())

    reader = threading.Thread(target=drain, daemon=True)
    reader.start()
    assert main([*command, str(pipe)]) == 0
    reader.join(60)
    assert not reader.is_alive()
    assert pipe.is_fifo()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link.html", "pipe", "target.html"]


@pytest.mark.slow
def test_a_name_that_is_no_utf8_and_an_ascii_terminal_lose_no_result(tmp_path: Path) -> None:
    name = os.fsdecode(b"lauf_" + b"\xfc" + "_\N{ROBOT FACE}.npz".encode())
    (tmp_path / name).write_bytes((DEMO / "train.npz").read_bytes())
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "workbench",
            "improve",
            name,
            "--joint",
            str(DEMO / "joint.toml"),
            "--held-out",
            str(DEMO / "held_out.npz"),
            "--report",
            "r.html",
            "--json",
            "o.json",
            "-o",
            "o.toml",
        ],
        cwd=tmp_path,
        capture_output=True,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONIOENCODING": "ascii"},
    )
    assert done.returncode == 0, done.stderr
    assert b"missing: stribeck" in done.stdout
    assert {p.name for p in tmp_path.iterdir()} == {name, "r.html", "o.json", "o.toml"}
    assert "Stribeck" in (tmp_path / "r.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (
            (
                "Zeit [s]",
                "Motorstrom [A]",
                "Motorgeschwindigkeit [U/min]",
                "Gelenkgeschwindigkeit [°/s]",
                "Gelenkmoment [Nm]",
                "Abtriebswinkel [°]",
            ),
            (
                "time",
                "motor_current",
                "motor_velocity",
                "link_velocity",
                "link_torque",
                "link_position",
            ),
        ),
        (
            ("m/time_s", "m/motor_position_rad", "m/link_position_rad", "m/link_torque_Nm"),
            ("time", "motor_position", "link_position", "link_torque"),
        ),
        (
            ("motor_test.link_torque_Nm", "motor_test.motor_current_A"),
            ("link_torque", "motor_current"),
        ),
        (("motor/position_rad", "link/position_rad"), ("motor_position", "link_position")),
    ],
)
def test_compound_words_and_groups_keep_their_side(
    names: tuple[str, ...], said: tuple[str, ...]
) -> None:
    found = {g.column.column: g.column.channel for g in guess_columns(names)}
    assert found == dict(zip(names, said, strict=True))


def test_a_time_of_day_is_said_to_be_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = "\n".join(
        f"10:59:{48 + 0.002 * k:06.3f},{np.sin(0.01 * k):.6f},{np.cos(0.01 * k):.6f}"
        for k in range(100)
    )
    (tmp_path / "run.csv").write_text(f"time_s,motor_position_rad,motor_current_A\n{rows}\n")
    assert main(["check", str(tmp_path / "run.csv")]) == 2
    assert "a date or a time of day: write seconds from the start" in capsys.readouterr().err
