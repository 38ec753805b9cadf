"""Recordings by clicks and by the command line, and what both say of them:
``python -m tests.workbench.page.sets [NAME ...]``.

For each set Debian's Chromium uploads the files as they stand at ``../shared``, corrects and
confirms the columns, describes the joint, takes the joint file home, fits, diagnoses and runs the
whole loop. `irj diagnose` and `irj improve` then get the same files with that joint file. Printed
is a line per set: whether the words on the page are those of the terminal, letter by letter, and
whether every number of the result is the same.
"""

from __future__ import annotations

import argparse
import difflib
import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, final

from tests.workbench.chromium import context_of, launched
from tests.workbench.served import serving

ROOT: Final = Path(__file__).resolve().parents[3]
SHARED: Final = ROOT.parent / "shared"
LONGEST: Final = 100_000
"""What one step of a set may take at most [ms]."""


@final
@dataclass(frozen=True)
class Columns:
    """What a person corrects on the import screen before the map is used.

    Attributes
    ----------
    joint : int or None
        Number of the joint whose columns are taken, where several stand side by side.
    channel, unit, scale : mapping of column to the field's content
    formulas : mapping of channel to (formula, unit)
    """

    kind: str = ""
    joint: int | None = None
    channel: Mapping[str, str] = field(default_factory=dict)
    unit: Mapping[str, str] = field(default_factory=dict)
    scale: Mapping[str, str] = field(default_factory=dict)
    formulas: Mapping[str, tuple[str, str]] = field(default_factory=dict)


@final
@dataclass(frozen=True)
class Recorded:
    """Recordings of one joint, and what its owner knows.

    Attributes
    ----------
    train, held_out : tuple of str
        Files in the folder; without held-out ones a part of each is held out.
    columns : Columns or None
        None where the file's headers say everything.
    form : mapping
        Fields of the joint by their ids; empty where a joint file lies in the folder.
    model : str
    effects : tuple of str
        Effects in the start model.
    """

    folder: str
    train: tuple[str, ...]
    held_out: tuple[str, ...] = ()
    columns: Columns | None = None
    form: Mapping[str, str] = field(default_factory=dict)
    model: str = "hd1"
    effects: tuple[str, ...] = ("viscous",)


HIDDEN: Final = {
    name: Recorded(f"hidden_effect/{name}", ("train.csv", "train2.csv"), ("test.csv", "test2.csv"))
    for name in ("cubic_stiffness", "kinematic_error", "none", "stribeck")
}
SETS: Final[Mapping[str, Recorded]] = {
    "emps": Recorded(
        "measurements/emps",
        ("train.csv",),
        ("test_pulses.csv",),
        Columns(kind="linear"),
        {"gear_ratio": "1", "torque_per_voltage": "35.15065188"},
    ),
    "quanser": Recorded(
        "measurements/quanser_2dsfl",
        ("ctu_lqr.csv",),
        (),
        Columns(formulas={"link_position": ("q1_deg + defl1_deg", "deg")}),
        {"gear_ratio": "1", "torque_per_current": "8.925"},
    ),
    "xl330": Recorded(
        "measurements/bam_xl330",
        ("xl330.csv",),
        (),
        Columns(
            channel={"vin_V": "", "qd_rad_s": ""},
            formulas={"motor_voltage": ("vin_V * kp * (q_ref_rad - q_rad) * 0.005754", "V")},
        ),
        {"gear_ratio": "1"},
    ),
    "brfd": Recorded(
        "measurements/brfd_friction_backlash",
        ("brfd.parquet",),
        (),
        Columns(kind="linear", channel={"F_kip": "motor_torque", "v_in_s": ""}),
        {"gear_ratio": "1"},
    ),
    "hebi": Recorded(
        "measurements/hebi_x_sine",
        ("hebi.csv",),
        (),
        Columns(channel={"bus_V": ""}),
        {"gear_ratio": "273.16", "motor_constant": "0.01"},
    ),
    "kuka_axis1": Recorded(
        "measurements/kuka_kr300",
        ("A.csv", "B.csv"),
        ("C.csv",),
        Columns(
            scale={
                "time_s": "0.004",
                "axis1_motor_position_link_referred_deg": "256.857142857",
            }
        ),
        {"gear_ratio": "256.857142857"},
        model="hd3",
    ),
    **HIDDEN,
}
"""What each needs beside its files is in the README of its folder."""


@final
@dataclass(frozen=True)
class Answers:
    """What page and terminal say of one set.

    Attributes
    ----------
    page, terminal : str
        As printed; of the page, as it stands on the screen.
    found, improved : mapping
        The result on the page and of `irj improve --json`.
    seen, diagnosed : mapping
        The diagnosis on the page and of `irj diagnose --json`.
    joint_files : (str, str)
        Taken home from the page, written by `irj improve -o`.
    left_behind : (str, str)
        What each says that its joint file is without; empty where it has all.
    clicks : int
        From the empty page to the falling error.
    """

    page: str
    terminal: str
    found: Mapping[str, Any]
    improved: Mapping[str, Any]
    seen: Mapping[str, Any]
    diagnosed: Mapping[str, Any]
    joint_files: tuple[str, str]
    left_behind: tuple[str, str]
    clicks: int

    def differences(self) -> list[str]:
        """What is not the same, in one word each; empty where everything is."""
        out = [] if self.page == self.terminal else ["words"]
        kept = set(self.improved) - {"trust", "ranking"}  # the page has the trials in the diagnosis
        out += [k for k in sorted(kept) if self.found.get(k) != self.improved[k]]
        both = ("outcome", "verdict", "reason", "refused", "unexplained", "floor_ratio", "warnings")
        out += [f"diagnosis: {k}" for k in both if self.seen[k] != self.diagnosed[k]]
        said = [c["effects"] for c in (self.seen["claim"],) if c]
        if said != [c["effects"] for c in self.diagnosed["claims"][:1]]:
            out.append("diagnosis: claim")
        if self.joint_files[0] != self.joint_files[1]:
            out.append("joint file")
        if self.left_behind[0] != self.left_behind[1]:
            out.append("what the joint file is without")
        return out


@final
class Hand:
    """A person at the page, who counts the clicks."""

    def __init__(self, page: Any) -> None:
        self.page, self.clicks = page, 0

    def click(self, selector: str) -> None:
        self.page.click(selector, timeout=LONGEST)
        self.clicks += 1

    def choose(self, selector: str, value: str) -> None:
        self.page.select_option(selector, value, timeout=LONGEST)
        self.clicks += 1

    def idle(self, view: str) -> None:
        """The view is drawn as the state has it, and no work runs."""
        self.page.wait_for_function(
            "v => document.querySelector('#main').dataset.view === v && !busy() && "
            "!app.doing.length && app.state.steps.every((s) => s.settled) && "
            "document.querySelector('#main').dataset.revision === String(app.state.revision)",
            arg=view,
            timeout=LONGEST,
        )

    def upload(self, recorded: Recorded, folder: Path) -> None:
        page, names = self.page, [*recorded.train, *recorded.held_out]
        page.wait_for_selector("#files")
        joint = [] if recorded.form else ["joint.toml"]
        page.set_input_files("#files", [folder / n for n in (*joint, *names)])
        page.wait_for_function(
            "n => app.state.files.length === n && !busy()", arg=len(names), timeout=LONGEST
        )

    def confirm(self, columns: Columns) -> None:
        """Correct the guess and use it for every file."""
        page = self.page
        page.wait_for_selector(".map-table", timeout=LONGEST)

        def asked(edit: Any) -> None:
            with page.expect_response("**/look/*", timeout=LONGEST):
                edit()
            page.wait_for_timeout(200)  # the table is drawn anew with the answer

        first = "section:has(.map-table) >> nth=0 >> "
        if columns.kind and page.input_value(f"{first}[aria-label='Kind of the axis']") != (
            columns.kind
        ):
            asked(lambda: self.choose(f"{first}[aria-label='Kind of the axis']", columns.kind))
        if columns.joint is not None:
            asked(lambda: self.choose(f"{first}[aria-label='Joint']", str(columns.joint)))
        for name, channel in columns.channel.items():
            where = f"{first}[aria-label='Channel of column {name}']"
            asked(lambda w=where, c=channel: self.choose(w, c))
        for what, fields in (("Unit", columns.unit), ("Scale", columns.scale)):
            for name, text in fields.items():
                where = f"{first}[aria-label='{what} of column {name}']"
                page.fill(where, text)
                asked(lambda w=where: page.press(w, "Tab"))
        for channel, (formula, unit) in columns.formulas.items():
            row = f"{first}tr:has(strong:text-is('add a formula')) >> "
            page.fill(f"{row}[aria-label='Formula of columns, or the step of the time']", formula)
            page.fill(f"{row}[aria-label='Unit of the formula']", unit)
            asked(
                lambda r=row, c=channel: self.choose(f"{r}[aria-label='Channel of the formula']", c)
            )
        self.click(f"{first}button.primary:has-text('Use')")
        self.idle("load")

    def roles(self, recorded: Recorded) -> None:
        for name in recorded.held_out:
            where = f"select[aria-label='Role of {name}']"
            if self.page.input_value(where) != "held_out":
                self.choose(where, "held_out")
                self.idle("load")

    def describe(self, recorded: Recorded) -> None:
        page = self.page
        self.click("#to-model")
        self.idle("model")
        for name, text in recorded.form.items():
            page.fill(f"#{name}", text)
        if page.input_value("#model") != recorded.model:
            self.choose("#model", recorded.model)
        for key in ("viscous", "coulomb", "gravity"):
            if page.is_checked(f"input[value={key}]") != (key in recorded.effects):
                self.click(f"input[value={key}]")

    def taken_home(self, target: Path) -> str:
        """The joint file of the page."""
        self.page.click("#nav-export")
        self.idle("export")
        with self.page.expect_download(timeout=LONGEST) as joint:
            self.page.click("#get-joint-toml")
        joint.value.save_as(target)
        return target.read_text(encoding="utf-8")


def irj(folder: Path, *arguments: str) -> tuple[str, dict[str, Any]]:
    """What a verb prints, and its result."""
    done = subprocess.run(
        [sys.executable, "-m", "workbench", *arguments, "--json", str(folder / "out.json")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout, json.loads((folder / "out.json").read_text(encoding="utf-8"))


def state_of(page: Any, key: str) -> Any:
    """A part of the state that the page holds, as a browser has it: plain JSON."""
    return page.evaluate("k => app.state[k]", key)


def answers(page: Any, address: str, recorded: Recorded, folder: Path) -> Answers:
    """One set through both doors; `folder` takes what is written."""
    source = SHARED / recorded.folder
    hand = Hand(page)
    page.goto(address)
    hand.upload(recorded, source)
    if recorded.columns is not None:
        hand.confirm(recorded.columns)
    hand.roles(recorded)
    if recorded.form:
        hand.describe(recorded)
        hand.click("#save-fit")
    else:
        hand.click("#fit")
    hand.idle("compare")
    start = percent(page)
    hand.click("#diagnose")
    hand.idle("diagnose")
    seen = state_of(page, "diagnosis")
    if seen["claim"]:
        add = f"add-{re.sub('[@#]', '-', seen['claim']['label'])}"
        assert page.locator("ol.ranked button").first.get_attribute("id") == add
    if page.locator("button.primary:has-text('Add')").count():
        hand.click("button.primary:has-text('Add')")
        hand.idle("ledger")
        assert percent(page) < start
    clicks = hand.clicks
    page.click("#nav-ledger")
    hand.idle("ledger")
    page.click("#improve")
    page.wait_for_selector("#printed", state="attached", timeout=LONGEST)
    hand.idle("ledger")
    page.click("#found summary")
    words = page.inner_text("#printed").rstrip("\n") + "\n"
    found = state_of(page, "improvement")
    home = hand.taken_home(folder / "page.toml")
    card = page.inner_text("main")
    without = re.search(r"It is (without \d+ of the learned curves: [^.]*)\.", card)
    # the joint as it was described, before anything was fitted
    described = folder / "joint.toml"
    described.write_text(joint_before_the_fit(page, home), encoding="utf-8")
    records = [str(source / n) for n in recorded.train]
    held = [str(source / n) for n in recorded.held_out]
    given = [*records, *(["--held-out", *held] if held else []), "--joint", str(described)]
    _, diagnosed = irj(folder, "diagnose", *given)
    written = folder / "better.toml"
    text, improved = irj(folder, "improve", *given, "-o", str(written))
    # its last line is of the file that only the terminal writes; what it lacks, the page says, too
    text, _, last = text.partition(f"joint file: {written}")
    left = (without[1] if without else "", last.strip().removeprefix(", "))
    files = (home, written.read_text(encoding="utf-8"))
    return Answers(words, text, found, improved, seen, diagnosed, files, left, clicks)


def joint_before_the_fit(page: Any, home: str) -> str:
    """The joint's description with the column map of the file that was taken home."""
    text = str(page.evaluate("app.state.joint_text"))
    if "[columns]" in text or "[columns]" not in home:
        return text
    table = home[home.index("[columns]") :].split("\n\n")[0]
    return f"{text}\n{table}\n"


def percent(page: Any) -> float:
    """The held-out error in the head of the page."""
    return float(page.inner_text("#headline strong").split()[0])


def main() -> int:
    """Every set, or those that are named."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(SETS)}")
    names = parser.parse_args().names or list(SETS)
    wrong = 0
    with tempfile.TemporaryDirectory() as place, launched() as chromium:
        for name in names:
            folder = Path(place) / name
            folder.mkdir()
            began = time.perf_counter()
            with serving(folder / "sessions") as there:
                context = context_of(chromium, viewport={"width": 1280, "height": 860})
                made = answers(context.new_page(), there.address, SETS[name], folder)
                context.close()
            differ = made.differences()
            wrong += bool(differ)
            claims = [c.get("effects") for c in made.improved["claims"]]
            print(
                f"{name:<16} {made.clicks:>2} clicks, {made.improved['verdict']} {claims}, "
                f"{'the same' if not differ else 'differs: ' + ', '.join(differ)} "
                f"({time.perf_counter() - began:.0f} s)",
                flush=True,
            )
            for what, (here, there) in (
                ("words", (made.page, made.terminal)),
                ("joint file", made.joint_files),
                ("what the joint file is without", made.left_behind),
            ):
                if what in differ:
                    lines = difflib.unified_diff(
                        here.splitlines(), there.splitlines(), "page", "terminal", "", "", 0, ""
                    )
                    print(*lines, sep="\n", flush=True)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
