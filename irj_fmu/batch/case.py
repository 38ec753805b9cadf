"""A batch: many co-simulations of one FMU, before anything runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import final

import numpy as np

from irj_fmu.host.fmu import Number
from irj_fmu.host.signals import FloatArray, Table


@final
@dataclass(frozen=True)
class Batch:
    """Many co-simulations of one FMU.

    Parameters
    ----------
    fmu : Path
        The FMU.
    cases : sequence of mapping
        Start values by variable name, one mapping per run.
    record : sequence of str
        Variables to record.
    inputs : mapping
        Input name to samples, the same for all cases.
    step, stop : float
        Communication step and length in s.
    chunk : int
        Runs that one worker takes at a time; also what is run again after an interruption.
    every : int
        Keep every n-th sample, beginning with the first; the figures see all.
    measured : mapping
        Recorded variable to the signal it is compared with.
    """

    fmu: Path
    cases: Sequence[Mapping[str, Number | str]]
    record: Sequence[str]
    inputs: Mapping[str, Table] = field(default_factory=dict)
    step: float = 1e-3
    stop: float = 1.0
    chunk: int = 20
    every: int = 1
    measured: Mapping[str, Table] = field(default_factory=dict)

    @property
    def time(self) -> FloatArray:
        """Times of the samples that are kept."""
        times: FloatArray = (
            self.step * np.arange(round(self.stop / self.step) + 1, dtype=np.float64)[:: self.every]
        )
        return times
