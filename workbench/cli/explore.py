"""explore: all variants of a joint's model, held against each other."""

from __future__ import annotations

import io
import json
from argparse import Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from identification.data.record import Record
from identification.diagnosis.improvement import Improvement
from identification.errors import InputError
from identification.fitting.trust import Trust
from identification.variants.exploration import Exploration, table_of
from identification.variants.explore import explore
from irj_fmu.command_line import check_folder, finite, keep_inputs, replace_files
from workbench.cli.files import (
    alike,
    distinct,
    open_joint,
    open_records,
    progress_bar,
    write_json,
    write_text,
)
from workbench.cli.loop import print_warnings, training, trusted
from workbench.show.front import exploration_picture

FILES: Final = ("variants.parquet", "explore.json", "explore.svg")
"""What `--out` writes."""


def run_explore(arguments: Namespace) -> int:
    """`irj explore`."""
    begun(arguments)
    joint = open_joint(arguments.joint)
    records, _ = training(arguments.records, arguments.other_payload, joint)
    held, _ = open_records(arguments.held_out, joint)
    paths = [*arguments.records, *arguments.other_payload, *arguments.held_out]
    alike(paths, [*records, *held], joint)
    found = explore(records, joint, held, progress=progress_bar)
    progress_bar("done", 1.0)
    print_warnings(found.warnings, [*records, *held])
    print_exploration(found)
    every = [*records, *held]
    delivered(arguments, found, found.as_json(), every, found.to_joint_file, judge=trusted)
    return 0


def begun(arguments: Namespace) -> None:
    """Refuse what cannot be done before any work is."""
    distinct(
        training=arguments.records,
        other_payload=arguments.other_payload,
        held_out=arguments.held_out,
    )
    if arguments.out:
        paths = [*arguments.records, *arguments.other_payload, *arguments.held_out]
        _writable(Path(arguments.out))
        keep_inputs([Path(arguments.out) / n for n in FILES], [*paths, arguments.joint])


def delivered(
    arguments: Namespace,
    found: Exploration,
    data: Any,
    records: Sequence[Record],
    joint_text: Callable[[], str],
    *,
    judge: Callable[[Improvement], Trust | None] = lambda _found: None,
) -> None:
    """Write the files that were asked for: variants, picture, joint file, JSON and report.

    Parameters
    ----------
    arguments : Namespace
    found : Exploration
    data : JSON
        Of `--json`.
    records : sequence of Record
    joint_text : callable
        Text of the joint file of the recommended variant.
    judge : callable
        Which number of the loop the report trusts; by default it does not say.
    """
    if arguments.out:
        made = (
            parquet(found),
            (json.dumps(finite(data), indent=1, allow_nan=False) + "\n").encode(),
            exploration_picture(found).encode(),
        )
        for path in replace_files(Path(arguments.out), dict(zip(FILES, made, strict=True))):
            print(path)
    if arguments.picture:
        write_text(arguments.picture, exploration_picture(found))
        print(f"picture: {arguments.picture}")
    if arguments.output:
        write_text(arguments.output, joint_text())
        print(f"joint file: {arguments.output}")
    write_json(arguments.json, data)
    if arguments.report:
        from workbench.show.report import write_report

        made_report = write_report(
            found.improvement,
            arguments.report,
            records=records,
            command=arguments.command,
            trust=judge(found.improvement),
            exploration=found,
        )
        print(f"report: {made_report}")


def _writable(folder: Path) -> None:
    """Refuse a folder that cannot be written before any work is done, and Parquet without its
    package.
    """
    check_folder(folder)
    _pyarrow()


def _pyarrow() -> Any:
    try:
        import pyarrow as pa
        import pyarrow.parquet
    except ImportError:
        raise InputError(
            "--out: writing Parquet needs the package pyarrow: pip install irj[parquet]"
        ) from None
    return pa, pyarrow.parquet


def parquet(found: Exploration) -> bytes:
    """The variants as a Parquet table, one row each, the best first."""
    pa, writer = _pyarrow()
    rows = [
        {**{k: v for k, v in row.items() if k != "held_out"}, **row["held_out"]}
        for row in finite([v.as_json() for v in found.variants])
    ]
    stream = io.BytesIO()
    writer.write_table(pa.Table.from_pylist(rows), stream)
    return stream.getvalue()


def print_exploration(found: Exploration) -> None:
    """The table of variants and what follows from it, for a reader."""
    if found.data.note:
        print(f"note: {found.data.note}")
    for line in table_of(found):
        print(line)
    print(
        f"stability: best in {found.recommended.chosen_percent:.0f} % of resampled records; in "
        f"{len(found.windows)} parts of them one after the other: {_counted(found.windows)}"
    )
    for record, name in found.by_record:
        print(f"  {record} alone: {name}")
    for s in found.stand_ins:
        if s.tied:
            print(
                f"stands in: {s.by} for {s.effect} (error {s.lost_percent:+.1f} %, not told apart)"
            )


def _counted(names: tuple[str, ...]) -> str:
    """Names with how often they come, the most frequent first."""
    each = sorted(set(names), key=lambda n: -names.count(n))
    return ", ".join(f"{n} ({names.count(n)})" for n in each)
