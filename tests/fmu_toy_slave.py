"""A small slave for the tests: recursive least squares of one gain and offset in numpy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from fmu_toy_helper import SCALE

from irj_fmu.fmi.slave_base import TableSlave
from irj_fmu.fmi.variables import Value, Variable


@dataclass(frozen=True)
class Gains:
    """A frozen dataclass with postponed annotations: needs its module in sys.modules."""

    forgetting: float


class ToySlave(TableSlave):
    """y = theta[0] u + theta[1]."""

    default_sample_time = 1e-3
    summary = "Recursive least squares of a line."
    variables = (
        Variable("u", "A", 0.7, causality="input"),
        Variable("y", "N.m", 1.9, causality="input"),
        Variable("fail", start=False, causality="input", kind="boolean"),
        Variable(
            "forgetting",
            start=0.999,
            minimum=0.5,
            maximum=1.0,
            causality="parameter",
            variability="tunable",
        ),
        Variable("theta[1]", "N.m/A", causality="output"),
        Variable("theta[2]", "N.m", causality="output"),
        Variable("scale", start=0.0, causality="output"),
        Variable("file", start="", causality="parameter", kind="string"),
    )

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.theta = np.zeros(2)
        self.covariance = np.eye(2) * 1e3
        self.gains = Gains(1.0)

    def configure(self, parameters: Mapping[str, Value]) -> None:
        self.gains = Gains(float(parameters["forgetting"]))

    def process(self, time: float, step: float, inputs: Mapping[str, Value]) -> Mapping[str, Value]:
        from fmu_toy_helper import scale_again  # imported late on purpose

        if inputs["fail"]:
            raise RuntimeError("told to fail at 100 %s")
        h = np.array([float(inputs["u"]), 1.0])
        gain = self.covariance @ h / (self.gains.forgetting + h @ self.covariance @ h)
        self.theta = self.theta + gain * (float(inputs["y"]) - h @ self.theta)
        self.covariance = (
            self.covariance - np.outer(gain, h @ self.covariance)
        ) / self.gains.forgetting
        return {
            "theta[1]": self.theta[0],
            "theta[2]": self.theta[1],
            "scale": SCALE + scale_again(),
        }

    def get_state(self) -> bytes:
        return np.concatenate([self.theta, self.covariance.ravel()]).tobytes()

    def set_state(self, state: bytes) -> None:
        values = np.frombuffer(state)
        self.theta, self.covariance = values[:2].copy(), values[2:].reshape(2, 2).copy()
