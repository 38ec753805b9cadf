"""`irj batch` with joint files whose model is a user's FMU: fitted over many records, and run."""

from __future__ import annotations

import csv
import json
import os
from pathlib import Path

import numpy as np
import pytest

from irj_fmu.batch.fit_worker import answered
from irj_fmu.batch.fits import fingerprint, load_fit_study, parcel_of, run_fits
from irj_fmu.batch.run import run_study
from irj_fmu.imported.compare import compare
from irj_fmu.imported.file import load_user_joint, user_joint_text
from tests.irj_fmu.imported.test_user_fmu import FILE
from tests.irj_fmu.test_batch_fits import Here
from tests.user_fmus.make import Make, build
from tests.user_fmus.makes import CS, ME, write_record
from tests.user_fmus.records import TRUTH, axis
from workbench.cli.main import main

FITS = """
[study]
task = "fit"
[[joint]]
joint = "files/user.toml"
records = ["run*.npz"]
held_out = ["held.npz"]
each = true
"""
RUNS = """
[study]
name = "runs"
[[model]]
joint = "files/fitted.toml"
[records]
files = ["run0.npz", "run1.npz"]
[grid]
viscous = [0.5, 0.7]
"""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A study beside its records, the joint file and its FMU in a folder of their own."""
    folder = tmp_path / "files"
    folder.mkdir()
    build("Axis", folder, Make(2, CS, strict=True)).replace(folder / "axis ö.fmu")
    (folder / "user.toml").write_text(FILE.format(fmu="axis ö.fmu"), encoding="utf-8")
    for k in range(3):
        write_record(axis(seconds=6.0, seed=k), tmp_path / f"run{k}.npz")
    write_record(axis(seconds=4.0, seed=9), tmp_path / "held.npz")
    (tmp_path / "fits.toml").write_text(FITS)
    (tmp_path / "runs.toml").write_text(RUNS)
    return tmp_path


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_every_record_is_fitted_and_the_truth_is_found(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On processes, from the command line, from another folder."""
    monkeypatch.chdir(place / "files")
    out = place / "out"
    given = ["batch", "../fits.toml", "--jobs", "1", "--out", str(out), "--fail-on-error"]
    assert main([*given, "--json", str(place / "done.json")]) == 0
    done = json.loads((place / "done.json").read_text())
    assert [j["job"] for j in done["jobs"]] == ["user run0", "user run1", "user run2"]
    summary = rows(out / "summary.csv")
    assert all(float(r["held_out_error_percent"]) < 0.05 for r in summary)
    found = rows(out / "parameters.csv")
    assert len(found) == 3 * len(TRUTH)
    for row in found:
        error = float(row["stderr"])
        assert float(row["value"]) == pytest.approx(TRUTH[row["parameter"]], abs=4 * error)
        assert error < 0.02 * TRUTH[row["parameter"]]
    # the joint files that it writes find the FMU where it lies
    fitted = load_user_joint(out / "joints" / "0001.toml")
    assert fitted.fmu.path == (place / "files" / "axis ö.fmu").resolve()
    assert main([*given]) == 0  # all is there already
    assert main(["compare", "../held.npz", "--joint", str(out / "joints" / "0003.toml")]) == 0


def test_a_job_is_done_again_where_its_fmu_has_changed(place: Path) -> None:
    study = load_fit_study(place / "fits.toml")
    before = [fingerprint(parcel_of(study, job)) for job in study.jobs]
    fmu = place / "files" / "axis ö.fmu"
    assert fmu in {p.resolve() for p in study.inputs}
    build("Axis", place / "files", Make(2, CS)).replace(fmu)
    after = [fingerprint(parcel_of(study, job)) for job in study.jobs]
    assert not set(before) & set(after)


@pytest.mark.parametrize("task", ["improve", pytest.param("explore", marks=pytest.mark.slow)])
def test_other_tasks_give_what_their_verbs_give(place: Path, task: str) -> None:
    drag = 0.15
    record = axis(lambda _q, w: drag * w * abs(w), seconds=8.0, h=4e-3)
    write_record(record.window(0, 5), place / "train.npz")
    write_record(record.window(5, 8), place / "held.npz")
    (place / "fits.toml").write_text(
        FITS.replace('"fit"', f'"{task}"').replace("run*.npz", "train.npz")
    )
    found = run_fits(place / "fits.toml", out=place / "out", executor=Here())
    assert found.failed == ()
    (row,) = rows(place / "out" / "summary.csv")
    assert float(row["end_error_percent"]) < 0.5 * float(row["start_error_percent"])
    key = "added" if task == "improve" else "recommended"
    assert "quadratic_drag" in row[key]
    model = load_user_joint(place / "out" / "joints" / "0001.toml")
    assert model.correction is not None
    drags = [v for n, v in model.values.items() if n.endswith("quadratic_drag")]
    assert drags == [pytest.approx(drag, rel=0.05)]


def test_what_goes_wrong_in_one_job_is_its_own_answer(place: Path) -> None:
    """An FMU that fails on the way; a record without a mapped channel."""
    build("Axis", place / "files", Make(2, CS, fails=3)).replace(place / "files" / "broken.fmu")
    (place / "files" / "broken.toml").write_text(FILE.format(fmu="broken.fmu"))
    record = axis(seconds=4.0, h=4e-3)
    write_record(record.without("motor_torque"), place / "lame.npz")
    (place / "fits.toml").write_text(
        FITS.replace("each = true", "")
        + '[[joint]]\njoint = "files/broken.toml"\nrecords = ["run0.npz"]\n'
        + '[[joint]]\nname = "lame"\njoint = "files/user.toml"\nrecords = ["lame.npz"]\n'
    )
    study = load_fit_study(place / "fits.toml")
    good, broken, lame = [answered(parcel_of(study, job)) for job in study.jobs]
    assert good.reason == ""
    assert "doStep failed with status 3" in broken.reason and "\n" not in broken.reason
    assert "motor_torque" in lame.reason and "/tmp" not in lame.reason.replace(str(place), "")


def test_an_fmu_that_is_not_there_is_refused_before_any_job(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.remove(place / "files" / "axis ö.fmu")
    assert main(["batch", str(place / "fits.toml"), "--out", str(place / "out")]) == 2
    said = capsys.readouterr().err
    assert "there is no file" in said and "axis ö.fmu" in said
    assert len(said.splitlines()) == 1
    assert not (place / "out").exists()


# --- runs -----------------------------------------------------------------------------------------


def test_a_study_runs_the_fmu_as_its_joint_file_says(place: Path) -> None:
    """Channels feed inputs and stand beside outputs, states start at the first readings, values are
    the fitted ones; the error is that of the FMU's own run.
    """
    joint = place / "files" / "fitted.toml"
    model = load_user_joint(place / "files" / "user.toml").with_values(TRUTH)
    joint.write_text(user_joint_text(model, folder=joint.parent), encoding="utf-8")
    out = place / "out"
    assert main(["batch", str(place / "runs.toml"), "--out", str(out), "--jobs", "1"]) == 0
    found = rows(out / "summary.csv")
    assert len(found) == 4 and {r["outcome"] for r in found} == {"done"}
    fits = {(r["record"], r["viscous"]): float(r["angle.fit_percent"]) for r in found}
    for name in ("run0", "run1"):
        assert fits[name, "0.7"] > 99.0  # the true damping
        assert fits[name, "0.5"] < fits[name, "0.7"] - 5.0


@pytest.mark.parametrize(("version", "kind"), [(2, ME), (3, CS), (3, ME)])
def test_a_study_runs_any_version_and_interface(
    place: Path, version: int, kind: tuple[str, ...]
) -> None:
    """The errors against the record are those of FMI 2.0 co-simulation: to rounding, by model
    exchange to its integrator of fixed steps.
    """
    (place / "files" / "user.toml").replace(place / "files" / "fitted.toml")
    write_record(axis(seconds=1.0), place / "run0.npz")
    study = place / "runs.toml"
    study.write_text(RUNS.replace(', "run1.npz"', "").replace("0.5, ", ""))
    values = {}
    for name, make in (("two", Make(2, CS)), ("other", Make(version, kind))):
        build("Axis", place / "files", make).replace(place / "files" / "axis ö.fmu")
        out = place / name
        run_study(study, out=out, executor=Here())
        found = rows(out / "summary.csv")
        assert {r["outcome"] for r in found} == {"done"}
        values[name] = [[float(r[f"angle.{k}"]) for k in ("rms", "fit_percent")] for r in found]
    exact = 1e-12 if kind == CS else 1e-3
    np.testing.assert_allclose(values["other"], values["two"], rtol=exact)


def test_an_effect_outside_runs_as_the_corrected_fmu(place: Path) -> None:
    drag = 0.15
    for k in range(2):
        record = axis(lambda _q, w: drag * w * abs(w), seconds=4.0, h=4e-3, seed=k)
        write_record(record, place / f"run{k}.npz")
    joint = place / "files" / "user.toml"
    larger, fitted = place / "files" / "larger.toml", place / "files" / "fitted.toml"
    added = ["add", "quadratic_drag@motor", "--joint", str(joint), "-o", str(larger)]
    assert main(added) == 0
    runs = [str(place / f"run{k}.npz") for k in range(2)]
    assert main(["fit", *runs, "--joint", str(larger), "-o", str(fitted)]) == 0
    out = place / "out"
    assert main(["batch", str(place / "runs.toml"), "--out", str(out), "--jobs", "1"]) == 0
    found = rows(out / "summary.csv")
    fits = {(r["record"], r["viscous"]): float(r["angle.fit_percent"]) for r in found}
    assert min(v for (_, viscous), v in fits.items() if viscous == "0.7") > 98.0
    assert list((out / "models").glob("*.fmu"))


@pytest.mark.parametrize(
    ("change", "make", "said"),
    [
        ('kind = "estimator"', Make(2, CS), "take kind"),
        ('add = ["stribeck@motor"]', Make(2, CS), "take add out"),
        ("", Make(2, ME, events=1), "model exchange with state events only"),
    ],
)
def test_what_a_study_cannot_run_is_refused(
    place: Path, capsys: pytest.CaptureFixture[str], change: str, make: Make, said: str
) -> None:
    build("Axis", place / "files", make).replace(place / "files" / "axis ö.fmu")
    (place / "files" / "user.toml").replace(place / "files" / "fitted.toml")
    study = place / "runs.toml"
    study.write_text(RUNS.replace("[records]", f"{change}\n[records]"))
    assert main(["batch", str(study), "--out", str(place / "out")]) == 2
    err = capsys.readouterr().err
    assert said in err and len(err.splitlines()) == 1
    assert not (place / "out").exists()


def test_compare_agrees_with_the_fit_of_a_job(place: Path) -> None:
    """The error of the summary is that of `irj compare`, RMS over the outputs."""
    from identification import read

    (place / "fits.toml").write_text(FITS.replace("run*", "run0"))
    run_fits(place / "fits.toml", out=place / "out", executor=Here())
    (row,) = rows(place / "out" / "summary.csv")
    model = load_user_joint(place / "out" / "joints" / "0001.toml")
    again = compare(model, read(place / "held.npz")).outputs["motor_position"]
    assert float(row["held_out_error_percent"]) == pytest.approx(
        again.relative_error_percent, rel=1e-3
    )
