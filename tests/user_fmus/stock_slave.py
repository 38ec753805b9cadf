"""A mass with drag as people write it for pythonfmu: the FMU is built with its own command."""

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class StockSlave(Fmi2Slave):
    """m v' = tau - d v, explicit Euler."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.tau, self.q, self.v, self.m, self.d = 0.0, 0.0, 0.0, 1.0, 0.5
        self.register_variable(Real("tau", causality=Fmi2Causality.input))
        self.register_variable(Real("q", causality=Fmi2Causality.output))
        for name in ("m", "d"):
            self.register_variable(
                Real(name, causality=Fmi2Causality.parameter, variability=Fmi2Variability.tunable)
            )

    def do_step(self, time, step):
        """One step."""
        self.v += step * (self.tau - self.d * self.v) / self.m
        self.q += step * self.v
        return True
