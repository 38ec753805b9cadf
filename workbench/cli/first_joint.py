"""joint: a first joint file for somebody else's FMU."""

from __future__ import annotations

import sys
from argparse import Namespace

from identification.errors import InputError
from workbench.cli.files import open_joint, open_records, write_json, write_text


def run_joint(arguments: Namespace) -> int:
    """`irj joint new MODEL.fmu --record REC`."""
    from irj_fmu.first_joint import first_joint
    from irj_fmu.host.fmu import FmuError

    known = open_joint(arguments.like) if arguments.like else None
    records, _ = open_records([arguments.record], known)
    try:
        text = first_joint(arguments.fmu, records[0], known)
    except FmuError as error:
        raise InputError(str(error)) from error
    guesses = [line for line in text.splitlines() if "#" in line]
    if arguments.output:
        write_text(arguments.output, text)
        print("\n".join(guesses))
        print(f"joint file: {arguments.output}")
    else:
        sys.stdout.write(text)
    write_json(arguments.json, {"file": arguments.output, "guesses": guesses})
    return 0
