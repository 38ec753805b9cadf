"""The command line `irj`: thin doors on the Python calls of the same names."""

from __future__ import annotations

import argparse
import contextlib
import functools
import importlib
import io
import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, TextIO, cast, final

from identification import __version__
from identification.data.schema import meant
from identification.errors import InputError
from identification.scratch import release
from irj_fmu.command_line import (
    STOPPED,
    OneLineParser,
    crashed,
    fail,
    no_memory,
    stopped,
    system_refusal,
    terminable,
)
from workbench.cli.files import check_outputs
from workbench.cli.first.help import welcome, with_examples
from workbench.cli.user_fmu import module_of


def _count(text: str) -> int:
    """A number of additions: 0 or more."""
    try:
        value = int(text)
    except ValueError:
        value = -1
    if value < 0:
        raise argparse.ArgumentTypeError(f"takes a whole number from 0 up, not {text!r}")
    return value


def _port(text: str) -> int:
    """A port: 0 for any that is free."""
    try:
        value = int(text)
    except ValueError:
        value = -1
    if not 0 <= value <= 65535:
        raise argparse.ArgumentTypeError(f"takes a port from 0 to 65535, not {text!r}")
    return value


def _one_of(choices: tuple[str, ...], text: str) -> str:
    """One of some words, with the one that may be meant where it is none."""
    if text not in choices:
        raise argparse.ArgumentTypeError(
            f"{text!r} is none of {', '.join(choices)}{meant(text, choices)}"
        )
    return text


@functools.cache
def parser() -> OneLineParser:
    """Arguments of every verb; those of export, cosim and batch go through to their own."""
    made = OneLineParser(
        prog="irj", description="Tells which physics a geared joint's model is missing."
    )
    made.add_argument("--version", action="version", version=f"irj {__version__}")
    made.add_argument(
        "--effects",
        metavar="FILE.py",
        action="append",
        default=[],
        help="register your own effects from a Python file",
    )
    verbs = made.add_subparsers(dest="verb", required=True, metavar="VERB")

    def verb(
        name: str, module: str, text: str, *, records: bool = False, joint: bool = False
    ) -> argparse.ArgumentParser:
        sub = verbs.add_parser(name, help=text, description=text)
        sub.set_defaults(module=module)
        sub.add_argument(
            "--effects",
            dest="own_effects",
            metavar="FILE.py",
            action="append",
            default=[],
            help=argparse.SUPPRESS,
        )
        sub.add_argument("--json", metavar="FILE", help="write the result as JSON")
        if records:
            sub.add_argument("records", nargs="+", metavar="REC", help="record files")
        if joint:
            sub.add_argument("--joint", metavar="J", required=True, help="joint file (TOML)")
        return sub

    def other_payload(sub: argparse.ArgumentParser) -> None:
        text = (
            "training records of the same joint with another payload: they share motor and "
            "transmission, not the link"
        )
        sub.add_argument(
            "--other-payload", nargs="+", action="extend", metavar="REC", default=[], help=text
        )

    def first_page(sub: argparse.ArgumentParser) -> None:
        sub.add_argument(
            "--beside",
            nargs="+",
            action="extend",
            metavar="RESULT",
            default=[],
            help="for the report: results of `irj improve --json` of another date or joint, for a "
            "comparison",
        )
        sub.add_argument("--author", metavar="NAME", help="for the first page of the report")
        sub.add_argument(
            "--notes",
            metavar="TEXT",
            help="for the first page of the report, as what was changed before",
        )

    demo = verb(
        "demo", "loop", "the main job on embedded data: a simulated joint with a hidden effect"
    )
    demo.add_argument(
        "--report",
        default="irj-demo.html",
        metavar="FILE",
        help="where the report goes (default irj-demo.html)",
    )
    demo.add_argument(
        "--picture", metavar="FILE.svg", help="draw the falling error and the place of the residual"
    )
    taken = verb(
        "import",
        "first.importing",
        "look at a measurement file and write the joint file that reads it",
    )
    taken.add_argument("records", nargs=1, metavar="FILE", help="record file")
    taken.add_argument("-o", "--output", metavar="FILE", help="the joint file to write (TOML)")
    taken.add_argument("--name", metavar="NAME", help="name of the joint (default: the file's)")
    taken.add_argument(
        "--kind", choices=("rotary", "linear"), help="kind of the axis (default: as it looks)"
    )
    taken.add_argument(
        "--joint-number",
        type=int,
        metavar="N",
        help="where columns of several joints stand side by side: which (default: the first)",
    )
    taken.add_argument(
        "--gear-ratio", type=float, metavar="R", help="motor angle over link angle (default 1)"
    )
    taken.add_argument(
        "--motor-constant", type=float, metavar="K", help="torque on the motor shaft per ampere"
    )
    checked = verb("check", "records", "check records before a fit", records=True)
    checked.add_argument("--joint", metavar="J", help="joint file: column map and gear ratio")
    resampled = verb(
        "resample", "records", "put a record with late stamps or lost samples on an even grid"
    )
    resampled.add_argument("records", nargs=1, metavar="FILE", help="record file")
    resampled.add_argument("--joint", metavar="J", help="joint file: column map")
    resampled.add_argument(
        "-o", "--output", metavar="OUT", required=True, help="record file to write, .csv or .npz"
    )
    smoothed = verb(
        "prefilter",
        "records",
        "the thesis's low-pass on every channel alike, derivatives, fewer samples",
    )
    smoothed.add_argument("records", nargs=1, metavar="FILE", help="record file")
    smoothed.add_argument("--joint", metavar="J", help="joint file: column map")
    smoothed.add_argument(
        "--cutoff", type=float, default=15.0, metavar="HZ", help="of one pass (default 15)"
    )
    smoothed.add_argument(
        "--order", type=_count, default=8, metavar="N", help="of one pass (default 8)"
    )
    smoothed.add_argument(
        "--derivatives", action="store_true", help="add velocities and accelerations"
    )
    smoothed.add_argument(
        "--trim", type=_count, default=49, metavar="N", help="samples dropped at each end"
    )
    smoothed.add_argument(
        "--every", type=_count, default=1, metavar="N", help="keep every Nth sample (default 1)"
    )
    smoothed.add_argument(
        "-o", "--output", metavar="OUT", required=True, help="record file to write, .csv or .npz"
    )
    levelled = verb(
        "accelerometer",
        "records",
        "offset and volts per g of an accelerometer from files at rest",
    )
    levelled.add_argument("--up", metavar="FILE", required=True, help="face up, +1 g")
    levelled.add_argument("--down", metavar="FILE", required=True, help="face down, -1 g")
    levelled.add_argument(
        "--horizontal",
        nargs="+",
        action="extend",
        metavar="FILE",
        default=[],
        help="horizontal, 0 g: the offset is then their mean",
    )
    levelled.add_argument(
        "--column", metavar="NAME", help="column of the output [V] (default: the only one)"
    )
    fitted = verb("fit", "loop", "fit the joint's model", records=True, joint=True)
    other_payload(fitted)
    fitted.add_argument(
        "--refine",
        action="store_true",
        help="refine by the error of the simulated outputs (slower, less bias by noise)",
    )
    fitted.add_argument("-o", "--output", metavar="FILE", help="write the fitted joint file")
    separated = verb(
        "twostep",
        "loop",
        "the thesis's two-step fit: shapes by coordinate search, the rest by least squares",
        records=True,
        joint=True,
    )
    separated.add_argument(
        "--method",
        choices=("variable_projection", "alternating"),
        default="variable_projection",
        help="eliminate the linear parameters inside the search (default), or take turns",
    )
    separated.add_argument(
        "--cutoff", type=float, default=15.0, metavar="HZ", help="of the prefilter (default 15)"
    )
    separated.add_argument("-o", "--output", metavar="FILE", help="write the fitted joint file")
    compared = verb(
        "compare",
        "loop",
        "how far the model is from the records, and where",
        records=True,
        joint=True,
    )
    compared.add_argument(
        "--fit",
        dest="fit_records",
        nargs="+",
        action="extend",
        metavar="REC",
        default=[],
        help="fit to these records and compare with REC (default: the values of the joint file as "
        "they stand, and where it lacks one a fit to REC itself)",
    )
    compared.add_argument(
        "--no-linear",
        action="store_true",
        help="leave out what linear models without physics would explain",
    )
    diagnosed = verb("diagnose", "loop", "rank what is missing", records=True, joint=True)
    other_payload(diagnosed)
    diagnosed.add_argument(
        "--held-out",
        nargs="+",
        action="extend",
        metavar="REC",
        default=[],
        help="records the fit must not see",
    )
    diagnosed.add_argument(
        "--why",
        metavar="KEY",
        nargs="+",
        action="extend",
        default=[],
        help="say why this effect is named, or why it is not",
    )
    diagnosed.add_argument(
        "-o", "--output", metavar="FILE", help="write the joint file with the first claim added"
    )
    improved = verb(
        "improve",
        "loop",
        "name what is missing, add it, watch the error fall",
        records=True,
        joint=True,
    )
    other_payload(improved)
    improved.add_argument(
        "--held-out",
        nargs="+",
        action="extend",
        metavar="REC",
        default=[],
        help="records the fit must not see",
    )
    improved.add_argument("--report", metavar="FILE", help="write the HTML report")
    first_page(improved)
    improved.add_argument(
        "--picture", metavar="FILE.svg", help="draw the falling error and the place of the residual"
    )
    improved.add_argument("-o", "--output", metavar="FILE", help="write the improved joint file")
    improved.add_argument(
        "--max-steps", type=_count, default=6, metavar="N", help="most effects to add (default 6)"
    )
    improved.add_argument(
        "--reference",
        metavar="REFERENCE",
        help="fitted joint file: first say what changed since, before any new effect is looked for",
    )
    explored = verb(
        "explore",
        "explore",
        "hold all variants of the model against each other: error, parameters, ties",
        records=True,
        joint=True,
    )
    other_payload(explored)
    explored.add_argument(
        "--held-out",
        nargs="+",
        action="extend",
        metavar="REC",
        default=[],
        help="records the fit must not see",
    )
    explored.add_argument(
        "--picture", metavar="FILE.svg", help="draw the held-out error against the parameters"
    )
    explored.add_argument(
        "--out", metavar="DIR", help="folder for the variants as Parquet, with JSON and picture"
    )
    explored.add_argument(
        "-o", "--output", metavar="FILE", help="write the joint file of the recommended variant"
    )
    explored.add_argument(
        "--report", metavar="FILE", help="write the HTML report, with a section of the variants"
    )
    moved = verb("changed", "changed", "which parameters of a fitted joint moved, by how much")
    moved.add_argument("reference", metavar="REFERENCE", help="joint file written by a fit")
    moved.add_argument("records", nargs="+", metavar="REC", help="record files")
    moved.add_argument(
        "--healthy",
        nargs="+",
        action="extend",
        metavar="REC",
        default=[],
        help="records of the joint as it was fitted: on the same motion smaller changes are seen",
    )
    report = verb(
        "report", "loop", "the improve loop, written as one HTML file", records=True, joint=True
    )
    other_payload(report)
    report.add_argument(
        "--held-out",
        nargs="+",
        action="extend",
        metavar="REC",
        default=[],
        help="records the fit must not see",
    )
    report.add_argument(
        "-o", "--output", metavar="FILE", default="irj-report.html", help="the HTML file"
    )
    first_page(report)
    listed = verb("effects", "library", "list the effect library, or one effect")
    listed.add_argument("key", nargs="?", help="key of one effect")
    added = verb("add", "library", "add an effect to a joint file")
    added.add_argument("key", nargs="?", help="effect key, or key@place")
    added.add_argument(
        "--law",
        metavar="TEXT",
        help='a law of your own, as "c*tanh(v/b)"; write --law="-c*v" where it starts with a minus',
    )
    added.add_argument(
        "--on",
        metavar="PLACE",
        action="append",
        default=[],
        help="where the law acts: motor, link, transmission...",
    )
    added.add_argument(
        "--parameter",
        metavar="NAME=LOW..HIGH UNIT",
        action="append",
        default=[],
        help='a parameter of the law, as "b=0.01..1 rad/s"',
    )
    added.add_argument(
        "--key", dest="named", metavar="KEY", help="key of the law (default: one derived from it)"
    )
    added.add_argument("--joint", metavar="J", required=True, help="joint file (TOML)")
    added.add_argument(
        "-o", "--output", metavar="FILE", required=True, help="write the larger joint file"
    )
    displayed = verb(
        "show",
        "show",
        "write down the equations of a joint with values, standard errors and units",
        joint=True,
    )
    displayed.add_argument(
        "--format", choices=("text", "latex", "sympy"), default="text", help="default text"
    )
    displayed.add_argument(
        "--compensation",
        action="store_true",
        help="the friction torque alone, as a table over velocity",
    )
    displayed.add_argument(
        "--max-speed",
        type=float,
        default=60.0,
        metavar="DEG_S",
        help="fastest speed of the table [deg/s; m/s on a linear axis]",
    )
    displayed.add_argument("-o", "--output", metavar="FILE", help="write to a file")
    simulated = verb("simulate", "virtual", "simulate the joint with its sensors", joint=True)
    simulated.add_argument(
        "--hide",
        metavar="KEY",
        action="append",
        default=[],
        help="add this effect without saying so in the record",
    )
    simulated.add_argument(
        "-o", "--output", metavar="FILE", default="simulated.csv", help="record file, .csv or .npz"
    )
    simulated.add_argument("--truth", metavar="FILE", help="write the true parameters as JSON")
    simulated.add_argument(
        "--set",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        help="true value of a parameter, link-referred SI",
    )
    simulated.add_argument("--seconds", type=float, default=24.0, help="length [s] (default 24)")
    simulated.add_argument(
        "--rate", type=float, default=500.0, help="samples per second (default 500)"
    )
    simulated.add_argument(
        "--seed", type=int, default=0, help="seed of motion and noise (default 0)"
    )
    simulated.add_argument(
        "--motion",
        choices=("multisine", "triangle"),
        default="multisine",
        help="what the controller follows (default multisine)",
    )
    tracked = verb(
        "track",
        "online",
        "replay the online estimator with sensor-fault detection",
        records=True,
        joint=True,
    )
    tracked.add_argument(
        "--healthy",
        nargs="+",
        action="extend",
        metavar="REC",
        default=[],
        help="records of the healthy joint: limits of the fault detector",
    )
    tracked.add_argument(
        "--fail-on-fault", action="store_true", help="exit with 1 where a fault is found"
    )
    tracked.add_argument("--report", metavar="FILE", help="write the HTML report")
    tracked.add_argument(
        "--follow",
        type=float,
        nargs="?",
        const=10.0,
        metavar="SECONDS",
        help="the record is a CSV file that is still being written, udp://HOST:PORT where its "
        "lines come, or ros2://TOPIC of joint states: follow it, and print what is found at once, "
        "until nothing came for SECONDS (10)",
    )
    tracked.add_argument(
        "--inject",
        metavar="SENSOR:KIND:START[:SIZE[:END]]",
        action="append",
        default=[],
        help="put a fault into the readings to see what is found, as link_position:stuck:9 or "
        "current:bias:9:20; SIZE is referred to the link: N.m, rad and rad/s, of a linear axis N, "
        "m and m/s (gain: share; delay: s; drift: per s)",
    )
    planned = verb(
        "plan", "online", "select a motion that makes the parameters identifiable", joint=True
    )
    planned.add_argument(
        "-o",
        "--output",
        metavar="FILE",
        default="trajectory.csv",
        help="the motion as CSV (default trajectory.csv)",
    )
    planned.add_argument(
        "--max-position",
        type=float,
        metavar="DEG",
        default=85.0,
        help="half of the link's workspace [deg]",
    )
    planned.add_argument(
        "--max-speed", type=float, metavar="DEG_S", default=60.0, help="link speed [deg/s]"
    )
    planned.add_argument(
        "--max-torque",
        type=float,
        metavar="NM",
        default=float("inf"),
        help="drive torque on the link side [Nm]",
    )
    following = verb(
        "next",
        "next_run",
        "the run that would tell names apart; without records, what a planned run cannot show",
    )
    following.add_argument("records", nargs="*", metavar="REC", help="record files")
    following.add_argument("--joint", metavar="J", required=True, help="joint file (TOML)")
    other_payload(following)
    following.add_argument(
        "--held-out",
        nargs="+",
        action="extend",
        metavar="REC",
        default=[],
        help="records the fit must not see",
    )
    following.add_argument(
        "-o", "--output", metavar="FILE", help="the proposed motion as CSV, as `irj plan` writes it"
    )
    following.add_argument(
        "--motion",
        dest="planned",
        metavar="FILE",
        help="without records: the motion that is planned (CSV)",
    )
    for option, unit, text in (
        ("position", "DEG", "half of the link's workspace [deg; m on a linear axis]"),
        ("speed", "DEG_S", "link speed [deg/s; m/s]"),
        ("torque", "NM", "drive torque on the link side [Nm; N]"),
    ):
        following.add_argument(
            f"--max-{option}", type=float, metavar=unit, help=f"{text}; default: as in the records"
        )
    trusted = verb(
        "trust",
        "trust",
        "which number of a fit to trust: intervals, windows, what it trades with; without records "
        "by what the joint file says",
        joint=True,
    )
    trusted.add_argument("records", nargs="*", metavar="REC", help="record files")
    other_payload(trusted)
    plain = verb(
        "linear",
        "records",
        "linear models without physics: subspace and black boxes, orders, poles, held-out VAF",
        records=True,
    )
    plain.add_argument("--joint", metavar="J", help="joint file: column map, gear ratio, drive")
    plain.add_argument(
        "--held-out",
        nargs="+",
        action="extend",
        metavar="REC",
        default=[],
        help="records the fit must not see (default: the last quarter of every stretch)",
    )
    plain.add_argument(
        "--from",
        dest="inputs",
        nargs="+",
        action="extend",
        metavar="CHANNEL",
        default=[],
        help="inputs (default: the drive)",
    )
    plain.add_argument(
        "--to",
        dest="outputs",
        nargs="+",
        action="extend",
        metavar="CHANNEL",
        default=[],
        help="outputs (default: motor_velocity, and torsion = q_m - q_l where --joint and both "
        "positions are there)",
    )
    plain.add_argument(
        "--family",
        nargs="+",
        action="extend",
        metavar="FAMILY",
        default=[],
        help="moesp fir arx arma armax ararx ararmax oe bj (default: all)",
    )
    plain.add_argument(
        "--max-order",
        type=_count,
        default=6,
        metavar="N",
        help="highest order tried (default 6; moesp, whose states serve all outputs, two more)",
    )
    plain.add_argument(
        "--every",
        type=_count,
        metavar="N",
        help="keep every Nth sample (default: from the band in which outputs answer the input)",
    )
    plain.add_argument(
        "--picture", metavar="FILE.svg", help="draw Bode plots and poles of the best model"
    )
    first = verb("joint", "joints", "a first joint file for somebody else's FMU")
    first.add_argument("what", choices=("new",), help="write a new one")
    first.add_argument("fmu", metavar="MODEL.fmu", help="the FMU")
    first.add_argument(
        "--record", metavar="REC", required=True, help="a record of the joint: its channels"
    )
    first.add_argument(
        "--like", metavar="J", help="joint file with the gear ratio and the motor constant"
    )
    first.add_argument("-o", "--output", metavar="J", help="where to write (default: print)")
    joints = verb("joints", "joints", "the library of identified joints")
    joints.add_argument(
        "what",
        choices=("list", "show", "compare"),
        help="list them, show values and where they come from, or put several side by side",
    )
    joints.add_argument("names", nargs="*", metavar="NAME", help="names, types or files of joints")
    joints.add_argument(
        "--library",
        nargs="+",
        action="append",
        metavar="PATH",
        default=[],
        help="more joints: joint files, folders of them, a table of published parameters (.json); "
        "names may follow the path",
    )
    for name, text in (
        ("export", "export as FMU, C or CasADi function"),
        ("cosim", "co-simulate plant and estimator FMU"),
        ("batch", "many runs of a study"),
    ):
        verbs.add_parser(name, help=text, add_help=False).set_defaults(module="fmi", own_effects=[])
    app = verb("app", "page", "the page in your browser")
    app.add_argument(
        "files", nargs="*", metavar="FILES", help="records and a joint file to begin with"
    )
    app.add_argument("--port", type=_port, default=0, help="port of the page (0: any free one)")
    app.add_argument(
        "--follow",
        metavar="FILE",
        action="append",
        default=[],
        help="a CSV file that is being written, udp://HOST:PORT where its lines come, or "
        "ros2://TOPIC of joint states: the Replay page can follow it",
    )
    app.add_argument("--no-browser", action="store_true", help="print the address, open nothing")
    text = "completion of verbs and options for your shell"
    completed = verbs.add_parser("completion", help=text, description=text)
    completed.set_defaults(module="first.help", own_effects=[], parser=made)
    completed.add_argument("shell", choices=("bash",), help="the shell")
    for judged in (demo, diagnosed, improved):
        judged.add_argument(
            "-v", "--verbose", action="store_true", help="list what is not testable, and why"
        )
    with_examples(made)
    for sub in made.verbs.values():
        for action in sub.arguments:
            if action.choices is not None and action.type is None:
                action.type = functools.partial(_one_of, tuple(action.choices))
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Run `irj`; returns the exit code: 0 done, 1 a check failed, 2 unusable input, 3 an
    internal error, 130 interrupted.
    """
    given = list(sys.argv[1:] if argv is None else argv)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(
            errors="backslashreplace"
        )  # a terminal that lacks a sign must not cost the results
    if any("\0" in word for word in given):
        parser().error("an argument holds a zero byte; no name of a file or effect has one")
    if not given:
        return welcome()
    arguments, rest = parser().parse_known_args(given)
    arguments.rest = rest
    if arguments.module == "fmi":
        arguments.rest, arguments.own_effects = _taken(rest)
    if rest and arguments.module != "fmi":
        own = parser().verbs[arguments.verb]
        options = [o for a in own.arguments for o in a.option_strings if a.dest != "help"]
        close = meant(next((r for r in rest if r.startswith("-")), ""), options)
        own.error(f"unrecognized arguments: {' '.join(rest)}{close}")
    arguments.command = shlex.join(["irj", *given])
    STOPPED.clear()
    with _watched_interrupt(), _patient_output():
        try:
            return _run(arguments)
        except InputError as error:
            return fail(str(error))
        except OSError as error:
            return fail(system_refusal(error))
        except MemoryError as error:
            return fail(no_memory(error))
        except KeyboardInterrupt:
            STOPPED.append(signal.SIGINT)
            return stopped()
        except Exception as error:
            return crashed(error, arguments.command)
        finally:
            STOPPED.clear()
            release()


def _run(arguments: argparse.Namespace) -> int:
    check_outputs(arguments)
    _register([*arguments.effects, *arguments.own_effects])
    module = importlib.import_module(f"workbench.cli.{module_of(arguments)}")
    work = getattr(module, f"run_{arguments.verb}")
    with terminable():  # a server heeds the signal itself, and then hands it on
        return int(work(arguments))


@final
class _Patient:
    """Standard output whose reader may leave: what is still printed is dropped, and the work
    goes on to its end.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write, or drop where nobody reads any more."""
        return self._tried(lambda: self._stream.write(text)) or len(text)

    def flush(self) -> None:
        """Flush, or drop where nobody reads any more."""
        self._tried(self._stream.flush)

    def _tried(self, call: Callable[[], int | None]) -> int | None:
        try:
            return call()
        except BrokenPipeError:  # the reader of our output has seen enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())
            return None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextlib.contextmanager
def _patient_output() -> Iterator[None]:
    patient = _Patient(sys.stdout)
    with contextlib.redirect_stdout(cast(TextIO, patient)):
        try:
            yield
        finally:
            patient.flush()


@contextlib.contextmanager
def _watched_interrupt() -> Iterator[None]:
    """Note that the user interrupts; the interrupt itself is raised as ever."""
    if (
        threading.current_thread() is not threading.main_thread()
        or signal.getsignal(signal.SIGINT) is not signal.default_int_handler
    ):
        yield
        return

    def note(number: int, frame: FrameType | None) -> None:
        STOPPED.append(number)
        signal.default_int_handler(number, frame)

    before = sys.unraisablehook

    def lost(error: Any) -> None:
        # compiled code of a library may drop the interrupt that came within it; it is noted
        if not (issubclass(error.exc_type, KeyboardInterrupt) and signal.SIGINT in STOPPED):
            before(error)

    signal.signal(signal.SIGINT, note)
    sys.unraisablehook = lost
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.unraisablehook = before


def _register(files: Sequence[str]) -> None:
    from identification.data.own_effects import register

    for name in files:
        register(name)


def _taken(rest: list[str]) -> tuple[list[str], list[str]]:
    """Words that go through to another parser without ``--effects``, and the files that it
    names.
    """
    parser = OneLineParser(prog="irj", add_help=False, allow_abbrev=False)
    parser.add_argument("--effects", action="append", default=[])
    found, others = parser.parse_known_args(rest)
    return others, found.effects


def improve_json(
    train: Sequence[str | Path], held_out: Sequence[str | Path], joint: str | Path
) -> dict[str, Any]:
    """The loop on files, as the data of `improve --json`."""
    from workbench.cli.loop import improve_files

    found, _, _ = improve_files([str(p) for p in train], [str(p) for p in held_out], str(joint))
    return found


if __name__ == "__main__":
    raise SystemExit(main())
