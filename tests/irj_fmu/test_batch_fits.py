"""`irj batch` with a task: many joints and records, one row each, and what a restart does again."""

from __future__ import annotations

import csv
import json
import os
import shutil
from concurrent.futures import Executor, Future
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest

from identification import fit, load_joint, read
from irj_fmu.batch.fit_worker import Parcel, answered
from irj_fmu.batch.fits import DIED, fingerprint, load_fit_study, parcel_of, run_fits
from workbench.cli.main import main

DEMO = Path(str(files("workbench"))) / "demo"
STUDY = """
[study]
name = "two runs"
task = "fit"
[[joint]]
joint = "joint.toml"
records = ["*.npz"]
each = true
[[joint]]
name = "broken"
joint = "joint.toml"
records = ["study.toml"]
"""


class Here(Executor):
    """Does every job at once in this process, and counts them."""

    def __init__(self) -> None:
        self.done = 0

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.done += 1
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


@pytest.fixture
def study(tmp_path: Path) -> Path:
    for name in ("joint.toml", "train.npz", "held_out.npz"):
        shutil.copy(DEMO / name, tmp_path / name)
    path = tmp_path / "study.toml"
    path.write_text(STUDY)
    return path


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_every_record_is_fitted_as_by_hand_and_what_fails_is_a_row(study: Path) -> None:
    out = study.parent / "out"
    executor = Here()
    found = run_fits(study, out=out, executor=executor)
    assert [j.name for j in found.jobs] == ["joint held_out", "joint train", "broken"]
    ((job, answer),) = found.failed
    assert job.name == "broken" and "study.toml" in answer.reason
    joint = load_joint(DEMO / "joint.toml")
    whole = fit(joint, read(DEMO / "train.npz"))
    row = rows(out / "summary.csv")[1]
    assert float(row["relative_error_percent"]) == whole.train.relative_error_percent
    values = {r["parameter"]: r for r in rows(out / "parameters.csv") if r["job"] == "2"}
    for name, p in whole.parameters.items():
        assert float(values[name]["value"]) == p["value"]
        assert values[name]["unit"] == p["unit"]
    again = load_joint(out / "joints" / "0002.toml")
    assert again.fitted["motor_inertia"] == pytest.approx(whole.solution.values["motor_inertia"])
    # what is done is not done again, what failed is
    executor = Here()
    second = run_fits(study, out=out, executor=executor)
    assert (second.there, executor.done) == (2, 1)
    assert second.answers[:2] == found.answers[:2]


def test_a_changed_file_is_another_job(study: Path) -> None:
    whole = load_fit_study(study)
    before = [fingerprint(parcel_of(whole, j)) for j in whole.jobs]
    assert len(set(before)) == 3
    text = (study.parent / "joint.toml").read_text()
    (study.parent / "joint.toml").write_text(text + "\n# weighed anew\n")
    assert not set(before) & {fingerprint(parcel_of(whole, j)) for j in whole.jobs}
    assert fingerprint(parcel_of(replace(whole, task="improve"), whole.jobs[0])) not in before


def test_a_process_that_dies_costs_its_job_alone(
    study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from irj_fmu.batch import fits

    monkeypatch.setattr(fits, "answered", dies_on_train)
    found = run_fits(study, out=study.parent / "out", jobs=1)
    assert [a.reason for j, a in zip(found.jobs, found.answers) if "train" in j.name] == [DIED]
    assert not found.answers[0].reason


def dies_on_train(parcel: Parcel) -> Any:
    """A job that ends its process on one of the records."""
    if parcel.records[0][0] == "train.npz":
        os._exit(1)
    return answered(parcel)


def test_command_says_how_many_were_done_and_writes_json(
    study: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(study.parent)
    assert main(["batch", "study.toml", "--dry-run"]) == 0
    assert "fit, 3 jobs" in capsys.readouterr().out
    result = ["batch", "study.toml", "--jobs", "1", "--json", "j.json", "--fail-on-error"]
    assert main(result) == 1
    assert "3 jobs, 1 failed" in capsys.readouterr().out
    data = json.loads((study.parent / "j.json").read_text())
    assert [row["passed"] for row in data["jobs"]] == [True, True, False]


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('task = "fit"', 'task = "guess"', "task = 'guess'"),
        ("each = true", "every = true", "unknown key 'every'"),
        ('records = ["*.npz"]', 'records = ["*.mat"]', "nothing fits '*.mat'"),
        ('records = ["*.npz"]', "", "no records"),
        ('joint = "joint.toml"', 'joint = "no.toml"', "give the path of a joint file"),
        ('name = "broken"', 'name = "joint train"', "two joints are called 'joint train'"),
        ("each = true", 'held_out = ["train.npz"]', "one role only"),
    ],
)
def test_a_study_that_cannot_be_used_is_one_line(
    study: Path, old: str, new: str, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    study.write_text(STUDY.replace(old, new))
    assert main(["batch", str(study)]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and says in lines[0]
