"""Why answers fail: each failed case again without troubles, then with one trouble at a time.

``python -m tests.recorded_world.causes OUT --json CAUSES`` reads the answers of a campaign. A case
that fails without any trouble is the engine's own ("no trouble needed"); otherwise every trouble
that breaks it alone is a cause, and where none does, it takes several together. Troubles that
change nothing in a case are not run.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.recorded_world.campaign import Job, load, run_job
from tests.recorded_world.scoring import Answer
from tests.recorded_world.world import RECORDS, SECONDS, TROUBLES

ENGINE = "no trouble needed"
TOGETHER = "several together"


def acts(job: Job, clean: Job) -> bool:
    """Whether the troubles that are left in a job change what is recorded."""
    one, other = job.case(), clean.case()
    return any(
        not np.array_equal(one.measured[r], other.measured[r])
        or not np.array_equal(one.time[r], other.time[r])
        for r in RECORDS
    )


def causes(job: Job) -> list[tuple[str, Job, Answer]]:
    """Causes of a failed case, with the job that shows each and its answer."""
    clean = replace(job, without=TROUBLES)
    answer = run_job(clean)
    if answer is None:
        return []
    if not answer.all_right:
        return [(ENGINE, clean, answer)]
    found = []
    for trouble in TROUBLES:
        alone = replace(job, without=tuple(t for t in TROUBLES if t != trouble))
        if not acts(alone, clean):
            continue
        answer = run_job(alone)
        if answer is not None and not answer.all_right:
            found.append((trouble, alone, answer))
    return found or [(TOGETHER, job, answer)] if answer else []


def said(answer: Answer) -> str:
    """What went wrong, in a few words."""
    if answer.error:
        return f"refused: {answer.error}"
    missing = (
        [n for n in answer.hidden if n not in answer.found] if answer.kind != "outside" else []
    )
    words = [f"not found: {', '.join(missing)}"] if missing else []
    words += [f"wrong: {', '.join(answer.wrong)}"] if answer.wrong else []
    words += [f"verdict {answer.verdict} at ratio {answer.ratio:.1f}"]
    return "; ".join(words)


def markdown(rows: list[dict[str, object]]) -> str:
    """One line per cause, with a command that shows it; then the single cases."""
    groups: dict[str, list[dict[str, object]]] = defaultdict(list)
    for row in rows:
        groups[str(row["cause"])].append(row)
    text = ["| cause | cases | shown by |", "|---|---|---|"]
    for cause, part in sorted(groups.items(), key=lambda x: -len(x[1])):
        shortest = min(part, key=lambda r: len(str(r["command"])))
        text.append(f"| {cause} | {len(part)} | `{shortest['command']}` |")
    text += ["", "| case | hidden | cause | what is said |", "|---|---|---|---|"]
    text += [
        f"| {r['case']} | {r['hidden']} | {r['cause']} | {str(r['said']).replace('|', ' or ')} |"
        for r in rows
    ]
    return "\n".join(text) + "\n"


def main(argv: list[str] | None = None) -> int:
    """Read answers, find causes, print them."""
    p = argparse.ArgumentParser(prog="python -m tests.recorded_world.causes", description=__doc__)
    p.add_argument("answers", type=Path, help="the file of a campaign's --json")
    p.add_argument("--json", type=Path, help="one line per cause; goes on where this file ends")
    p.add_argument(
        "--seconds", type=float, default=SECONDS, help="length of each record, as in the campaign"
    )
    p.add_argument("--limit", type=float, default=180.0, help="processor seconds for one answer")
    p.add_argument(
        "--budget", type=float, default=0.0, help="stop before a new case after so many seconds"
    )
    options = p.parse_args(argv)
    rows: list[dict[str, object]] = []
    if options.json and options.json.exists():
        rows = [
            json.loads(x)
            for x in options.json.read_text(encoding="utf-8").splitlines()
            if x.strip()
        ]
    done = {r["case"] for r in rows}
    began = time.perf_counter()
    for failed in (a for a in load(options.answers) if not a.all_right):
        name = f"{failed.seed} {failed.sensors}"
        if name in done:
            continue
        if options.budget and time.perf_counter() - began > options.budget:
            sys.stderr.write("time is up; start again with the same --json to go on\n")
            break
        job = Job(failed.seed, failed.sensors, limit=options.limit, seconds=options.seconds)
        drawn = job.case()
        if (drawn.kind, drawn.size) != (failed.kind, failed.size):  # the campaign asked for these
            job = replace(job, kind=failed.kind, size=failed.size)
        for cause, shows, answer in causes(job):
            row: dict[str, object] = {
                "case": name,
                "hidden": "+".join(failed.hidden) or "nothing",
                "cause": cause,
                "command": shows.command,
                "said": said(answer),
            }
            rows.append(row)
            if options.json:
                with options.json.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
        sys.stderr.write(
            f"{name}: {', '.join(str(r['cause']) for r in rows if r['case'] == name)}\n"
        )
    sys.stdout.write(markdown(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
