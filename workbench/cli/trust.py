"""trust: which number of a fit stands by itself."""

from __future__ import annotations

import sys
from argparse import Namespace

from identification.data.joint_file import Joint
from identification.errors import InputError
from identification.fitting.assess import RATIO_LIMIT
from identification.fitting.fit import fit
from identification.fitting.trust import trust, trusted_file
from workbench.cli.files import alike, distinct, open_joint, write_json
from workbench.cli.loop import training


def run_trust(arguments: Namespace) -> int:
    """`irj trust [REC...] --joint J`: without records what the file itself says."""
    distinct(training=arguments.records, other_payload=arguments.other_payload)
    joint = open_joint(arguments.joint)
    if not arguments.records:
        return _of_file(joint, arguments)
    records, warnings = training(arguments.records, arguments.other_payload, joint)
    alike([*arguments.records, *arguments.other_payload], records, joint)
    fitted = fit(joint, records)
    found = trust(fitted.solution, fitted.data)
    over = {b: e.ratio for b, e in fitted.train.balances.items() if e.ratio > RATIO_LIMIT}
    if over:  # an interval is one of this model, and says nothing of another
        said = ", ".join(f"{b} {ratio:.3g}" for b, ratio in over.items())
        warnings = [
            *warnings,
            f"the model leaves more than the measurement noise ({said} times its floor): its "
            "values may make up for what is missing; irj improve says what",
        ]
        print(f"irj: {warnings[-1]}", file=sys.stderr)
    print(f"relative error {fitted.train.relative_error_percent:.3f} %; 95 % intervals in brackets")
    print(found)
    write_json(
        arguments.json,
        {"records": list(fitted.data.train_names), "trust": found.as_json(), "warnings": warnings},
    )
    return 0


def _of_file(joint: Joint, arguments: Namespace) -> int:
    """By the standard errors and correlations that the file holds."""
    if arguments.other_payload:
        raise InputError("trust: --other-payload goes with records; give those, too")
    found = trusted_file(joint)
    if not joint.correlation.names:
        print(
            f"irj: {arguments.joint}: does not say how its standard errors go together; what "
            "trades with what needs the records, or a new fit (irj fit -o)",
            file=sys.stderr,
        )
    print("from the joint file alone; 95 % intervals in brackets")
    print(found)
    write_json(arguments.json, {"records": [], "trust": found.as_json(), "warnings": []})
    return 0
