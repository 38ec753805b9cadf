"""What README and the guide show is what the commands print today."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
from functools import cache
from importlib.resources import files
from pathlib import Path

import pytest

from casadi_models import EFFECTS
from workbench.cli.main import _parser, main

ROOT = Path(__file__).resolve().parents[1]
DEMO = Path(str(files("workbench"))) / "demo"
NUMBER = re.compile(r"-?\d+\.?\d*")


def run(*arguments: str) -> str:
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        assert main(list(arguments)) == 0
    return out.getvalue()


@cache
def demo_output() -> str:
    return run(
        "improve",
        str(DEMO / "train.npz"),
        "--held-out",
        str(DEMO / "held_out.npz"),
        "--joint",
        str(DEMO / "joint.toml"),
    )


def same(shown: str, printed: str) -> bool:
    """Equal words, and numbers that agree to 3 %: another machine's linear algebra moves the
    last digit.
    """
    if NUMBER.sub("#", shown).split() != NUMBER.sub("#", printed).split():
        return False
    pairs = zip(map(float, NUMBER.findall(shown)), map(float, NUMBER.findall(printed)), strict=True)
    return all(a == pytest.approx(b, rel=0.03) for a, b in pairs)


@pytest.mark.parametrize("page", ["README.md", "docs/guide.md"])
def test_ledger_of_the_demo_is_what_it_prints(page: str) -> None:
    lines = (ROOT / page).read_text(encoding="utf-8").splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("    step  "))
    shown = [line.strip() for line in lines[first : first + 4]]
    printed = demo_output().splitlines()
    start = next(i for i, line in enumerate(printed) if line.startswith("step "))
    for one, other in zip(shown, printed[start : start + 4], strict=True):
        assert same(one, other), f"{page} shows {one!r}, the command prints {other!r}"


def test_figures_of_the_guide_are_what_fit_compare_and_diagnose_print() -> None:
    guide = " ".join((ROOT / "docs" / "guide.md").read_text(encoding="utf-8").split())
    train, held_out, joint = (
        str(DEMO / "train.npz"),
        str(DEMO / "held_out.npz"),
        str(DEMO / "joint.toml"),
    )
    fitted = run("fit", train, "--joint", joint)
    values = {
        name: float(value)
        for name, value in re.findall(r"^  (\w+) +(\S+) \+- \S+ ", fitted, re.MULTILINE)
        if name != "value"
    }
    coulomb, viscous = re.findall(
        r"comes out at (\S+) Nm and the viscous coefficient at (\S+) Nms/rad", guide
    )[0]
    assert values["motor_coulomb"] == pytest.approx(float(coulomb), rel=0.03)
    assert values["motor_viscous"] == pytest.approx(float(viscous), rel=0.03)
    compared = run("compare", held_out, "--fit", train, "--joint", joint)
    times, share = re.findall(
        r"fails: (\S+) times the noise floor .* "
        r"and (\d+) % of what is left depends on the velocity",
        guide,
    )[0]
    assert float(re.findall(r"motor (\S+) times its floor", compared)[0]) == pytest.approx(
        float(times), rel=0.03
    )
    assert float(
        re.findall(r"motor balance against velocity: explains (\d+) %", compared)[0]
    ) == pytest.approx(float(share), abs=2)
    ranked = run("diagnose", train, "--held-out", held_out, "--joint", joint)
    first, second = re.findall(
        r"takes (\d+) % off the residual of the motor balance, the second (\d+) %", guide
    )[0]
    drops = [float(d) for d in re.findall(r"^\d\. .*-(\d+) % in the motor", ranked, re.MULTILINE)]
    assert drops[:2] == pytest.approx([float(first), float(second)], abs=2)


def test_picture_is_what_the_demo_draws(tmp_path: Path) -> None:
    run("demo", "--report", str(tmp_path / "r.html"), "--picture", str(tmp_path / "demo.svg"))
    kept, drawn = ((p / "demo.svg").read_text(encoding="utf-8") for p in (ROOT / "docs", tmp_path))
    words = [re.findall(r"<text[^>]*>([^<]*)</text>", page) for page in (kept, drawn)]
    assert [NUMBER.sub("#", w) for w in words[0]] == [NUMBER.sub("#", w) for w in words[1]]
    assert len(kept) < 40_000


def test_python_example_of_the_readme_runs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (code,) = re.findall(
        r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL
    )
    assert len([line for line in code.splitlines() if line.strip()]) <= 9
    for shown, real in (
        ("axis3.toml", "joint.toml"),
        ("run1.csv", "train.npz"),
        ("run2.csv", "held_out.npz"),
    ):
        code = code.replace(shown, real)
    monkeypatch.chdir(DEMO)
    exec(compile(code, "README.md", "exec"), {})  # the user's own page, not somebody's input
    text = capsys.readouterr().out
    assert "held_out: fit" in text
    assert "1. Stribeck effect" in text
    assert "('stribeck',)" in text


def commands(page: Path) -> list[list[str]]:
    text = page.read_text(encoding="utf-8")
    lines = [line.strip() for line in text.splitlines() if line.startswith("    irj ")]
    return [shlex.split(line)[1:] for line in lines if not line.startswith("irj:")]


@pytest.mark.parametrize(
    "page", ["README.md", "docs/guide.md", "docs/choose-a-model.md", "docs/extending.md"]
)
def test_every_command_shown_is_one_that_exists(page: str) -> None:
    for arguments in commands(ROOT / page):
        _, rest = _parser().parse_known_args(arguments)
        assert not rest or arguments[0] in ("export", "cosim", "batch")


def test_every_effect_of_the_extending_page_loads(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
    first = next(part for part in text.split("\n\n") if part.startswith("    import casadi"))
    code = text[text.index(first) :].split("\nSave it", 1)[0]
    source = "\n".join(line.removeprefix("    ") for line in code.splitlines())
    assert 8 <= len([line for line in source.splitlines() if line.strip()]) <= 12
    path = tmp_path / "my_effects.py"
    path.write_text(source)
    try:
        shown = run("effects", "seal_drag", "--effects", str(path))
        assert "drag of the shaft seal" in shown
        record = tmp_path / "r.npz"
        again = ["--set", "motor_seal_drag=10", "--seconds", "2", "-o", str(record)]
        EFFECTS._effects.pop("seal_drag")
        run(
            "--effects",
            str(path),
            "simulate",
            "--joint",
            str(DEMO / "joint.toml"),
            "--hide",
            "seal_drag",
            *again,
        )
    finally:
        EFFECTS._effects.pop("seal_drag", None)


@pytest.mark.parametrize(
    "page", sorted(p.name for p in (ROOT / "docs").glob("*.md")) + ["../README.md"]
)
def test_links_and_pictures_are_there(page: str) -> None:
    path = ROOT / "docs" / page
    for target in re.findall(r"\]\(([^)#]+)\)", path.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (path.parent / target).exists(), target
