"""What the terminal says by itself: first steps, examples of every verb, completion."""

from __future__ import annotations

import argparse
import os
import sys
from argparse import Namespace
from collections.abc import Mapping
from typing import Final

from irj_fmu.command_line import OneLineParser

EXAMPLES: Final[Mapping[str, tuple[str, ...]]] = {
    "demo": ("irj demo", "irj demo --picture demo.svg"),
    "import": (
        "irj import run1.csv",
        "irj import run1.csv --gear-ratio -160 --motor-constant 0.0553 -o joint.toml",
        "irj import robot.csv --joint-number 3 -o axis3.toml",
    ),
    "check": ("irj check run1.csv run2.csv --joint joint.toml",),
    "resample": ("irj resample run1.csv --joint joint.toml -o even.npz",),
    "fit": ("irj fit run1.csv --joint joint.toml -o fitted.toml",),
    "compare": ("irj compare run2.csv --fit run1.csv --joint joint.toml",),
    "diagnose": (
        "irj diagnose run1.csv --held-out run2.csv --joint joint.toml",
        "irj diagnose run1.csv --joint joint.toml --why stribeck",
    ),
    "improve": (
        "irj improve run1.csv --held-out run2.csv --joint joint.toml -o better.toml",
        "irj improve run1.csv --joint joint.toml --report report.html --json result.json",
    ),
    "explore": ("irj explore run1.csv --held-out run2.csv --joint joint.toml --picture all.svg",),
    "changed": ("irj changed fitted.toml today.csv",),
    "report": ("irj report run1.csv --held-out run2.csv --joint joint.toml -o report.html",),
    "effects": ("irj effects", "irj effects stribeck"),
    "add": (
        "irj add stribeck@motor --joint joint.toml -o more.toml",
        'irj add --law "a*tanh(v/b)" --on motor --parameter "a=0..10 N.m" --parameter '
        '"b=0.01..1 rad/s" --joint joint.toml -o more.toml',
    ),
    "show": ("irj show --joint fitted.toml", "irj show --joint fitted.toml --format latex"),
    "simulate": ("irj simulate --joint joint.toml --hide stribeck@motor -o run.csv",),
    "track": ("irj track run2.csv --joint fitted.toml --healthy run1.csv --report track.html",),
    "plan": ("irj plan --joint fitted.toml --max-speed 90 -o motion.csv",),
    "next": ("irj next run1.csv --joint joint.toml -o motion.csv",),
    "linear": ("irj linear run1.csv --held-out run2.csv --joint joint.toml",),
    "twostep": ("irj twostep run1.csv --joint joint.toml -o fitted.toml",),
    "prefilter": ("irj prefilter run1.csv --joint joint.toml --cutoff 40 -o smooth.csv",),
    "accelerometer": ("irj accelerometer --up up.csv --down down.csv",),
    "trust": ("irj trust run1.csv --joint joint.toml",),
    "joint": ("irj joint new robot.fmu --record run1.csv -o joint.toml",),
    "joints": ("irj joints list", "irj joints compare axis1.toml axis2.toml"),
    "app": ("irj app", "irj app run1.csv run2.csv joint.toml"),
    "completion": ('eval "$(irj completion bash)"', "irj completion bash > ~/.irj-completion"),
}
"""Commands to copy, by verb; `check`, `fit`... take several records alike."""

FIRST: Final = """\
irj tells which physics a geared joint's model is missing.

  irj demo                                           see it at work, without data
  irj import run.csv -o joint.toml                   look at a record, write its joint file
  irj improve run.csv --joint joint.toml             name what is missing, watch the error fall

irj --help lists every verb, irj VERB --help shows how it is used; irj app opens the page.
"""


def welcome() -> int:
    """What `irj` alone says."""
    sys.stdout.write(FIRST)
    return 0


def with_examples(parser: OneLineParser) -> None:
    """Put the examples below the help of every verb."""
    for name, sub in parser.verbs.items():
        if name in EXAMPLES and sub.add_help:
            sub.formatter_class = argparse.RawDescriptionHelpFormatter
            sub.epilog = "examples:\n" + "\n".join(f"  {line}" for line in EXAMPLES[name])


def run_completion(arguments: Namespace) -> int:
    """`irj completion bash`: a script for the shell, made from the declared verbs and options."""
    sys.stdout.write(bash(arguments.parser))
    return 0


def bash(parser: OneLineParser) -> str:
    """Completion for bash: verbs first, then the options of the verb and files."""
    verbs = parser.verbs
    cases = [f'    {name}) words="{" ".join(_words(sub))}" ;;' for name, sub in verbs.items()]
    return "\n".join(
        [
            '# completion of irj for bash: eval "$(irj completion bash)"',
            "_irj() {",
            '  local now="${COMP_WORDS[COMP_CWORD]}" verb="" words="" word',
            '  for word in "${COMP_WORDS[@]:1:COMP_CWORD-1}"; do',
            '    case "$word" in -*) ;; *) verb="$word"; break ;; esac',
            "  done",
            '  case "$verb" in',
            f'    "") words="{" ".join([*verbs, *_options(parser)])}" ;;',
            *cases,
            "  esac",
            '  COMPREPLY=( $(compgen -W "$words" -- "$now") )',
            '  [[ -n "$verb" && "$now" != -* ]] && COMPREPLY+=( $(compgen -f -- "$now") )',
            "}",
            "complete -o filenames -F _irj irj",
            "",
        ]
    )


def _options(parser: OneLineParser) -> list[str]:
    return [o for a in parser.arguments for o in a.option_strings if o.startswith("--")]


def _words(parser: OneLineParser) -> list[str]:
    fixed = [
        str(c) for a in parser.arguments if a.choices and not a.option_strings for c in a.choices
    ]
    return [*parser.verbs, *fixed, *_options(parser)]


def bold(text: str) -> str:
    """The text in bold on a terminal that shows colours; as it is in a file or a pipe."""
    return f"\x1b[1m{text}\x1b[0m" if _coloured() else text


def _coloured() -> bool:
    return (
        sys.stdout.isatty()
        and not os.environ.get("NO_COLOR")  # https://no-color.org
        and os.environ.get("TERM") != "dumb"
    )


__all__ = [
    "EXAMPLES",
    "bash",
    "bold",
    "run_completion",
    "welcome",
    "with_examples",
]
