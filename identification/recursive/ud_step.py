"""One step of the recursive least squares as a CasADi function (thesis 3.2 and 3.5)."""

from __future__ import annotations

from typing import Any, final

import casadi as ca

from identification.recursive.settings import POLYNOMIAL_DEGREE, Layout
from identification.recursive.ud_factor import SX, Factor, Parts, dot, every, select, total, where

_INPUT_LIMIT = 1e30  # larger inputs would overflow in squares: treated as invalid samples
_ERROR_LIMIT = 1e60
_NOISE_LOW = 1e-30
# share of the samples so far in which the first guess of R2 is forgotten: to one part in 1000 in 80
# samples
_NOISE_HASTE = 5.0
_NOISE_CLIP = 10.0  # of the squared normalised innovation, in the estimate of R2
_SUM_CLIP = 3.0  # of the normalised innovation, in the estimate of its correlation


def _forgetting(method: str, fast: Parts, config: Parts, relative_error: SX) -> SX:
    """Forgetting factor of this sample (thesis 3.5)."""
    low = config["low"][0]
    if method == "constant":
        return config["forgetting"][0]
    if method == "schedule":
        return fast["forgetting"][0]
    if method == "bell":
        factor = low + (1.0 - low) * ca.exp(-config["beta"][0] * ca.fmin(relative_error, 1e6) ** 2)
    else:
        at = 2.0 * ca.fmin(relative_error, config["end"][0]) / config["end"][0] - 1.0
        one, two = ca.SX(0), ca.SX(0)  # Clenshaw
        for k in range(POLYNOMIAL_DEGREE, 0, -1):
            one, two = config["poly"][k] + 2.0 * at * one - two, one
        factor = config["poly"][0] + at * one - two
    return ca.fmin(1.0, ca.fmax(low, factor))


@final
class _Sample:
    """What one sample brings: checked values, errors, which rows and parameters take part."""

    def __init__(
        self,
        layout: Layout,
        fast: Parts,
        flags: list[SX],
        config: Parts,
        y: list[SX],
        rows: list[SX],
    ) -> None:
        n, m = layout.n, layout.m
        enabled = config["enabled"]
        scaled = [[rows[o * n + i] * config["scale"][i] for i in range(n)] for o in range(m)]
        finite = [
            total([ca.fabs(item) for item in [y[o], *scaled[o]]]) <= _INPUT_LIMIT for o in range(m)
        ]
        usable = every([ca.logic_or(finite[o], ca.logic_not(enabled[o])) for o in range(m)])
        here = [usable * enabled[o] for o in range(m)]
        self.y = [where(here[o], y[o]) for o in range(m)]
        self.h = [[where(here[o], item) for item in scaled[o]] for o in range(m)]
        self.error = [self.y[o] - dot(self.h[o], fast["theta"]) for o in range(m)]
        self.valid = usable * (total([ca.fabs(e) for e in self.error]) <= _ERROR_LIMIT)
        # 0 or 1 from here on: products are cheaper than branches.
        self.seen = [self.valid * enabled[o] for o in range(m)]
        self.used = [self.seen[o] * flags[n + o] for o in range(m)]
        rate = config["shown_rate"][0]
        self.size = [
            old + self.seen[k // n] * rate * (self.h[k // n][k % n] ** 2 - old)
            for k, old in enumerate(fast["size"])
        ]
        # what stands in its own noise says nothing of its parameter
        self.shown = [now >= noise for now, noise in zip(self.size, config["hides"], strict=True)]
        self.free = config["free"]
        self.moving = [self.free[i] * flags[i] for i in range(n)]
        self.inflation = flags[n + m :]
        self.acts = total(self.used) > 0

    def relative_error(self, fast: Parts, config: Parts) -> SX:
        """Largest |e| / max(|y|, y_min) of the rows in use."""
        worst = ca.SX(0)
        for o, used in enumerate(self.used):
            floor = ca.fmax(
                config["floor"][o], config["floor_share"][0] * ca.sqrt(fast["power"][o])
            )
            worst = ca.fmax(
                worst, where(used, ca.fabs(self.error[o]) / ca.fmax(ca.fabs(self.y[o]), floor))
            )
        return worst


def _forget(
    factor: Factor, method: str, fast: Parts, config: Parts, sample: _Sample, new: Parts
) -> None:
    """P / lambda for the parameters that move, bound on diag(P), reset of P after a long low
    lambda.
    """
    factor_now = _forgetting(method, fast, config, sample.relative_error(fast, config))
    low, keep = fast["low"][0], ca.SX(1)
    if method in ("bell", "polynomial"):
        low = select(sample.acts, where(factor_now <= config["reset_under"][0], low + 1.0), low)
        keep = low < config["reset_length"][0]
        new.values["resets"] = [fast["resets"][0] + ca.logic_not(keep)]
        new.values["low"] = [low * keep]
    following = factor_now
    if method == "schedule":
        following = config["rate"][0] * factor_now + (1.0 - config["rate"][0])
    new.values["forgetting"] = [select(sample.acts, following, fast["forgetting"][0])]
    growth = 1.0 / factor_now
    variances = factor.diagonal()
    # All of P or nothing: where single rows grew, the directions that the samples have told would
    # turn away. A
    # parameter without any correlation stands for itself.
    inside = [
        ca.logic_or(ca.logic_not(sample.moving[i]), variances[i] * growth <= config["limit"][i])
        for i in range(factor.n)
    ]
    alone = factor.uncorrelated()
    together = every([ca.logic_or(inside[i], alone[i]) for i in range(factor.n)])
    which = [
        sample.acts * sample.moving[i] * inside[i] * ca.logic_or(together, alone[i])
        for i in range(factor.n)
    ]
    factor.grow(growth, which, keep)
    if method in ("bell", "polynomial"):
        factor.d = [
            select(keep, d, start) for d, start in zip(factor.d, config["start"], strict=True)
        ]


def _correct(
    layout: Layout, factor: Factor, fast: Parts, config: Parts, sample: _Sample, new: Parts
) -> SX:
    """The sequential scalar updates of all outputs; tells whether an innovation is over its
    limit.
    """
    theta = list(fast["theta"])
    count = fast["samples"][0] - fast["skipped"][0]
    quick = ca.fmax(config["noise_rate"][0], _NOISE_HASTE / (20.0 + fast["learned"][0]))
    calm = ca.logic_not(fast["alarm"][0])
    noises, innovations, powers, sums, squares, over = [], [], [], [], [], []
    for o in range(layout.m):
        used = sample.used[o]
        # What a row says of a parameter is taken whether or not the rows before have shown it: left
        # out, it would be an error of the row that no covariance knows of.
        h = [
            used * sample.free[i] * sample.shown[o * layout.n + i] * sample.h[o][i]
            for i in range(layout.n)
        ]
        # The scalars see the estimate that the outputs before them have corrected.
        error = used * (sample.y[o] - dot(sample.h[o], theta)) if o else used * sample.error[o]
        square = sample.y[o] ** 2
        # Too large a first R2 costs a few samples, too small a one gives the first samples weight
        # for ever.
        first = 1e-2 * (
            square + error**2 + total([d * item**2 for d, item in zip(factor.d, h, strict=True)])
        )
        noise = select(
            config["noise_known"][o],
            config["noise_given"][o],
            select(fast["noise"][o] > 0, fast["noise"][o], first + _NOISE_LOW),
        )
        # Correlated noise (filtered measurements) tells less per sample than its variance says.
        used_noise = noise * select(config["noise_known"][o], 1.0, sample.inflation[o])
        unsure = factor.variance(h)
        limit = _alarm_limit(config, sample.inflation[o])
        # One sample far off among quiet ones is an outlier; where its neighbours are as far off,
        # the parameters have moved. An outlier has that much more noise: it moves the estimate by
        # no more than the bound, and P knows no more than was believed.
        bound = config["huber"][0] * ca.sqrt(unsure + noise)
        beyond = ca.fmax(ca.fabs(error) / ca.fmax(bound, _NOISE_LOW), 1.0) - 1.0
        believed = select(fast["innovation"][o] <= limit, beyond, 0.0)
        gain, expected = factor.measure(h, used_noise + believed * (unsure + used_noise))
        step = error / expected
        theta = [theta[i] + sample.free[i] * (gain[i] * step) for i in range(layout.n)]
        expected = unsure + noise
        normalised = error * error / expected
        power = fast["power"][o] + used * ca.fmax(config["noise_rate"][0], 1.0 / (1.0 + count)) * (
            square - fast["power"][o]
        )
        learned = noise * (1.0 + used * calm * quick * (ca.fmin(normalised, _NOISE_CLIP) - 1.0))
        known = ca.logic_or(fast["noise"][o] > 0, first * used > 0)
        noises.append(where(known, ca.fmax(learned, 1e-12 * power + _NOISE_LOW)))
        standard = used * calm * ca.fmax(-_SUM_CLIP, ca.fmin(error / ca.sqrt(expected), _SUM_CLIP))
        sums.append(fast["sum"][o] + standard)
        squares.append(fast["squares"][o] + standard * standard)
        # Three samples at least: no single outlier fires the alarm.
        most = limit / (3.0 * config["alarm_rate"][0])
        average = fast["innovation"][o] + used * config["alarm_rate"][0] * (
            ca.fmin(normalised, most) - fast["innovation"][o]
        )
        innovations.append(average)
        over.append(used * (average > limit))
        powers.append(power)
    new.values["learned"] = [fast["learned"][0] + sample.acts * calm]
    new.values["size"] = sample.size
    new.values.update(
        theta=theta,
        noise=noises,
        innovation=innovations,
        power=powers,
        sum=sums,
        squares=squares,
        d=factor.d,
        u=factor.packed(),
    )
    return total(over) > 0


def _alarm_limit(config: Parts, inflation: SX) -> SX:
    """Chi-square limit of the averaged squared innovation, over its degrees of freedom (Wilson and
    Hilferty, 1931).

    Correlation between the innovations leaves fewer degrees of freedom; see `_inflation` in the
    check.
    """
    freedom = ca.fmax(0.5, config["alarm_freedom"][0] / (2.0 * inflation - 1.0))
    share = 2.0 / (9.0 * freedom)
    root = 1.0 - share + config["alarm_normal"][0] * ca.sqrt(share)
    return root * root * root


def _alarm(fast: Parts, config: Parts, sample: _Sample, over: SX, new: Parts) -> None:
    """Chi-square alarm on the averaged normalised innovation, for a limited time, then a pause."""
    pause, alarm = fast["pause"][0], fast["alarm"][0]
    fires = over * sample.acts * (pause <= 0)
    new.values["alarm"] = [
        select(fires, config["alarm_length"][0], ca.fmax(0.0, alarm - sample.acts))
    ]
    new.values["pause"] = [
        select(fires, config["pause_length"][0], ca.fmax(0.0, pause - sample.acts))
    ]
    new.values["alarms"] = [fast["alarms"][0] + fires]


def _collect(layout: Layout, fast: Parts, config: Parts, sample: _Sample, new: Parts) -> None:
    """Adds the sample to the information matrix (scaled parameters, weight 1/R2 where R2 is
    given).
    """
    n, m = layout.n, layout.m
    info, energy, mean = list(fast["info"]), list(fast["energy"]), list(fast["mean"])
    for o in range(m):
        given = select(
            config["noise_known"][o], 1.0 / ca.fmax(config["noise_given"][o], _NOISE_LOW), 1.0
        )
        weighted = [sample.seen[o] * given * item for item in sample.h[o]]
        for j in range(n):
            for i in range(j):
                at = j * (j - 1) // 2 + i
                info[at] = info[at] + weighted[i] * sample.h[o][j]
            energy[o * n + j] = energy[o * n + j] + weighted[j] * sample.h[o][j]
            mean[o * n + j] = mean[o * n + j] + sample.seen[o] * sample.h[o][j]
    new.values.update(info=info, energy=energy, mean=mean)


def step_function(layout: Layout, method: str, freeze: bool) -> Any:
    """The step of one sample."""
    n, m = layout.n, layout.m
    symbols = [
        ca.SX.sym("fast", layout.fast.size),
        ca.SX.sym("flags", n + 2 * m),
        ca.SX.sym("config", layout.config.size),
        ca.SX.sym("y", m),
        ca.SX.sym("H", n * m),
    ]
    fast, config = Parts(symbols[0], layout.fast), Parts(symbols[2], layout.config)
    new = Parts(symbols[0], layout.fast)
    flags = ca.vertsplit(symbols[1])
    sample = _Sample(
        layout, fast, flags, config, ca.vertsplit(symbols[3]), ca.vertsplit(symbols[4])
    )
    factor = Factor(fast["d"], fast["u"])
    if method == "random_walk":
        new.values["forgetting"] = [ca.SX(1.0)]
    else:
        _forget(factor, method, fast, config, sample, new)
    over = _correct(layout, factor, fast, config, sample, new)
    _alarm(fast, config, sample, over, new)
    if freeze:
        _collect(layout, fast, config, sample, new)
    since = fast["since_check"][0] + sample.valid
    new.values["since_check"] = [since]
    new.values["due"] = [since >= config["check_length"][0]]
    errors = [seen * error for seen, error in zip(sample.seen, sample.error, strict=True)]
    new.values["error"] = errors
    new.values["samples"] = [fast["samples"][0] + 1.0]
    new.values["skipped"] = [fast["skipped"][0] + ca.logic_not(sample.valid)]
    theta = ca.vertcat(*(t * s for t, s in zip(new["theta"], config["scale"], strict=True)))
    frozen = ca.logic_or(total(flags[:n]) < n, ca.logic_not(sample.acts))
    status = ca.vertcat(
        new["forgetting"][0],
        ca.logic_not(sample.valid) + 2.0 * (new["alarm"][0] > 0) + 4.0 * frozen,
    )
    return ca.Function(
        "rls_step",
        symbols,
        [new.joined(), theta, ca.vertcat(*errors), status],
        ["fast", "flags", "config", "y", "H"],
        ["fast_next", "theta", "error", "status"],
    )
