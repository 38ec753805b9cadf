"""export, cosim, batch: the doors to FMI."""

from __future__ import annotations

from argparse import Namespace
from importlib import import_module
from typing import Any

from identification.errors import InputError


def run_export(arguments: Namespace) -> int:
    """`irj export`."""
    from irj_fmu.build import main

    options = [arguments.what, "--joint", arguments.joint, "--out", arguments.out]
    options += ["--cc", arguments.cc] if arguments.cc else []
    options += ["--target", arguments.target] if arguments.target else []
    return int(main(options))


def run_cosim(arguments: Namespace) -> int:
    """`irj cosim`."""
    try:
        cosim: Any = import_module("irj_fmu.cosim")
    except ImportError:
        raise InputError("cosim is not part of this version; build the FMUs with `irj export all` and co-simulate them in any FMI host") from None
    return int(cosim.main(["--joint", arguments.joint, "--out", arguments.out]))


def run_batch(arguments: Namespace) -> int:
    """`irj batch`."""
    try:
        batch: Any = import_module("irj_fmu.batch")
    except ImportError:
        raise InputError("batch is not part of the command line yet; use irj_fmu.fleet.run_fleet from Python") from None
    return int(batch.main([arguments.study]))
