"""The tables of a study file, declared: keys, units, meanings, defaults."""

from __future__ import annotations

from typing import Final

from identification.data.schema import Key, Schema

FORMATS: Final = ("npz", "csv", "none")
KINDS: Final = ("plant", "estimator")
METHODS: Final = ("independent", "latin")
SPACINGS: Final = ("linear", "log")
TASKS: Final = ("fit", "improve", "explore")

STUDY: Final = Schema(
    "[study]",
    "The runs as a whole.",
    (
        Key("name", "label", "name in the messages", absent="the file's name"),
        Key(
            "step",
            "number",
            "communication step",
            unit="s",
            absent="the record's sample time, else the FMU's own, else 1 ms",
        ),
        Key("stop", "number", "length", unit="s", absent="the record's length"),
        Key("record", "any", "variables to record", absent="all outputs", form="list of texts"),
        Key("every", "any", "keep each n-th sample of the series", default=1, form="whole number"),
        Key(
            "chunk",
            "any",
            "runs that one worker takes at a time",
            absent="total / 64, from 1 to 20, and at most 64 MB",
            form="whole number",
        ),
        Key("format", "text", "file of the series", default="npz", choices=FORMATS),
    ),
)

MODEL: Final = Schema(
    "[[model]]",
    "One model, as often as there are models. One of `fmu` and `joint` is needed; all keys but "
    "`name` and `set` go with a joint file.",
    (
        Key("name", "label", "name in the table", absent="the file's name"),
        Key("fmu", "text", "an FMI 2.0 co-simulation FMU, taken as it is"),
        Key("joint", "text", "a joint file; an FMU is built of it"),
        Key("kind", "text", "what is built", default="plant", choices=KINDS),
        Key("add", "any", "effects added to the joint file's", form="list of texts"),
        Key("drop", "any", "effects left out", form="list of texts"),
        Key("set", "any", "parameters of all runs of this model", unit="SI", form="table"),
        Key("controller", "flag", "plant: position controller", default=False),
        Key("motion", "flag", "plant: built-in motion for the controller", default=False),
        Key("sensors", "flag", "plant: noise and faults of sensors as parameters", default=False),
    ),
)

RECORDS: Final = Schema(
    "[records]",
    "Records that drive the models; every model runs with every record.",
    (
        Key(
            "files",
            "any",
            "`*` and `?` stand for all files that fit",
            form="list of texts",
            required=True,
        ),
        Key("columns", "text", "TOML file with a column map", absent="that of the first joint"),
        Key("start_state", "flag", "plants start where the record starts", default=True),
    ),
)

INPUT: Final = Schema(
    "[inputs] INPUT",
    "What feeds an input of a model: a channel's name, a number, or a table of these.",
    (
        Key("time", "any", "times", unit="s", form="list of numbers"),
        Key("value", "any", "values at these times", unit="SI", form="list of numbers"),
        Key("hold", "flag", "a value holds until the next; false: lines between", default=True),
    ),
)

COMPARE: Final = Schema(
    "[compare]",
    '`output = "channel"`: an output of the model and the measured channel it is compared with. '
    "Outputs with the name of a channel are compared by themselves.",
    (),
)

AXIS: Final = Schema(
    "[grid] PARAMETER",
    "Every combination of the points: a list of values, or a table of these.",
    (
        Key("low", "number", "first point", unit="SI", required=True),
        Key("high", "number", "last point", unit="SI", required=True),
        Key("count", "any", "number of points, 2 or more", form="whole number", required=True),
        Key("spacing", "text", "how they lie", default="linear", choices=SPACINGS),
    ),
)

CASE: Final = Schema(
    "[[case]]",
    "One row of a list: values by the names of parameters.",
    (),
)

RANDOM: Final = Schema(
    "[random]",
    "Draws of parameters.",
    (
        Key("count", "any", "number of draws", form="whole number", required=True),
        Key("seed", "any", "seed of the draws", default=0, form="whole number"),
        Key("method", "text", "how they are drawn", default="independent", choices=METHODS),
        Key("parameters", "any", "see below", form="table", required=True),
    ),
)

DRAW: Final = Schema(
    "[random.parameters] PARAMETER",
    "The distribution of one parameter: low and high, mean and deviation, or choose.",
    (
        Key("low", "number", "lower end of a range", unit="SI"),
        Key("high", "number", "upper end", unit="SI"),
        Key("spacing", "text", "of the range", default="linear", choices=SPACINGS),
        Key("mean", "number", "mean of a normal distribution", unit="SI"),
        Key("deviation", "number", "its standard deviation", unit="SI"),
        Key("choose", "any", "values, each as likely as the others", form="list"),
    ),
)

FIT_STUDY: Final = Schema(
    "[study] with a task",
    "Joints are fitted to records in place of being simulated. Beside it only [[joint]] may stand.",
    (
        Key("name", "label", "name in the messages", absent="the file's name"),
        Key("task", "text", "what is done with each joint", choices=TASKS, required=True),
    ),
)

FIT_JOINT: Final = Schema(
    "[[joint]]",
    "One joint with its records, as often as there are joints.",
    (
        Key("name", "label", "name in the table", absent="the file's name"),
        Key("joint", "any", "the joint file", form="text", required=True),
        Key("records", "any", "training records, `*` and `?` too", form="list", required=True),
        Key("held_out", "any", "records that the fit must not see", form="list of texts"),
        Key("each", "flag", "each record is a job of its own", default=False),
    ),
)

PAGES: Final = (
    STUDY,
    MODEL,
    RECORDS,
    INPUT,
    COMPARE,
    AXIS,
    CASE,
    RANDOM,
    DRAW,
    FIT_STUDY,
    FIT_JOINT,
)
"""The tables in the order of the reference page."""
TABLES: Final = ("study", "model", "records", "inputs", "compare", "grid", "case", "random")

__all__ = [
    "AXIS",
    "CASE",
    "COMPARE",
    "DRAW",
    "FIT_JOINT",
    "FIT_STUDY",
    "FORMATS",
    "INPUT",
    "KINDS",
    "METHODS",
    "MODEL",
    "PAGES",
    "RANDOM",
    "RECORDS",
    "SPACINGS",
    "STUDY",
    "TABLES",
    "TASKS",
]
