"""Files that belong to a model, inside its FMU, by the layered standard FMI-LS-REF: the joint file
it was made from, the report of the fit, and a record the fit did not see as an experiment.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, final
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import numpy.typing as npt

from irj_fmu.fmi.model_description import to_bytes
from irj_fmu.fmi.parameter_set import parameter_set

FloatArray = npt.NDArray[np.float64]

NAME: Final = "org.fmi-standard.fmi-ls-ref"
FOLDER: Final = f"extra/{NAME}"
VERSION: Final = "1.0.0-alpha.1"
MANIFEST: Final = "fmi-ls-manifest.xml"
_NAMESPACE: Final = "http://fmi-standard.org/fmi-ls-manifest"
_ABOUT: Final = "Layered Standard providing information on related files included in an FMU."
SSV: Final = "application/x-ssp-parameter-set"


@final
@dataclass(frozen=True)
class Related:
    """One file.

    Attributes
    ----------
    name : str
        Inside the standard's folder.
    content : bytes
    type : str
        MIME type.
    role : str
        One of those that the standard lists, such as "model", "report", "result".
    description : str
    """

    name: str
    content: bytes
    type: str
    role: str
    description: str


def layered(files: Sequence[Related]) -> dict[str, bytes]:
    """The files with their manifest, by their places in an FMU; nothing where there are none."""
    if not files:
        return {}
    root = Element(
        "fmiReferences",
        {
            "xmlns:fmi-ls": _NAMESPACE,
            "fmi-ls:fmi-ls-name": NAME,
            "fmi-ls:fmi-ls-version": VERSION,
            "fmi-ls:fmi-ls-description": _ABOUT,
        },
    )
    for f in files:
        SubElement(
            root,
            "Related",
            {"type": f.type, "source": f.name, "role": f.role, "description": f.description},
        )
    return {
        f"{FOLDER}/{MANIFEST}": to_bytes(root),
        **{f"{FOLDER}/{f.name}": f.content for f in files},
    }


@final
@dataclass(frozen=True)
class Experiment:
    """A run that was measured.

    Attributes
    ----------
    name, description : str
    time : (n,) array
        From zero [s].
    inputs, outputs : mapping of str to (n,) array
        What drives the FMU, and what it should give, by its variables.
    starts : mapping of str to float
        Start values of its variables.
    """

    name: str
    description: str
    time: FloatArray
    inputs: Mapping[str, FloatArray]
    outputs: Mapping[str, FloatArray]
    starts: Mapping[str, float]


def experiment_files(run: Experiment) -> list[Related]:
    """An experiment with its stimuli, reference and start values."""
    root = Element("Experiments")
    step = float(np.median(np.diff(run.time)))
    about = {
        "name": run.name,
        "description": run.description,
        "startTime": repr(float(run.time[0])),
        "stopTime": repr(float(run.time[-1])),
        "stepSize": f"{step:.9g}",
    }
    names = {what: f"{run.name}_{what}" for what in ("start.ssv", "in.csv", "ref.csv")}
    node = SubElement(root, "Experiment", about)
    SubElement(node, "Parameters", {"source": names["start.ssv"]})
    SubElement(node, "Stimuli", {"source": names["in.csv"]})
    SubElement(node, "References", {"source": names["ref.csv"]})
    return [
        Related(
            f"{run.name}_experiment.xml",
            to_bytes(root),
            "application/xml",
            "experiment/validation",
            run.description,
        ),
        Related(
            names["start.ssv"],
            parameter_set(run.name, {n: ("Real", float(x)) for n, x in run.starts.items()}),
            SSV,
            "parameter",
            f"Start values of {run.name}.",
        ),
        Related(
            names["in.csv"],
            csv_text(run.time, run.inputs),
            "text/csv",
            "other",
            f"What drove {run.name}.",
        ),
        Related(
            names["ref.csv"],
            csv_text(run.time, run.outputs),
            "text/csv",
            "result",
            f"What was measured in {run.name}.",
        ),
    ]


def csv_text(time: FloatArray, columns: Mapping[str, FloatArray]) -> bytes:
    """Signals over time as hosts and the FMI Cross-Check read them: quoted names, time first."""
    lines = [",".join(f'"{n}"' for n in ("time", *columns))]
    table = np.column_stack([time, *columns.values()])
    # the times as they are meant: 0.07, not 0.07000000000000001
    lines += [",".join([f"{row[0]:.9g}", *map(repr, row[1:])]) for row in table.tolist()]
    return ("\n".join(lines) + "\n").encode()


__all__ = ["FOLDER", "MANIFEST", "Experiment", "Related", "csv_text", "experiment_files", "layered"]
