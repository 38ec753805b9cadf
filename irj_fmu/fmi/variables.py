"""The declaration of one FMU variable, shared by plants and slaves."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, final

from identification.errors import InputError

Kind = Literal["real", "integer", "boolean", "string"]
Causality = Literal["input", "output", "parameter", "local"]
Variability = Literal["continuous", "discrete", "fixed", "tunable"]
Value = float | int | bool | str

_PART = r"[A-Za-z_]\w*(\[\d+(,\d+)*\])?"
_NAME = re.compile(rf"(?P<der>der\()?{_PART}(\.{_PART})*(?(der)\))", re.ASCII)


@final
@dataclass(frozen=True)
class Variable:
    """One scalar variable of an FMU.

    Parameters
    ----------
    name : str
        Structured name, e.g. ``theta[3]`` or ``motor.position``.
    unit : str
        Unit of `start`, `minimum`, `maximum` and `nominal`, e.g. ``N.m/rad``; empty for none.
    start : float, int, bool or str
        Value before the first step.
    minimum, maximum, nominal : float, optional
        Bounds and order of magnitude.
    description : str
        One sentence.
    causality : {"input", "output", "parameter", "local"}
        Ignored by `PlantSpec`, whose groups say it.
    variability : {"continuous", "discrete", "fixed", "tunable"}, optional
        By default fixed for parameters, continuous for other reals, discrete for the rest.
    kind : {"real", "integer", "boolean", "string"}
        FMI type.
    display_unit : str, optional
        Unit in which a host shows the value, e.g. ``deg`` for ``rad``.

    Raises
    ------
    InputError
        Where the name is not a structured FMI name or the start value lies outside the bounds.
    """

    name: str
    unit: str = ""
    start: Value = 0.0
    minimum: float | None = None
    maximum: float | None = None
    nominal: float | None = None
    description: str = ""
    causality: Causality = "local"
    variability: Variability | None = None
    kind: Kind = "real"
    display_unit: str | None = None

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise InputError(
                f"FMU variable {self.name!r}: not a structured name; use letters, digits, _ . "
                "and [k]"
            )
        if self.kind == "string":
            return
        value = float(self.start)
        if (
            self.minimum is not None
            and value < self.minimum
            or self.maximum is not None
            and value > self.maximum
        ):
            raise InputError(
                f"FMU variable {self.name!r}: start {value:g} lies outside [{self.minimum}, "
                f"{self.maximum}]; widen the bounds or move the start"
            )

    @property
    def stated_variability(self) -> Variability:
        """The variability, with the default for its kind filled in."""
        if self.variability is not None:
            return self.variability
        if self.causality == "parameter":
            return "fixed"
        return "continuous" if self.kind == "real" else "discrete"


def check_unique(variables: tuple[Variable, ...]) -> None:
    """Raise `InputError` where two variables share a name."""
    seen: set[str] = set()
    for variable in variables:
        if variable.name in seen:
            raise InputError(
                f"FMU variable {variable.name!r} is declared twice; give each variable its own name"
            )
        seen.add(variable.name)
