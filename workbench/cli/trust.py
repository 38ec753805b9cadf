"""trust: which number of a fit stands by itself."""

from __future__ import annotations

from argparse import Namespace

from identification.fitting.fit import fit
from identification.fitting.trust import trust
from workbench.cli.files import alike, distinct, open_joint, write_json
from workbench.cli.loop import training


def run_trust(arguments: Namespace) -> int:
    """`irj trust REC... --joint J`."""
    distinct(training=arguments.records, other_payload=arguments.other_payload)
    joint = open_joint(arguments.joint)
    records, warnings = training(arguments.records, arguments.other_payload, joint)
    alike([*arguments.records, *arguments.other_payload], records, joint)
    fitted = fit(joint, records)
    found = trust(fitted.solution, fitted.data)
    print(f"relative error {fitted.train.relative_error_percent:.3f} %; 95 % intervals in brackets")
    print(found)
    write_json(
        arguments.json,
        {"records": list(fitted.data.train_names), "trust": found.as_json(), "warnings": warnings},
    )
    return 0
