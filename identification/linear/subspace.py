"""MOESP: a linear state-space model straight from measured inputs and outputs.

Ordinary MOESP and MOESP with past inputs and outputs as instruments, over one
or several records, from arrays, memory-mapped files or chunks. The data are
compressed by a streaming QR, so memory does not grow with the record.

Sources: Verhaegen and Dewilde, Subspace model identification, parts 1 and 2,
Int. J. Control 56 (1992); Verhaegen, Automatica 30 (1994) for past outputs.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING, Literal, final, get_args

import numpy as np
import numpy.typing as npt

from identification.errors import InputError
from identification.linear.hankel_gram import HankelGram, TooFewDigits
from identification.linear.hankel_qr import HankelFactor, HankelQR, Method
from identification.linear.kalman import NoiseModel, noise_model, predictions
from identification.linear.order_choice import (
    OrderCandidate,
    choose,
    choose_marginal,
    integrates,
    judge,
    judge_by_shots,
    shortlist,
)
from identification.linear.records import ArraySource, Chunk, ChunkSource, Source
from identification.linear.response_fit import ResponseFit, simulate
from identification.linear.shots import fit_shots, shot_length
from identification.linear.triangle import FloatArray, single_thread

if TYPE_CHECKING:
    import control

__all__ = [
    "HankelQR",
    "MoespOptions",
    "NoiseModel",
    "OrderCandidate",
    "Subspace",
    "SubspaceOutcome",
    "UnstableModelWarning",
    "moesp",
    "moesp_chunks",
]

InputMatrixMethod = Literal["simulation", "shift"]
Compression = Literal["qr", "fast"]

# growth of an unstable response over a record up to which it is simulated in one piece: of sixteen
# digits four are left
_GROWTH = 1e12
# part of a record to hold out: less is a few periods, more leaves less to fit than to judge
_HELD_OUT = (0.05, 0.5)


class UnstableModelWarning(UserWarning):
    """The identified model has a spectral radius of 1 or more."""


@final
class SubspaceOutcome(Enum):
    """What became of an identification, in a sentence."""

    ORDER_GIVEN = "The order was given; the model is stable."
    ORDER_CHOSEN = (
        "The order was chosen from the singular values, the simulation of held-out "
        "samples and the spectral radius; the model is stable."
    )
    NO_CLEAR_ORDER = (
        "The model is stable, but the singular values show no clear gap: its order "
        "rests on the simulation of held-out samples."
    )
    INTEGRATES = (
        "The model integrates: its spectral radius is 1 as far as the records tell. Simulate it "
        "over times like theirs, not beyond."
    )
    UNSTABLE = (
        "The model is unstable (spectral radius 1 or more): do not simulate it; take "
        "another order, more block rows or more data."
    )


@final
@dataclass(frozen=True)
class MoespOptions:
    """Less common settings of `moesp`.

    Attributes
    ----------
    input_names, output_names : tuple of str
        Channel names for the system; u0, u1, ... and y0, y1, ... where empty.
    output_weights : tuple of float
        Factors on the outputs, for outputs of unlike size or trust; 1 where empty.
        The singular values are those of the weighted outputs.
    input_matrices : {"simulation", "shift"}
        How B and D are found. "simulation": least squares on the simulated
        response, jointly with x0. "shift": from the triangle alone (thesis
        eq. 3.46), fast, but it fails on smooth inputs.
    held_out : float
        Part of the samples, at the end, that judges the order; 0.05 to 0.5.
    max_order : int
        Highest order tried where none is given.
    compression : {"qr", "fast"}
        How the data are compressed. "qr": streaming QR, all digits. "fast": Cholesky factor of the
        correlations, some twenty times faster, at half the digits; where those do not suffice, as
        with position, velocity and acceleration as inputs, QR is used after all and the result says
        so.
    noise : bool
        Estimate the noise covariances and the Kalman gain too; not with the ordinary method.
    """

    input_names: tuple[str, ...] = ()
    output_names: tuple[str, ...] = ()
    output_weights: tuple[float, ...] = ()
    input_matrices: InputMatrixMethod = "simulation"
    held_out: float = 0.25
    max_order: int = 12
    compression: Compression = "qr"
    noise: bool = False


@final
@dataclass(frozen=True)
class Subspace:
    """An identified linear model and the evidence for it.

    Attributes
    ----------
    system : control.StateSpace
        Discrete-time model with `dt` and channel names.
    order : int
    singular_values : ndarray, shape (block_rows * outputs,)
        Their gap shows the order.
    x0 : tuple of ndarray, shape (order,)
        Initial state of every record; of a model that grows too far over a record, from its first
        samples.
    vaf_percent : ndarray, shape (outputs,)
        Variance of each output that the simulated model accounts for, on the
        records it was fitted on; NaN where an unstable model was not simulated.
    held_out_vaf_percent : ndarray, shape (outputs,)
        The same on held-out samples for the chosen order, fitted without them; empty where the
        order was given.
    spectral_radius : float
        Largest eigenvalue modulus of A.
    candidates : tuple of OrderCandidate
        The orders tried; empty where the order was given.
    outcome : SubspaceOutcome
    compression : {"qr", "fast"}
        How the data were compressed in the end.
    noise : NoiseModel or None
        Noise covariances and Kalman gain, where they were asked for.
    """

    system: control.StateSpace
    order: int
    singular_values: FloatArray
    x0: tuple[FloatArray, ...]
    vaf_percent: FloatArray
    held_out_vaf_percent: FloatArray
    spectral_radius: float
    candidates: tuple[OrderCandidate, ...]
    outcome: SubspaceOutcome
    compression: Compression = "qr"
    noise: NoiseModel | None = None

    def simulate(self, u: npt.ArrayLike, x0: npt.ArrayLike | None = None) -> FloatArray:
        """Output of the model, shape (samples, outputs), for `u` of shape (samples, inputs)
        from `x0` (zero).
        """
        inputs = np.asarray(u, dtype=np.float64)
        inputs = inputs.reshape(-1, 1) if inputs.ndim == 1 else inputs
        if inputs.shape[1] != self.system.ninputs:
            raise InputError(
                f"u has {inputs.shape[1]} channels, the model {self.system.ninputs} inputs: give "
                "them all"
            )
        state = None if x0 is None else np.asarray(x0, dtype=np.float64)
        return simulate(self.system.A, self.system.B, self.system.C, self.system.D, inputs, state)

    def predict(self, u: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Outputs one sample ahead, shape (samples, outputs), from the samples before each, by the
        Kalman gain; the initial state is that which fits best.

        Raises
        ------
        InputError
            A model without a noise model.
        """
        if self.noise is None:
            raise InputError(
                "the model holds no Kalman gain: identify with MoespOptions(noise=True)"
            )
        source = ArraySource(u, y)
        (inputs, outputs) = zip(*source.pieces(0, 0, source.lengths[0]), strict=True)
        a, b, c, d = (
            np.asarray(m, dtype=np.float64)
            for m in (self.system.A, self.system.B, self.system.C, self.system.D)
        )
        return predictions(
            (a, b, c, d), self.noise, np.concatenate(inputs), np.concatenate(outputs)
        )

    def vaf_on(
        self,
        u: npt.ArrayLike | Sequence[npt.NDArray[np.generic]],
        y: npt.ArrayLike | Sequence[npt.NDArray[np.generic]],
    ) -> FloatArray:
        """Variance of each output that a simulation accounts for [%], initial state and mean of
        each record its own; of a stable model only.
        """
        source = ArraySource(u, y)
        b, d = (np.asarray(m, dtype=np.float64) for m in (self.system.B, self.system.D))
        fit = ResponseFit(np.asarray(self.system.A), np.asarray(self.system.C), len(b.T))
        for index, length in enumerate(source.lengths):
            for one, other in source.pieces(index, 0, length):
                fit.add(one, other)
            fit.end_record()
        return fit.vaf_percent(b, d, fit.initial_states(b, d))


def moesp(
    u: npt.ArrayLike | Sequence[npt.NDArray[np.generic]],
    y: npt.ArrayLike | Sequence[npt.NDArray[np.generic]],
    block_rows: int = 20,
    order: int | None = None,
    dt: float = 1.0,
    method: Method = "ordinary",
    *,
    options: MoespOptions | None = None,
) -> Subspace:
    """Identify a linear state-space model by MOESP.

    Parameters
    ----------
    u, y : array_like, shape (samples, channels), or lists of such arrays
        Inputs and outputs; a list holds one array per record. Memory-mapped
        arrays are read piece by piece. Remove offsets and trends before.
    block_rows : int
        Block rows i of the Hankel matrix, 2 or more; about two to three times the
        order expected. More see slower dynamics and cost time (quadratically).
    order : int, optional
        Order of the model, 1 to ``(block_rows - 1) * outputs``. Where not given it is
        chosen among the largest gaps of the singular values by the simulation
        of held-out samples, among stable models.
    dt : float
        Sampling time in s.
    method : {"ordinary", "past_output", "past_input", "cva"}
        "ordinary" is unbiased where the only noise is white noise on the outputs.
        "past_output" uses past inputs and outputs as instruments: unbiased under
        white process noise too, at two to four times the cost. "cva" is the same with
        the weights of canonical correlations: directions count by how well they are known.
        "past_input" uses past inputs alone: unbiased under any noise on the outputs in open
        loop, and of no use on smooth inputs.
    options : MoespOptions, optional
        Names, weights, the way to B and D, limits of the order choice.

    Returns
    -------
    Subspace

    Raises
    ------
    InputError
        If the records hold NaN, a constant channel, too few samples or unequal lengths.

    Warns
    -----
    UnstableModelWarning
        If the model has a spectral radius of 1 or more. The outcome says so too.

    Examples
    --------
    >>> import numpy as np
    >>> u = np.random.default_rng(0).standard_normal(500)
    >>> y = np.zeros(500)
    >>> for k in range(499):
    ...     y[k + 1] = 0.8 * y[k] + u[k]
    >>> round(moesp(u, y, block_rows=5, order=1).spectral_radius, 6)
    0.8
    """
    return _identify(ArraySource(u, y), block_rows, order, dt, method, options or MoespOptions())


def moesp_chunks(
    records: Sequence[Callable[[], Iterable[Chunk]]],
    block_rows: int = 20,
    order: int | None = None,
    dt: float = 1.0,
    method: Method = "ordinary",
    *,
    options: MoespOptions | None = None,
) -> Subspace:
    """Identify as `moesp` does, from records that arrive as chunks.

    Parameters
    ----------
    records : sequence of callables
        One per record; each call starts the reading anew and returns an iterable
        of ``(u, y)`` chunks of shape (samples, channels). A record is read three times.
    block_rows, order, dt, method, options
        As for `moesp`.
    """
    return _identify(ChunkSource(records), block_rows, order, dt, method, options or MoespOptions())


def _identify(
    source: Source,
    block_rows: int,
    order: int | None,
    dt: float,
    method: Method,
    options: MoespOptions,
) -> Subspace:
    weights = _check_options(source.channels, dt, options)
    inputs, outputs = source.channels
    accumulator = HankelQR(inputs, outputs, block_rows, method, weights)
    highest = (block_rows - 1) * outputs
    if options.noise and method == "ordinary":
        raise InputError(
            "the ordinary method keeps no past, from which the noise would follow: take "
            '"past_output"'
        )
    if order is not None and not 1 <= order <= highest:
        raise InputError(f"order is {order}: give 1 to {highest} = (block_rows - 1) * outputs")
    for index, length in enumerate(source.lengths):
        if length < accumulator.window:
            raise InputError(
                f"record {index} has {length} samples, one Hankel row takes "
                f"{accumulator.window}: leave it out or lower block_rows"
            )
    split = (
        sum(source.lengths)
        if order is not None
        else round((1.0 - options.held_out) * sum(source.lengths))
    )
    compression = options.compression
    try:
        early, whole = _compress(
            source, HankelGram(accumulator) if compression == "fast" else accumulator, split
        )
    except TooFewDigits:
        compression = "qr"
        early, whole = _compress(source, accumulator, split)
    left, singular_values = whole.directions()
    candidates: tuple[OrderCandidate, ...] = ()
    if order is None:
        orders = shortlist(singular_values, min(options.max_order, highest))
        candidates = judge(source, early, orders, singular_values, split, weights)
        order = choose(candidates, lambda tried: _spectral_radius(whole.realise(left, tried)[0]))
        if order is None or any(one.is_marginal for one in candidates):
            order, candidates = choose_marginal(
                order, candidates, judge_by_shots(source, early, candidates, split, weights)
            )
    return _finish(
        source,
        whole,
        left=left,
        singular_values=singular_values,
        order=order,
        candidates=candidates,
        settings=(dt, weights, replace(options, compression=compression)),
    )


def _finish(
    source: Source,
    factor: HankelFactor,
    left: FloatArray,
    singular_values: FloatArray,
    order: int,
    candidates: tuple[OrderCandidate, ...],
    settings: tuple[float, FloatArray, MoespOptions],
) -> Subspace:
    dt, weights, options = settings
    a, c = factor.realise(left, order)
    radius = _spectral_radius(a)
    grows = radius > 1.0 and max(source.lengths) * np.log(radius) > np.log(_GROWTH)
    b, d = factor.shift_equation(left, order)
    x0 = tuple(np.full(order, np.nan) for _ in source.lengths)
    vaf = np.full(factor.outputs, np.nan)
    if grows and options.input_matrices == "simulation":
        spans = [(index, 0, length) for index, length in enumerate(source.lengths)]
        length = shot_length(radius, order + factor.inputs)
        b, d = fit_shots(source, spans, (a, c), weights, length) or (b, d)
        first = ResponseFit(a, c, factor.inputs)  # the beginning of every record alone
        for index, total in enumerate(source.lengths):
            for u, y in source.pieces(index, 0, min(length, total)):
                first.add(u, y * weights)
            first.end_record()
        x0 = first.initial_states(b, d)
    if not grows:
        fit = ResponseFit(a, c, factor.inputs)
        for index, length in enumerate(source.lengths):
            for u, y in source.pieces(index, 0, length):
                fit.add(u, y * weights)
            fit.end_record()
        if options.input_matrices == "simulation":
            solved = fit.solve()
            b, d, x0 = solved.b, solved.d, solved.x0
        else:
            x0 = fit.initial_states(b, d)
        vaf = fit.vaf_percent(b, d, x0)
    chosen = [candidate for candidate in candidates if candidate.order == order]
    scale = 1.0 / weights[:, None]
    noise = noise_model(source, factor, (a, b, c, d), weights) if options.noise else None
    return Subspace(
        system=_system((a, b, c * scale, d * scale), dt, options),
        order=order,
        singular_values=singular_values,
        x0=x0,
        vaf_percent=vaf,
        held_out_vaf_percent=chosen[0].held_out_vaf_percent if chosen else np.empty(0),
        spectral_radius=radius,
        candidates=candidates,
        outcome=_outcome(radius, chosen[0] if chosen else None),
        compression=options.compression,
        noise=noise,
    )


def _outcome(radius: float, chosen: OrderCandidate | None) -> SubspaceOutcome:
    if radius >= 1.0:
        marginal = SubspaceOutcome.INTEGRATES
        said = marginal if integrates(radius) else SubspaceOutcome.UNSTABLE
        warnings.warn(
            f"spectral radius {radius:.6g}: {said.value}", UnstableModelWarning, stacklevel=5
        )
        return said
    if chosen is None:
        return SubspaceOutcome.ORDER_GIVEN
    return SubspaceOutcome.ORDER_CHOSEN if chosen.clear_gap else SubspaceOutcome.NO_CLEAR_ORDER


def _compress(
    source: Source, accumulator: HankelQR | HankelGram, split: int
) -> tuple[HankelFactor, HankelFactor]:
    """Factor of the first `split` samples (over all records) and of everything."""
    early: HankelFactor | None = None
    seen = 0
    for index, length in enumerate(source.lengths):
        cut = min(max(split - seen, 0), length)
        for u, y in source.pieces(index, 0, cut):
            accumulator.add(u, y)
        if early is None and cut < length:
            early = accumulator.factor()
        for u, y in source.pieces(index, cut, length):
            accumulator.add(u, y)
        accumulator.end_record()
        seen += length
    whole = accumulator.factor()
    return (whole if early is None else early), whole


def _system(
    matrices: tuple[FloatArray, ...], dt: float, options: MoespOptions
) -> control.StateSpace:
    import control

    outputs, inputs = matrices[3].shape
    return control.StateSpace(
        *matrices,
        dt,
        inputs=list(options.input_names) or [f"u{index}" for index in range(inputs)],
        outputs=list(options.output_names) or [f"y{index}" for index in range(outputs)],
        remove_useless_states=False,
    )


def _spectral_radius(a: FloatArray) -> float:
    with single_thread():
        return float(np.abs(np.linalg.eigvals(a)).max())


def _check_options(channels: tuple[int, int], dt: float, options: MoespOptions) -> FloatArray:
    inputs, outputs = channels
    if not (np.isfinite(dt) and dt > 0):
        raise InputError(f"dt is {dt}: give the sampling time in s, more than 0")
    if options.input_names and len(options.input_names) != inputs:
        raise InputError(
            f"{len(options.input_names)} input_names for {inputs} inputs: give one each"
        )
    if options.output_names and len(options.output_names) != outputs:
        raise InputError(
            f"{len(options.output_names)} output_names for {outputs} outputs: give one each"
        )
    if options.input_matrices not in get_args(InputMatrixMethod):
        raise InputError(
            f"input_matrices {options.input_matrices!r} is unknown: choose simulation or shift"
        )
    if options.compression not in get_args(Compression):
        raise InputError(f"compression {options.compression!r} is unknown: choose qr or fast")
    low, high = _HELD_OUT
    if not low <= options.held_out <= high:
        raise InputError(f"held_out is {options.held_out}: give {low:g} to {high:g}")
    if options.max_order < 1:
        raise InputError(f"max_order is {options.max_order}: give 1 or more")
    weights = np.array(options.output_weights or (1.0,) * outputs, dtype=np.float64)
    if weights.shape != (outputs,) or not np.all(np.isfinite(weights) & (weights > 0)):
        raise InputError(
            f"output_weights {options.output_weights} do not fit: give {outputs} positive factors"
        )
    return weights
