"""The tables of a joint file, declared: keys, units, meanings, defaults (see :mod:`schema`)."""

from __future__ import annotations

import json
from typing import Final

from casadi_models.transmission import MODELS
from identification.data.channels import KINDS
from identification.data.schema import Key, Schema

SIDES: Final = ("motor", "link", "gear", "sensor", "none")
START_EFFECTS: Final = ("viscous", "coulomb")
"""Effects beyond the model's own that a new joint file begins with."""
OFFERED_EFFECTS: Final = (*START_EFFECTS, "gravity")
"""Effects that are offered first where a start model is put together."""

JOINT: Final = Schema(
    "[joint]",
    "What is known about the joint, and the model to start from. Required. Where motor currents "
    "are recorded, one of `motor_constant` and `torque_per_current` is needed, never both.",
    (
        Key("name", "label", "name in messages and reports", absent="the file's name"),
        Key("kind", "text", "kind of the axis", default="rotary", choices=KINDS),
        Key(
            "gear_ratio",
            "number",
            "theta_motor / theta_link with its sign; 1 where everything is measured on one side",
            unit="1",
            default=1.0,
        ),
        Key(
            "motor_constant",
            "number",
            "torque on the motor shaft per ampere; times `gear_ratio` it is `torque_per_current`",
            unit="N.m/A",
        ),
        Key("torque_per_current", "number", "torque on the link side per ampere", unit="N.m/A"),
        Key(
            "torque_per_voltage",
            "number",
            "torque on the link side per volt, where a voltage is recorded in place of a current",
            unit="N.m/V",
            absent="1",
        ),
        Key("model", "text", "model to start from", default="hd1", choices=tuple(MODELS)),
        Key(
            "effects",
            "names",
            "effects beyond the model's own: `key`, `key@place`, `key#2` for a second one",
            default=(),
            example=f"effects = {json.dumps(START_EFFECTS)}",
        ),
        Key(
            "virtual_work",
            "flag",
            "whether the motor also feels the torque of a kinematic error by virtual work; false: "
            "the thesis's approximation (2.58)",
            default=True,
        ),
    ),
)

KNOWN: Final = Schema(
    "[known] PARAMETER",
    "What is known of a parameter of the model, by catalogue, CAD or weighing: its value, which "
    "is then fixed, or bounds. A number alone is a value. Parameters of the models stand below, "
    "those of the effects in [effects.md](effects.md).",
    (
        Key("value", "number", "the value; a fit leaves it as it stands", unit="`unit`"),
        Key("low", "number", "lower bound", unit="`unit`"),
        Key("high", "number", "upper bound", unit="`unit`"),
        Key("unit", "text", "unit of the three", absent="the parameter's own (SI)"),
        Key(
            "side",
            "text",
            "`motor`: values of the motor shaft, which are referred to the link by the power of "
            "the gear ratio that follows from the unit",
            default="link",
            choices=SIDES,
        ),
        Key("source", "label", "where it is from; not used"),
        Key("note", "label", "a remark; not used"),
    ),
)

KNOWN_LINES: Final = Schema(
    "[known]",
    "Two names in [known] are no parameters: they say where a line of the residual has a name.",
    (
        Key(
            "orders",
            "any",
            "orders beside 1, 2 and 4 per motor turn, such as meshing orders",
            form="list of numbers",
            unit="per motor turn; 1/m on a linear axis",
        ),
        Key(
            "pitch",
            "any",
            "travel of a linear axis per turn of its motor",
            form='number, or `{ value = 10.0, unit = "mm" }`',
            unit="m",
        ),
    ),
)
PITCH: Final = Schema(
    "[known] pitch",
    "",
    (
        Key("value", "number", "travel per turn", unit="`unit`", required=True),
        Key("unit", "text", "unit of it", default="m"),
    ),
)

COLUMN: Final = Schema(
    "[columns] CHANNEL",
    "Where a channel comes from: raw * scale * sign is in `unit`. A text alone names the column. "
    "Channels whose headers are recognised (`motor_current_A`) need no entry.",
    (
        Key("column", "text", "name of the column in the file"),
        Key(
            "formula",
            "text",
            "in place of a column: columns, numbers, `pi`, `+ - * / **`, brackets, sqrt, abs, sin, "
            "cos; a name with spaces or dots stands in single quotes",
        ),
        Key("unit", "text", "unit of raw * scale", absent="that of the file or of the header"),
        Key("scale", "number", "factor", default=1.0),
        Key("sign", "number", "1 or -1", default=1.0),
        Key("counts_per_turn", "number", "encoder counts of one turn, where the unit is `counts`"),
        Key("step", "number", "of `time` only: the file has no stamps, rows are this far apart"),
    ),
)

LAW: Final = Schema(
    "[laws] KEY",
    "A law typed as text ([extending.md](extending.md)): it becomes the effect KEY. All three keys "
    "are needed.",
    (
        Key("law", "text", "the law", required=True),
        Key("on", "names", "places where it acts", required=True, example='on = ["motor"]'),
        Key(
            "parameters",
            "names",
            "name, range and unit of each parameter",
            required=True,
            example='parameters = ["a=1..10 N.m"]',
        ),
    ),
)

OWN_EFFECTS: Final = Schema(
    "[own_effects] FILE",
    "Written by irj: a file of your own effects that the joint uses. It is loaded only where its "
    "content was allowed before ([extending.md](extending.md)).",
    (
        Key("sha256", "text", "digest of the file", required=True),
        Key("keys", "names", "effects that come from it", required=True, example='keys = ["seal"]'),
    ),
)

FITTED: Final = Schema(
    "[fitted] PARAMETER",
    "Written by a fit: the model's values from here on.",
    (
        Key("value", "number", "the value, link-referred", unit="SI", required=True, digits=10),
        Key("stderr", "number", "its standard error", unit="SI", digits=6),
        Key("unit", "text", "its SI unit, for the reader"),
        Key("side", "text", "side on which the parameter acts, for the reader"),
    ),
)

CORRELATION: Final = Schema(
    "[correlation]",
    "Written by a fit: how the standard errors of [fitted] go together. Row k of the triangle "
    "holds the correlations of parameter k + 1 with those before it. Without the table they count "
    "as independent.",
    (
        Key("parameters", "names", "parameters of [fitted]", required=True),
        Key(
            "errors",
            "any",
            "their standard errors if the noise were white, which with the correlations say how "
            "far one moves where another does",
            form="list of numbers",
            unit="SI",
            absent="those of [fitted]",
        ),
        Key(
            "triangle",
            "any",
            "correlations, between -1 and 1",
            form="list of lists of numbers",
            required=True,
        ),
    ),
)

BALANCES: Final = Schema(
    "[balances] BALANCE",
    "Written by a fit: how much it left of each balance. Values that rest on a balance far over "
    "its noise floor may make up for a law that the model lacks; `irj trust` says so.",
    (
        Key(
            "ratio",
            "number",
            "what is left over the noise floor; 1 is noise alone",
            unit="1",
            required=True,
            digits=4,
        ),
        Key("parameters", "names", "parameters of [fitted] that rest on it", default=()),
    ),
)

CALIBRATION: Final = Schema(
    "[calibration] SENSOR AND RECORD",
    "Written by a fit: what a sensor was off by in a record. A note; another record has its own.",
    (
        Key("value", "number", "the value", unit="`unit`", required=True, digits=10),
        Key("stderr", "number", "its standard error", unit="`unit`", digits=6),
        Key("unit", "text", "SI unit"),
    ),
)

PROVENANCE: Final = Schema(
    "[provenance]",
    "Written by a fit, for the reader. Any text may stand here; irj writes these.",
    (
        Key("records", "label", "records of the fit"),
        Key(
            "sample_time",
            "number",
            "their sample time, at which an estimator FMU of this file runs unless told otherwise",
            unit="s",
            absent="0.001",
            digits=6,
        ),
        Key("version", "label", "version of irj"),
    ),
)

PAGES: Final = (
    JOINT,
    KNOWN,
    KNOWN_LINES,
    COLUMN,
    LAW,
    OWN_EFFECTS,
    FITTED,
    CORRELATION,
    BALANCES,
    CALIBRATION,
    PROVENANCE,
)
"""The tables in the order of the reference page."""

__all__ = [
    "BALANCES",
    "CALIBRATION",
    "COLUMN",
    "CORRELATION",
    "FITTED",
    "JOINT",
    "KNOWN",
    "KNOWN_LINES",
    "LAW",
    "OWN_EFFECTS",
    "PAGES",
    "PITCH",
    "PROVENANCE",
    "SIDES",
]
